"""Clocks that advance a bench: as fast as the computer allows, in real time, or on request.

A bench counts its time in ticks, the steps of its simulation. Its position is the number of ticks that have passed.
Only the clock determines when the next ticks are due. A call that must wait (a read, a write into a full buffer,
`wait_until_done`) waits according to the clock, and its timeout is in the clock's time.

* `FastClock`: time passes only during waiting calls, as fast as the computer simulates. A run is
  deterministic: no time passes between two calls. Repeated queries of a task's progress count as waiting (see
  `Clock.pass_query`). Time stops briefly at an event, so its callback can respond.
* `RealClock`: a thread keeps the bench at wall-clock time, with or without waiting calls. The buffer of a slow
  reader overflows as with hardware.
* `ManualClock`: time passes when `ManualClock.advance` is called. A call that waits for future samples times out
  immediately, because no other thread can provide them.
"""

import logging
import math
import os
import sys
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from daq.extras.ni_device.errors import invalid_value
from rig.core.base.errors import SceneError

_LOG = logging.getLogger("shotrig.clock")
# Maximum sleep before a condition is checked again [s]: the condition may have become impossible.
_MAX_SLEEP_S = 1.0
# Priority on Linux: higher than for ordinary programs (0), lower than for urgent system programs (-20).
_NICE = -10


def raise_priority() -> None:
    """Raise the priority of this thread, which runs or serves a bench in real time, if the system permits it."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)


class Sleepers:
    """Threads that wait until a bench has reached a position, in ticks.

    A thread is woken only when its position is reached. A reader that waits for 100 ms would otherwise wake 25 times,
    at each step of 4 ms, and delay other threads. Callers hold the `lock` of the bench; it is released while they
    sleep.
    """

    def __init__(self, lock: threading.RLock) -> None:
        self._lock = lock
        self._waiting: dict[threading.Condition, int] = {}

    def sleep(self, until: int) -> None:
        """Sleep until the bench has reached a position, or until all threads are woken."""
        condition = threading.Condition(self._lock)
        self._waiting[condition] = until
        try:
            condition.wait(_MAX_SLEEP_S)
        finally:
            del self._waiting[condition]

    def wake(self, position: int | None = None) -> None:
        """Wake the threads whose position has been reached; without a position, wake all."""
        for condition, until in self._waiting.items():
            if position is None or until <= position:
                condition.notify()


def normalize_timeout(timeout: float) -> float:
    """Return a timeout in s; negative if the timeout is infinite. Raises `DaqError` -200077 for NaN.

    >>> normalize_timeout(2), normalize_timeout(-1.0), normalize_timeout(float("inf"))
    (2.0, -1.0, -1.0)
    """
    if math.isnan(timeout):
        raise invalid_value(f"timeout is {timeout}, which is not a time. Give seconds, or -1 to wait without limit.")
    return -1.0 if timeout == math.inf else float(timeout)


class Timeline(Protocol):
    """Interface of a bench to the clock that advances it."""

    position: int  # ticks that have passed
    # Notified whenever ticks have passed; its lock protects the bench.
    changed: threading.Condition
    sleepers: Sleepers  # threads that wait for a position; all are woken when a task ends

    @property
    def rate(self) -> float:
        """Ticks per second."""

    @property
    def is_in_use(self) -> bool:
        """Whether bench time must pass: a task has been started and is still open."""

    def advance(self, ticks: int) -> None:
        """Advance by a number of ticks."""

    def fail(self, error: BaseException) -> None:
        """Handle an error of the simulation, after which bench time stops."""

    def anchor(self) -> None:
        """Store the wall-clock time at which bench time continues after a stop."""

    def report_delay(self, seconds: float) -> bool:
        """Handle a delay of the bench relative to the wall clock [s]; return whether to skip the missing time."""


class Clock:
    """Base class of all clocks; on a clock of this class, time does not pass."""

    # Whether time passes even if no call waits.
    is_free_running = False

    def start(self, bench: Timeline) -> None:
        """Start to advance a bench; called whenever a task starts."""

    def now(self, bench: Timeline) -> float:
        """Return the time of a bench on this clock [s] for timeouts."""
        return bench.position / bench.rate

    def pass_query(self, bench: Timeline) -> None:
        """Let a short time pass for a query, on a clock that advances only while a call waits."""

    def wait(self, bench: Timeline, ready: Callable[[], bool], ticks_needed: Callable[[], int], timeout: float) -> bool:
        """Wait until `ready` is true; return whether it became true before the timeout.

        The caller holds the lock of the bench. `ticks_needed` returns a lower bound of the ticks until `ready` can be
        true; one step of the bench is at most this number of ticks. `timeout` is bench time in s: 0 checks once, a
        negative timeout is infinite.
        """
        return ready()


class FastClock(Clock):
    """Time passes during waiting calls, as fast as the computer simulates."""

    # Interval and duration of the pauses of a long wait (wall-clock time), in which other threads can take the lock.
    PAUSE_INTERVAL_S = 0.05
    PAUSE_S = 0.002

    def pass_query(self, bench: Timeline) -> None:
        """Let 10 ms pass so that a loop of queries of the progress ends."""
        bench.advance(max(1, int(bench.rate / 100)))

    def wait(self, bench: Timeline, ready: Callable[[], bool], ticks_needed: Callable[[], int], timeout: float) -> bool:
        """See `Clock.wait`."""
        end = math.inf if timeout < 0 else bench.position + math.ceil(timeout * bench.rate - 1e-6)
        next_pause = time.monotonic() + self.PAUSE_INTERVAL_S
        while not ready():
            ticks = min(max(1, ticks_needed()), end - bench.position, math.ceil(bench.rate))
            if ticks <= 0:
                return False
            bench.advance(int(ticks))
            if time.monotonic() > next_pause:
                # `ready` may depend on the call of another client.
                bench.changed.wait(self.PAUSE_S)
                next_pause = time.monotonic() + self.PAUSE_INTERVAL_S
        return True


class ManualClock(Clock):
    """Time passes on request.

    >>> clock = ManualClock()
    >>> clock.advance(0.25)  # advances every bench on this clock by a quarter of a second
    """

    def __init__(self) -> None:
        self._benches: weakref.WeakSet[Timeline] = weakref.WeakSet()

    def start(self, bench: Timeline) -> None:
        """Register a bench, whose time `advance` then advances."""
        self._benches.add(bench)

    def advance(self, seconds: float) -> None:
        """Advance every bench of this clock by a time in s, rounded to ticks."""
        for bench in list(self._benches):
            with bench.changed:
                bench.advance(round(seconds * bench.rate))


class RealClock(Clock):
    """Bench time follows the wall clock, in a thread of the bench.

    The thread ends when no task needs the bench and restarts with the next task; bench time stops in between.
    """

    is_free_running = True
    # Interval at which bench time is updated [s]. On average, a reader waits half of this interval for its last sample.
    UPDATE_INTERVAL_S = 0.004
    # Upper limit of one step [s]: other threads need the lock between the steps.
    MAX_STEP_S = 0.04
    # Speed of a delayed bench, as a multiple of real time. At a higher speed, the buffers of clients would overflow.
    CATCH_UP_SPEED = 2.0
    # Interval at which a waiting call checks its condition.
    CHECK_INTERVAL_S = 0.02

    def __init__(self) -> None:
        self._running: weakref.WeakSet[Timeline] = weakref.WeakSet()

    def start(self, bench: Timeline) -> None:
        """Start a thread that advances a bench, unless there is one."""
        with bench.changed:
            if bench in self._running:
                return
            self._running.add(bench)
        threading.Thread(target=_keep_time, args=(weakref.ref(bench), self._running), name="bench", daemon=True).start()

    def wait(self, bench: Timeline, ready: Callable[[], bool], ticks_needed: Callable[[], int], timeout: float) -> bool:
        """See `Clock.wait`."""
        self.start(bench)
        end = math.inf if timeout < 0 else bench.position + timeout * bench.rate
        # The timeout is in bench time, which is late during compilation.
        while not ready() and bench.position < end and bench in self._running:
            # Check again after `CHECK_INTERVAL_S`, because the run may end early.
            ticks = min(max(1, ticks_needed()), math.ceil(self.CHECK_INTERVAL_S * bench.rate), end - bench.position)
            bench.sleepers.sleep(bench.position + math.ceil(ticks))
        return ready()


# A step of the bench that takes longer than this wall-clock time [s] is attributed to the compilation of kernels.
_COMPILATION_S = 1.0
# Maximum number of slow steps that are attributed to compilation; further slow steps have a different cause.
_MAX_COMPILATIONS = 20
# Shortest reported delay [s]: shorter delays are usual on a desktop computer.
_MIN_REPORTED_DELAY_S = 0.25
# Shortest interval [s] between two reports, so a slow computer does not flood the console.
_REPORT_INTERVAL_S = 10.0


class _DelayReport:
    """Logs the largest delay of the bench relative to the wall clock, when the bench has caught up."""

    def __init__(self) -> None:
        self._largest_s, self._reported_at_s = 0.0, -math.inf

    def add(self, delay_s: float, now_s: float) -> None:
        """Add the delay of the bench at a time of the wall clock."""
        self._largest_s = max(self._largest_s, delay_s)
        has_caught_up = delay_s < RealClock.MAX_STEP_S
        is_due = now_s - self._reported_at_s >= _REPORT_INTERVAL_S
        if self._largest_s >= _MIN_REPORTED_DELAY_S and has_caught_up and is_due:
            _LOG.warning(
                "the bench was up to %.2f s behind real time: samples were delayed. Run fewer programs on this "
                "machine, or enlarge the buffers of tasks.",
                self._largest_s,
            )
            self._largest_s, self._reported_at_s = 0.0, now_s


def longest_step(elapsed: float) -> float:
    """Return the longest step of a delayed bench [s] given the wall-clock time since the previous step [s].

    >>> longest_step(0.004), longest_step(1.0)
    (0.008, 0.04)
    """
    return min(RealClock.MAX_STEP_S, RealClock.CATCH_UP_SPEED * max(elapsed, RealClock.UPDATE_INTERVAL_S / 4))


def _keep_time(reference: weakref.ref[Timeline], running: weakref.WeakSet[Timeline]) -> None:
    """Keep a bench at wall-clock time while it is in use."""
    raise_priority()
    pause, delay_report = threading.Event(), _DelayReport()
    # Wall-clock time [ns], position and tick rate at one instant, from which the due position is computed.
    origin: tuple[int, int, float] | None = None
    n_compilations, last_ns = 0, time.monotonic_ns()  # wall-clock time of the last step
    while True:
        bench = reference()
        if bench is None:
            return
        with bench.changed:
            if not bench.is_in_use:
                running.discard(bench)
                bench.sleepers.wake()
                return
            now_ns = time.monotonic_ns()
            if origin is None or origin[2] != bench.rate or bench.position < origin[1]:
                origin = (now_ns, bench.position, bench.rate)
                bench.anchor()
            due_ticks = origin[1] + (now_ns - origin[0]) * bench.rate // 10**9 - bench.position
            elapsed, last_ns = (now_ns - last_ns) * 1e-9, now_ns
            if due_ticks > 0:
                try:
                    bench.advance(int(min(due_ticks, math.ceil(longest_step(elapsed) * bench.rate))))
                except BaseException as error:
                    running.discard(bench)
                    bench.fail(error)
                    return
                # The compilation of a kernel at its first use is not a delay of the scene.
                has_compiled = (
                    n_compilations < _MAX_COMPILATIONS and time.monotonic_ns() - now_ns > _COMPILATION_S * 1e9
                )
                n_compilations += has_compiled
                if has_compiled or bench.report_delay(due_ticks / bench.rate):
                    origin, due_ticks = None, 0
            delay_report.add(due_ticks / bench.rate, now_ns * 1e-9)
        is_late = due_ticks > RealClock.MAX_STEP_S * bench.rate
        del bench
        # Even if the bench is late, a pause lets other threads take the lock.
        pause.wait(RealClock.UPDATE_INTERVAL_S / 4 if is_late else RealClock.UPDATE_INTERVAL_S)


CLOCKS: dict[str, Callable[[], Clock]] = {"real": RealClock, "fast": FastClock, "manual": ManualClock}


def clock(name_or_clock: str | Clock) -> Clock:
    """Return a new clock by its name ('real', 'fast' or 'manual'); return a given clock unchanged.

    >>> type(clock("fast")).__name__
    'FastClock'
    """
    if not isinstance(name_or_clock, str):
        return name_or_clock
    if name_or_clock not in CLOCKS:
        raise SceneError(f"there is no clock {name_or_clock!r}. Choose real or fast; in Python, also manual.")
    return CLOCKS[name_or_clock]()
