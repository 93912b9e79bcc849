"""The chassis: runs the tasks of clients on the bench of a scene, on one clock.

There is an input for every channel of the scene (including the force of the hammer) and an output for every shaker.
Time is counted in ticks, the steps of the simulation of the bench. Tasks start at ticks. The outputs act on the inputs
through the simulated rig: shaker, structure and dampers. Tasks of any rate use this clock and may start in any order;
no task changes the sampling of another task.

An output keeps its last value when a task ends; `rig.scene.shaker.DRIVE_PER_VOLT` defines the effect of its voltage.
Bench time stops while no task needs the bench. The test of the scene is played until a task uses an output for the
first time, see `daq.instrument.background_test`.
"""

from __future__ import annotations

import threading
import time
import traceback
import weakref
from bisect import bisect_right
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from daq.instrument.clock import Clock, Sleepers
from daq.instrument.devices.modules import DeviceList, Module
from daq.instrument.engines.acquisition import Acquisition, InputPlan
from daq.instrument.engines.generation import Generation, OutputBuffer, OutputPlan
from daq.instrument.engines.triggers import AnalogSource, OtherTask
from daq.instrument.errors import Code, DaqError

if TYPE_CHECKING:
    from daq.instrument.settings.channels import Channel
    from daq.instrument.terminals import Terminals
    from daq.virtual_bench.bench import Bench, Block

# Longest step of the bench, ticks.
_MAX_BLOCK_TICKS = 4096
# More ticks than any run has.
UNLIMITED_TICKS = 1 << 62
# If the bench is later than this relative to the wall clock, its input buffers overflow.
_MAX_DELAY_S = 5.0
# Maximum pause of the fast clock for the callback of an event, in wall-clock time.
_CALLBACK_WAIT_S = 0.25
# Number of consecutive unanswered events after which the clock no longer waits for a listener.
_MAX_UNANSWERED = 8


class Runner(Protocol):
    """A task, as the chassis sees it."""

    name: str

    @property
    def device(self) -> str:
        """Name of the first device in use."""

    @property
    def sample_rate(self) -> float | None:
        """Sampling rate of its inputs, S/s; None on demand, or without inputs."""

    def max_ticks(self) -> int:
        """Return the number of ticks that may pass before `notify_samples` must be called."""

    def notify_samples(self) -> bool:
        """Process new samples; return whether a callback must finish before the next samples."""

    @property
    def callback_finished(self) -> bool:
        """Whether that callback has finished."""


class Chassis:
    """The instrument that is connected to a bench: its devices, its clock, and the tasks that use them.

    `modules` are the devices that scripts can use, including the chassis itself. `terminals` are those of a bench that
    has not been advanced yet. `clock` advances the bench.
    """

    def __init__(self, modules: Sequence[Module], terminals: Terminals, clock: Clock) -> None:
        self.devices, self.terminals, self.bench = DeviceList(modules), terminals, terminals.bench
        self.clock = clock
        lock = threading.RLock()
        # `changed` is notified when samples have passed; its lock protects the whole chassis.
        self.changed, self.sleepers = threading.Condition(lock), Sleepers(lock)
        # Called with every block at the sample rate of the bench, for example by the scope or a recording.
        self.listeners: list[Callable[[Bench, Block], None]] = []
        # Called with the inputs of a task before they are sampled.
        self.wiring_listeners: list[Callable[[Sequence[Channel]], None]] = []
        self.inputs: dict[Runner, Acquisition] = {}
        self.outputs: dict[Runner, Generation] = {}
        self._output_taken = False  # a task uses the outputs instead of the test of the scene
        self._read = False  # an acquisition has been started
        # Times of the bench, s, with the actions that are due then.
        self._alarms: list[tuple[float, Callable[[], None]]] = []
        # Resources of each task, with their names for messages; see `reserve`.
        self._reserved: dict[Runner, Mapping[Hashable, str]] = {}
        # Tasks that have been started and are still open: bench time runs for them.
        self._live_tasks: weakref.WeakSet[Any] = weakref.WeakSet()
        # Consecutive events of each task whose callback did not finish in time.
        self._unanswered: weakref.WeakKeyDictionary[Runner, int] = weakref.WeakKeyDictionary()
        self.tasks: dict[str, Runner] = {}
        self.position = 0  # ticks since the bench was switched on
        # Ticks and their wall-clock times, ns: bench time may stop and continue later.
        self._anchors: list[tuple[int, int]] = []
        self.anchor()
        self.last_volts = np.zeros(len(terminals.drive_per_volt))  # present voltage of each output

    def anchor(self) -> None:
        """Store the wall-clock time of the next tick; see `Timeline.anchor` in `daq.instrument.clock`."""
        # The fast and the manual clock have no date; their times count from power-on of the bench.
        now_ns = time.time_ns() if self.clock.runs_free else round(self.position * 1e9 / self.rate)
        self._anchors.append((self.position, now_ns))

    @property
    def rate(self) -> float:
        """Ticks of the bench's clock per second."""
        return self.bench.tick_rate

    @property
    def elapsed(self) -> float:
        """Seconds that have passed on the bench since it was connected."""
        return self.position / self.rate

    def at(self, seconds: float, action: Callable[[], None]) -> None:
        """Schedule an action at a time of the bench, s; see `elapsed`."""
        self._alarms.append((seconds, action))

    def pass_time(self, seconds: float) -> None:
        """Wait until a duration, s, has passed on the bench; on the wall clock while no task needs the bench."""
        with self.changed:
            end = self.position + round(seconds * self.rate)

            def has_passed() -> bool:
                return not self.live or self.position >= end

            if self.live:
                self.clock.wait(self, has_passed, lambda: end - self.position, -1.0)
                return
        if self.clock.runs_free:
            threading.Event().wait(seconds)

    def time_ns(self, tick: int) -> int:
        """Time of a tick, ns: since 1970 on the real clock, since power-on on the others."""
        anchor, anchor_ns = self._anchors[max(0, bisect_right(self._anchors, (tick, 1 << 63)) - 1)]
        return anchor_ns + round((tick - anchor) * 1e9 / self.rate)

    # Tasks

    def register(self, task: Runner, name: str) -> str:
        """Register a new task and return its name."""
        with self.changed:
            if not name:
                number = 0
                while f"_unnamedTask<{number:X}>" in self.tasks:
                    number += 1
                name = f"_unnamedTask<{number:X}>"
            elif name in self.tasks:
                raise DaqError(
                    f"there is a task named {name!r} already. Close it first, or choose another name.",
                    Code.DUPLICATE_TASK,
                )
            self.tasks[name] = task
            return name

    def unregister(self, task: Runner) -> None:
        """Remove a closed task."""
        with self.changed:
            self.release(task)
            self._live_tasks.discard(task)
            self.tasks.pop(task.name, None)

    def reserve(self, task: Runner, resources: Mapping[Hashable, str]) -> None:
        """Reserve the resources that a task needs.

        `resources` maps each resource to its name for messages. A resource is the inputs of a device (text), or a
        drive of the bench (its row, an integer). Raises `DaqError` -50103 if another task has reserved a resource.
        """
        with self.changed:
            for other, reserved in self._reserved.items():
                conflicts = [name for resource, name in resources.items() if resource in reserved]
                if other is not task and conflicts:
                    raise DaqError(
                        f"{', '.join(sorted(conflicts))} is in use by task {other.name!r}. Stop or close that task, or "
                        "put the channels into one task.",
                        Code.PAL_RESOURCE_RESERVED,
                    )
            if any(isinstance(resource, int) for resource in resources) and not self._output_taken:
                self._output_taken = True
                self.terminals.release_outputs()
            self._reserved[task] = resources

    def release(self, task: Runner) -> None:
        """Stop running a task and release the resources that it reserved."""
        with self.changed:
            self._reserved.pop(task, None)
            self.halt(task)

    def return_outputs(self) -> None:
        """Return the outputs to the test of the scene; `DaqError` -50103 while a task has reserved an output."""
        with self.changed:
            for task, resources in self._reserved.items():
                if names := [name for resource, name in resources.items() if isinstance(resource, int)]:
                    raise DaqError(
                        f"{', '.join(sorted(names))} is in use by task {task.name!r}. Stop or close that task.",
                        Code.PAL_RESOURCE_RESERVED,
                    )
            self._output_taken = False

    def halt(self, task: Runner) -> None:
        """Stop running a task; its resources stay reserved."""
        with self.changed:
            self.inputs.pop(task, None)
            self.outputs.pop(task, None)
            self._wake_all()

    def keep_time_running(self, task: Runner) -> None:
        """Keep bench time running from now on, until this task is closed."""
        with self.changed:
            if not self.live:
                self.anchor()
            self._live_tasks.add(task)
            self.clock.start(self)

    @property
    def live(self) -> bool:
        """Whether any task that has been started is still open."""
        return len(self._live_tasks) > 0

    def wire(self, task: Runner, channels: Sequence[Channel]) -> None:
        """Set the input couplings and sensor supplies of a task's channels; see `Terminals.wire`."""
        in_use = {row for other, acquisition in self.inputs.items() if other is not task for row in acquisition.plan.rows}
        self.terminals.wire(channels, in_use)
        for listener in self.wiring_listeners:
            listener(channels)

    def run_input(self, task: Runner, plan: InputPlan) -> Acquisition:
        """Start an acquisition at the present tick and return it."""
        self._read = True
        self.inputs[task] = Acquisition(plan, self.rate, self.position, self.terminals.dtype)
        return self.inputs[task]

    def run_output(self, task: Runner, plan: OutputPlan, buffer: OutputBuffer) -> Generation:
        """Start a generation of voltages from a buffer at the present tick and return it."""
        self.outputs[task] = Generation(plan, buffer, self.position, self.last_volts[list(plan.rows)])
        return self.outputs[task]

    @property
    def read_at_rest(self) -> bool:
        """Whether inputs were read, but neither a task nor the test has excited the bench."""
        return self._read and not self._output_taken and self.terminals.quiet

    def wait(self, ready: Callable[[], bool], missing: Callable[[], int], timeout: float) -> bool:
        """Wait until a condition is met, and return whether it was; see `Clock.wait`."""
        return self.clock.wait(self, ready, missing, timeout)

    # Time

    def advance(self, ticks: int) -> None:
        """Advance the bench: outputs drive the plant, inputs store the samples, events are sent."""
        with self.changed:
            target = self.position + ticks
            while self.position < target:
                self._step(target - self.position)

    def _step(self, limit: int) -> None:
        """Advance by at most `limit` ticks, such that every event is processed at its tick."""
        terminals, tick = self.terminals, self.position
        ticks = terminals.limit_ticks(min(limit, _MAX_BLOCK_TICKS, self._ticks_to_output()))
        for task in (*self.inputs, *self.outputs):
            ticks = max(1, min(ticks, task.max_ticks()))
        volts = None
        if self._output_taken:
            volts = np.repeat(self.last_volts[:, None], ticks, axis=1)
            for generation in self.outputs.values():
                rows = list(generation.plan.rows)
                volts[rows] = generation.produce(tick, ticks, self.event_tick)
                self.last_volts[rows] = generation.last_volts
        # Include the rates of tasks that are only configured: their filters continue while the tasks do not run.
        rates = {rate for task in self.tasks.values() if (rate := task.sample_rate) is not None}
        rates |= {acquisition.plan.rate for acquisition in self.inputs.values()}
        blocks = terminals.advance(volts, ticks, rates)
        self.position += ticks
        # Tasks that other tasks start are processed last.
        in_order = sorted(self.inputs.values(), key=lambda run: isinstance(run.plan.start, OtherTask))
        for acquisition in in_order:
            self._pass_block(acquisition, blocks[acquisition.plan.rate])
        full_rate = blocks[self.bench.rate]
        for listener in self.listeners if full_rate.samples.size else ():
            listener(self.bench, full_rate)
        self.changed.notify_all()
        self.sleepers.wake(self.position)
        notified = [task for task in (*self.inputs, *self.outputs) if task.notify_samples()]
        if notified and not self.clock.runs_free:
            self._await_callbacks(notified)
        for alarm in [alarm for alarm in self._alarms if alarm[0] <= self.elapsed]:
            self._alarms.remove(alarm)
            alarm[1]()

    def _await_callbacks(self, notified: Sequence[Runner]) -> None:
        """Wait for callbacks of events, except those that did not answer several events in a row."""
        awaited = [task for task in notified if self._unanswered.get(task, 0) < _MAX_UNANSWERED]
        self.changed.wait_for(lambda: all(task.callback_finished for task in awaited), _CALLBACK_WAIT_S)
        for task in notified:
            self._unanswered[task] = 0 if task.callback_finished else self._unanswered.get(task, 0) + 1

    def _pass_block(self, acquisition: Acquisition, block: Block) -> None:
        """Pass samples to an acquisition, up to the first sample that was lost after the converter."""
        if acquisition.done:
            return
        stop = block.first + block.samples.shape[1]
        losses = self.bench.lost_at(acquisition.plan.rate)
        lost = [first for first, last in losses if block.first <= last and first < stop]
        valid = slice(0, max(0, min(lost) - block.first)) if lost else slice(None)
        samples, overload = block.samples[:, valid], block.overload[:, valid]
        if samples.shape[1]:
            acquisition.add_block(block.first, samples, overload, self.event_tick)
        if lost and not acquisition.done:
            acquisition.stop(
                DaqError(
                    f"the samples from number {min(lost)} were lost after the converter, as the scene requires "
                    "(converter.dropped_blocks). Stop and start the task to acquire again.",
                    Code.INPUT_FIFO_OVERFLOW_2,
                )
            )

    def event_tick(self, source: OtherTask) -> int | None:
        """Return the tick of the start or reference trigger of the task that `source` names; None before it."""
        runs: dict[Any, Any] = self.inputs if source.kind == "ai" else self.outputs
        device = source.device.lower()
        on_device = [run for task, run in runs.items() if device and task.device.lower().startswith(device)]
        for run in on_device or runs.values():
            tick = run.start_tick(source.reference, self.position)
            if tick is not None:
                return tick
        return None

    def _ticks_to_output(self) -> int:
        """Return the number of ticks until the next sample of an input that may start an output."""
        awaited = [
            run.plan.start
            for run in self.outputs.values()
            if not run.has_started and isinstance(run.plan.start, OtherTask) and run.plan.start.kind == "ai"
        ]
        return min(
            (
                run.ticks_until(1, self.position)
                for source in awaited
                for run in self.inputs.values()
                if (source.reference or (not run.has_started and isinstance(run.plan.start, AnalogSource)))
                and self.event_tick(source) is None
            ),
            default=_MAX_BLOCK_TICKS,
        )

    def fail(self, error: BaseException) -> None:
        """Report a failure of the simulation, and end all waiting calls."""
        traceback.print_exception(error)
        self._stop_all(
            DaqError(f"the simulation of the scene has failed: {error!r}. Change the scene or the drive.", Code.UNKNOWN)
        )

    def _stop_all(self, error: DaqError) -> None:
        with self.changed:
            for acquisition in self.inputs.values():
                acquisition.stop(error)
            for generation in self.outputs.values():
                generation.stop(error)
            self._wake_all()
            for task in (*self.inputs, *self.outputs):
                task.notify_samples()

    def _wake_all(self) -> None:
        """Wake all waiting threads: the condition for which they wait may have changed."""
        self.changed.notify_all()
        self.sleepers.wake()

    def report_delay(self, seconds: float) -> bool:
        """Return whether a delay relative to the wall clock, s, overflows the buffers; if so, stop all runs."""
        if seconds < _MAX_DELAY_S:
            return False
        self._stop_all(
            DaqError(
                f"input overflow: this machine simulates the scene {seconds:.0f} s behind real time. Lower the rates, "
                "simplify the scene or use the fast clock.",
                Code.INPUT_FIFO_OVERFLOW_2,
            )
        )
        return True
