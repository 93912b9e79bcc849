"""Clocks that let a bench's time pass: as fast as the machine goes, in real time, or by hand.

A bench counts its time in samples, and only the clock decides when the next samples are due. Whoever has to
wait (a read, a write into a full buffer, `wait_until_done`) asks the clock; timeouts are in its time.

* `FastClock`: time passes only while somebody waits, as quickly as the machine computes. A run is
  deterministic: nothing happens between two calls. Who asks again and again how far a task has come waits too
  (see `Clock.glance`). Time pauses briefly at an event, so that its callback can respond.
* `RealClock`: a thread keeps the bench at wall-clock time, whether anybody waits or not. A slow reader is
  overrun as with hardware.
* `ManualClock`: time passes when `ManualClock.advance` is called. Waiting for samples that have not come gives
  up at once, as nobody else can bring them.
"""

from __future__ import annotations

import logging
import math
import threading
import time
import weakref
from collections.abc import Callable
from typing import Protocol

from daq.instrument.errors import bad
from daq.instrument.priority import raise_priority
from daq.instrument.sleepers import Sleepers
from rig.errors import SceneError

_LOG = logging.getLogger("shotrig.clock")


def seconds(timeout: float) -> float:
    """Give a time to wait, s; negative for ever.

    Raises
    ------
    DaqError
        With -200077, if it is no time.

    Examples
    --------
    >>> seconds(2), seconds(-1.0), seconds(float("inf"))
    (2.0, -1.0, -1.0)
    """
    if math.isnan(timeout):
        raise bad(f"timeout is {timeout}: expected seconds, or -1 to wait for ever")
    return -1.0 if timeout == math.inf else float(timeout)


class Timeline(Protocol):
    """What a clock moves: a bench that counts samples."""

    @property
    def position(self) -> int:
        """Samples that have passed."""

    @property
    def rate(self) -> float:
        """Samples per second."""

    @property
    def changed(self) -> threading.Condition:
        """Condition notified whenever samples have passed; its lock guards the bench."""

    @property
    def sleepers(self) -> Sleepers:
        """Who waits for samples to pass; woken whenever enough have, and whenever a task ends."""

    @property
    def live(self) -> bool:
        """Whether the bench wants its time to pass (some task is open and has been started)."""

    def advance(self, samples: int) -> None:
        """Let samples pass."""

    def fail(self, error: BaseException) -> None:
        """Hear that time cannot go on."""

    def anchor(self) -> None:
        """Hear that bench time goes on from now, wherever it has stood still."""

    def lag(self, seconds: float) -> bool:
        """Hear that the machine is this far behind the clock; say whether to give that time up as lost."""


class Clock(Protocol):
    """What all clocks can do."""

    # Whether time passes without anybody waiting.
    runs_free: bool

    def start(self, bench: Timeline) -> None:
        """Begin to move a bench; called whenever a task starts."""

    def now(self, bench: Timeline) -> float:
        """Seconds on this clock, for timeouts."""

    def glance(self, bench: Timeline) -> None:
        """Let pass what a look at a bench takes, on a clock that nothing else moves."""

    def wait(
        self, bench: Timeline, ready: Callable[[], bool], wanted: Callable[[], int], timeout: float
    ) -> bool:
        """Let time pass until something is ready.

        Parameters
        ----------
        bench : Timeline
            The bench; its lock is held by the caller.
        ready : callable
            Whether the wait is over.
        wanted : callable
            Samples that must pass at least before it can be; the bench moves no further than that at once.
        timeout : float
            Seconds of bench time; 0 looks once, negative waits for ever.

        Returns
        -------
        bool
            Whether it became ready in time.
        """


class FastClock:
    """Time passes while somebody waits, as quickly as the machine computes."""

    runs_free = False
    # Whoever waits for long lets others come by so often and for so long, s of the wall clock.
    TURN, PAUSE = 0.05, 0.002

    def start(self, bench: Timeline) -> None:
        """Do nothing: time passes when somebody waits."""

    def now(self, bench: Timeline) -> float:
        """See `Clock.now`."""
        return bench.position / bench.rate

    def glance(self, bench: Timeline) -> None:
        """Let a hundredth of a second pass, so that a loop which only looks comes to its end."""
        bench.advance(max(1, int(bench.rate / 100)))

    def wait(
        self, bench: Timeline, ready: Callable[[], bool], wanted: Callable[[], int], timeout: float
    ) -> bool:
        """See `Clock.wait`."""
        end = math.inf if timeout < 0 else bench.position + math.ceil(timeout * bench.rate - 1e-6)
        turn = time.monotonic() + self.TURN
        while not ready():
            samples = min(max(1, wanted()), end - bench.position, math.ceil(bench.rate))
            if samples <= 0:
                return False
            bench.advance(int(samples))
            if time.monotonic() > turn:
                # What is waited for may have to be brought by another client, or may never come.
                bench.changed.wait(self.PAUSE)
                turn = time.monotonic() + self.TURN
        return True


class ManualClock:
    """Time passes on request.

    Examples
    --------
    >>> clock = ManualClock()
    >>> clock.advance(0.25)  # moves every bench that runs on this clock by a quarter of a second
    """

    runs_free = False

    def __init__(self) -> None:
        self._benches: weakref.WeakSet[Timeline] = weakref.WeakSet()

    def start(self, bench: Timeline) -> None:
        """Take a bench among those that `advance` moves."""
        self._benches.add(bench)

    def now(self, bench: Timeline) -> float:
        """See `Clock.now`."""
        return bench.position / bench.rate

    def glance(self, bench: Timeline) -> None:
        """Do nothing: time passes on request."""

    def advance(self, seconds: float) -> None:
        """Let time pass on every bench of this clock, to the nearest sample."""
        for bench in list(self._benches):
            with bench.changed:
                bench.advance(round(seconds * bench.rate))

    def wait(
        self, bench: Timeline, ready: Callable[[], bool], wanted: Callable[[], int], timeout: float
    ) -> bool:
        """See `Clock.wait`; nothing comes while waiting."""
        return ready()


class RealClock:
    """Time passes with the wall clock, on a thread of the bench.

    The thread ends when no task needs the bench any more and starts again with the next one; in between the
    bench stands still.
    """

    runs_free = True
    # Bench time is brought up to wall time this often, s: a reader waits half of it for its last sample.
    TICK = 0.004
    # It moves by no more than this at once, s: others have to come by.
    MOST = 0.04
    # A bench that is behind catches up at this multiple of real time: faster, it would overrun clients that keep up.
    CATCH_UP = 2.0
    # Who waits looks up this often, s.
    NAP = 0.02

    def __init__(self) -> None:
        self._moving: weakref.WeakSet[Timeline] = weakref.WeakSet()

    def start(self, bench: Timeline) -> None:
        """Begin to move a bench unless it is moving."""
        with bench.changed:
            if bench in self._moving:
                return
            self._moving.add(bench)
        threading.Thread(
            target=_follow, args=(weakref.ref(bench), self._moving), name="bench", daemon=True
        ).start()

    def now(self, bench: Timeline) -> float:
        """See `Clock.now`."""
        return bench.position / bench.rate

    def glance(self, bench: Timeline) -> None:
        """Do nothing: time passes by itself."""

    def wait(
        self, bench: Timeline, ready: Callable[[], bool], wanted: Callable[[], int], timeout: float
    ) -> bool:
        """See `Clock.wait`."""
        self.start(bench)
        end = math.inf if timeout < 0 else bench.position + timeout * bench.rate
        # In bench time, which falls behind the wall clock while something is compiled.
        while not ready() and bench.position < end and bench in self._moving:
            # What is waited for may also end early.
            nap = min(max(1, wanted()), math.ceil(self.NAP * bench.rate), end - bench.position)
            bench.sleepers.sleep(bench.position + math.ceil(nap))
        return ready()


# Steps of the bench that took longer than this are taken for the compiler's, up to so many of them, s.
_COMPILING, _COMPILATIONS = 1.0, 20


# A machine that is behind by less than this, s, is not reported.
_REPORTED_DELAY = 0.25
# Reports are at least this far apart, s.
_REPORT_INTERVAL = 10.0


class _Delays:
    """Reports how far the machine was behind the wall clock, once it has caught up."""

    def __init__(self) -> None:
        self._largest, self._reported = 0.0, -math.inf

    def note(self, delay: float, now: float) -> None:
        """Hear how far the bench is behind at a time of the wall clock, both in s."""
        self._largest = max(self._largest, delay)
        caught_up = delay < RealClock.MOST
        if self._largest >= _REPORTED_DELAY and caught_up and now - self._reported >= _REPORT_INTERVAL:
            _LOG.warning(
                "the machine was up to %.2f s behind real time, so samples came late. Run fewer programs, or enlarge "
                "the buffers of tasks",
                self._largest,
            )
            self._largest, self._reported = 0.0, now


def longest_step(elapsed: float) -> float:
    """Limit a step of a bench in real time, s.

    Parameters
    ----------
    elapsed : float
        Seconds of the wall clock since the previous step.

    Examples
    --------
    >>> longest_step(0.004), longest_step(1.0)
    (0.008, 0.04)
    """
    return min(RealClock.MOST, RealClock.CATCH_UP * max(elapsed, RealClock.TICK / 4))


def _follow(reference: weakref.ref[Timeline], moving: weakref.WeakSet[Timeline]) -> None:
    """Keep a bench at wall-clock time for as long as it wants."""
    raise_priority()
    pause, delays = threading.Event(), _Delays()
    origin: tuple[int, int, float] | None = None
    compilations, last = 0, time.monotonic_ns()
    while True:
        bench = reference()
        if bench is None:
            return
        with bench.changed:
            if not bench.live:
                moving.discard(bench)
                bench.sleepers.wake()
                return
            now = time.monotonic_ns()
            if origin is None or origin[2] != bench.rate or bench.position < origin[1]:
                origin = (now, bench.position, bench.rate)
                bench.anchor()
            due = origin[1] + (now - origin[0]) * bench.rate // 10**9 - bench.position
            elapsed, last = (now - last) * 1e-9, now
            if due > 0:
                try:
                    bench.advance(int(min(due, math.ceil(longest_step(elapsed) * bench.rate))))
                except BaseException as error:
                    moving.discard(bench)
                    bench.fail(error)
                    return
                # What is simulated for the first time may have to be compiled, which is no fault of the scene.
                compiled = compilations < _COMPILATIONS and time.monotonic_ns() - now > _COMPILING * 1e9
                compilations += compiled
                if compiled or bench.lag(due / bench.rate):
                    origin, due = None, 0
            delays.note(due / bench.rate, now * 1e-9)
        behind = due > RealClock.MOST * bench.rate
        del bench
        # A bench that is behind goes on almost at once, but lets others have the lock in between.
        pause.wait(RealClock.TICK / 4 if behind else RealClock.TICK)


CLOCKS: dict[str, Callable[[], Clock]] = {"real": RealClock, "fast": FastClock, "manual": ManualClock}


def clock(kind: str | Clock) -> Clock:
    """Make a clock by name, or take one as it is.

    Parameters
    ----------
    kind : {'real', 'fast', 'manual'} or Clock
        Which clock.

    Raises
    ------
    SceneError
        If there is no such clock.

    Examples
    --------
    >>> type(clock("fast")).__name__
    'FastClock'
    """
    if not isinstance(kind, str):
        return kind
    if kind not in CLOCKS:
        raise SceneError(f"clock {kind!r}: expected one of {', '.join(CLOCKS)}")
    return CLOCKS[kind]()
