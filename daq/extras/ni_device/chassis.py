"""The chassis: runs the tasks of clients on the bench of a scene, on one clock.

There is an input for every channel of the scene (including the force of the hammer) and an output for every shaker.
The outputs act on the inputs through the simulated rig: shaker, structure and dampers. Time is counted in ticks, the
time steps of the bench. A task starts at a tick. Tasks may have any rates and start in any order; no task changes the
sampling of another task.

An output keeps its last voltage when a task ends; `rig.core.scene.shaker.DRIVE_PER_VOLT` defines the effect of its
voltage. Bench time runs only while a started task is open. The test of the scene runs until a task uses an output for
the first time, see `daq.extras.ni_device.background_test`.
"""

import math
import sys
import threading
import time
import weakref
from bisect import bisect_right
from collections.abc import Callable, Container, Hashable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from daq.core.virtual_bench.bench import Bench, Block
from daq.extras.ni_device.clock import Clock, Sleepers
from daq.extras.ni_device.devices.modules import DeviceList, Module
from daq.extras.ni_device.engines.acquisition import Acquisition, InputPlan
from daq.extras.ni_device.engines.generation import Generation, OutputBuffer, OutputPlan
from daq.extras.ni_device.engines.triggers import AnalogSource, OtherTask
from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_device.events import Events
from daq.extras.ni_device.settings.channels import Channel
from daq.extras.ni_device.terminals import Terminals
from rig.core.base.arrays import Array
from rig.core.base.errors import RunError, ShotrigError, unexpected_text

# A number of ticks that exceeds any run, and whose sums do not overflow 64 bits.
UNLIMITED_TICKS = 1 << 62
# Delay behind the wall clock [s] that stops runs: the buffer of a real device would have overflowed.
_MAX_DELAY_S = 5.0
# Longest pause [s] of the fast clock for a callback or a write, which must not stop the bench if it never comes.
_CALLBACK_WAIT_S = 0.25
# Number of consecutive events with a late callback after which the clock no longer waits for the callbacks of a task.
_MAX_UNANSWERED = 8


class Runner(Protocol):
    """Interface of a task to the chassis."""

    name: str
    events: Events

    @property
    def device(self) -> str:
        """Name of the first device in use."""

    def provides(self, source: OtherTask) -> bool:
        """Return whether a trigger terminal is on its device."""

    @property
    def sample_rate(self) -> float | None:
        """Sample rate of its inputs, S/s; None on demand, or without inputs."""

    def max_ticks(self) -> int:
        """Return the number of ticks that may pass before `notify_samples` must be called."""

    def notify_samples(self) -> bool:
        """Process new samples and send events; return whether a callback must finish before the next samples."""

    @property
    def callback_finished(self) -> bool:
        """Whether the callback for `notify_samples` has finished: all samples have been read."""


class Chassis:
    """The instrument that is connected to a bench: its devices, its clock, and the tasks that use them.

    `modules` are the devices that scripts can use, including the chassis itself. `terminals` connect a bench that has
    not been advanced yet. `clock` advances the bench.
    """

    def __init__(self, modules: Sequence[Module], terminals: Terminals, clock: Clock) -> None:
        self.devices, self.terminals, self.bench = DeviceList(modules), terminals, terminals.bench
        self.clock = clock
        lock = threading.RLock()
        # `changed` is notified when samples have passed; its lock protects the whole chassis.
        self.changed, self.sleepers = threading.Condition(lock), Sleepers(lock)
        # Listeners, such as a recording. Each is called with every block of samples at the sample rate of the bench.
        self.listeners: list[Callable[[Bench, Block], None]] = []
        # Called with name ("start", "read", "write") and task before a call; may raise the `DaqError` of the call.
        self.call_listeners: list[Callable[[str, Any], None]] = []
        # Called after a read or write with the task, the samples, shape (channels, n), and the error of the call.
        self.transfer_listeners: list[Callable[[Any, Array, DaqError | None], None]] = []
        # Called with the inputs of a task before the inputs are sampled.
        self.conditioning_listeners: list[Callable[[Sequence[Channel]], None]] = []
        self.inputs: dict[Runner, Acquisition] = {}
        self.outputs: dict[Runner, Generation] = {}
        self._tasks_drive_outputs = False  # tasks, no longer the test of the scene, drive the outputs
        self._has_acquired = False  # an acquisition has been started
        # Resources of each task, and their names for messages; see `reserve`.
        self._reserved: dict[Runner, Mapping[Hashable, str]] = {}
        # Tasks that have been started and not closed; bench time runs while there is such a task.
        self._open_tasks: weakref.WeakSet[Any] = weakref.WeakSet()
        # Number of consecutive events of each task whose callback did not finish in time.
        self._unanswered: weakref.WeakKeyDictionary[Runner, int] = weakref.WeakKeyDictionary()
        self.tasks: dict[str, Runner] = {}
        # Reasons for which the simulation, a recording or a display has ended early.
        self.problems: list[str] = []
        self.position = 0  # ticks since the bench was switched on
        # Ticks at which bench time continued after a stop, and their wall-clock times [ns].
        self._anchors: list[tuple[int, int]] = []
        self.anchor()
        self.last_volts = np.zeros(len(terminals.drive_per_volt))  # present voltage of each output

    def anchor(self) -> None:
        """Store the wall-clock time of the next tick; see `Timeline.anchor` in `daq.extras.ni_device.clock`."""
        # Times of the fast and the manual clock count from power-on of the bench, not from 1970.
        now_ns = time.time_ns() if self.clock.is_free_running else round(self.position * 1e9 / self.rate)
        self._anchors.append((self.position, now_ns))

    @property
    def rate(self) -> float:
        """Ticks of the bench's clock per second."""
        return self.bench.tick_rate

    @property
    def elapsed(self) -> float:
        """Time that has passed on the bench since power-on [s]."""
        return self.position / self.rate

    def pass_time(self, seconds: float) -> None:
        """Wait for a duration [s] in bench time; while bench time is stopped, wait only on the real clock."""
        with self.changed:
            end = self.position + round(seconds * self.rate)

            def has_passed() -> bool:
                return not self.is_in_use or self.position >= end

            if self.is_in_use:
                self.clock.wait(self, has_passed, lambda: end - self.position, -1.0)
                return
        if self.clock.is_free_running:
            threading.Event().wait(seconds)

    def time_ns(self, tick: int) -> int:
        """Return the time of a tick [ns]: since 1970 on the real clock, since power-on on the other clocks."""
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
            self._open_tasks.discard(task)
            self.tasks.pop(task.name, None)

    def reserve(self, task: Runner, resources: Mapping[Hashable, str]) -> None:
        """Reserve the resources that a task needs.

        `resources` maps each resource to its name for messages. A resource is all inputs of a device (a string), or an
        output (its index on the bench). Raises `DaqError` -50103 if another task has reserved a resource.
        """
        with self.changed:
            for other, reserved in self._reserved.items():
                conflicts = [name for resource, name in resources.items() if resource in reserved]
                if other is not task and conflicts:
                    raise DaqError(
                        f"{', '.join(sorted(conflicts))} is in use by task {other.name!r}. Stop or close that task, or "
                        "put all channels into one task.",
                        Code.PAL_RESOURCE_RESERVED,
                    )
            if any(isinstance(resource, int) for resource in resources) and not self._tasks_drive_outputs:
                self._tasks_drive_outputs = True
                self.terminals.release_outputs()
            self._reserved[task] = resources

    def release(self, task: Runner) -> None:
        """Stop the run of a task and release the resources that it reserved."""
        with self.changed:
            self._reserved.pop(task, None)
            self.halt(task)

    def return_outputs(self) -> None:
        """Let the test of the scene drive the outputs again. Raises `DaqError` -50103 if a task reserves an output."""
        with self.changed:
            for task, resources in self._reserved.items():
                if names := [name for resource, name in resources.items() if isinstance(resource, int)]:
                    raise DaqError(
                        f"{', '.join(sorted(names))} is in use by task {task.name!r}. Stop or close that task.",
                        Code.PAL_RESOURCE_RESERVED,
                    )
            self._tasks_drive_outputs = False

    def halt(self, task: Runner) -> None:
        """Stop the run of a task; its resources remain reserved."""
        with self.changed:
            self.inputs.pop(task, None)
            self.outputs.pop(task, None)
            self._wake_all()

    def keep_time_running(self, task: Runner) -> None:
        """Keep bench time running from now on, until this task is closed."""
        with self.changed:
            if not self.is_in_use:
                self.anchor()
            self._open_tasks.add(task)
            self.clock.start(self)

    @property
    def is_in_use(self) -> bool:
        """Whether a task that has been started is still open, so bench time runs."""
        return len(self._open_tasks) > 0

    def set_conditioning(self, task: Runner, channels: Sequence[Channel]) -> None:
        """Set the input couplings and sensor supplies of a task's channels; see `Terminals.set_conditioning`."""
        in_use = {
            index
            for other, acquisition in self.inputs.items()
            if other is not task
            for index in acquisition.plan.bench_indices
        }
        self.terminals.set_conditioning(channels, in_use)
        for listener in self.conditioning_listeners:
            listener(channels)

    def run_input(self, task: Runner, plan: InputPlan) -> Acquisition:
        """Start an acquisition at the present tick and return it."""
        self._has_acquired = True
        self.inputs[task] = Acquisition(plan, self.rate, self.position, self.terminals.dtype)
        return self.inputs[task]

    def run_output(self, task: Runner, plan: OutputPlan, buffer: OutputBuffer) -> Generation:
        """Start a generation of voltages from a buffer at the present tick and return it."""
        self.outputs[task] = Generation(plan, buffer, self.position, self.last_volts[list(plan.bench_indices)])
        return self.outputs[task]

    @property
    def was_read_without_drive(self) -> bool:
        """Whether an acquisition was started, but neither a task nor the test has driven the bench."""
        return self._has_acquired and not self._tasks_drive_outputs and self.terminals.is_idle

    def wait(self, ready: Callable[[], bool], ticks_needed: Callable[[], int], timeout: float) -> bool:
        """Wait until a condition is met, and return whether it was; see `Clock.wait`."""
        return self.clock.wait(self, ready, ticks_needed, timeout)

    # Time

    def advance(self, ticks: int) -> None:
        """Advance the bench by a number of ticks: generate outputs, acquire inputs, and send events."""
        with self.changed:
            target = self.position + ticks
            while self.position < target:
                self._step(target)

    def _step(self, target: int) -> None:
        """Advance to at most the tick `target`, and not beyond the next event that must be processed at its tick."""
        # Other threads may advance the bench during this wait.
        present = math.inf if self.clock.is_free_running else self._ticks_with_samples()
        terminals, tick = self.terminals, self.position
        if tick >= target:
            return
        ticks = terminals.limit_ticks(min(target - tick, self._ticks_to_awaited_trigger()))
        for task in (*self.inputs, *self.outputs):
            ticks = max(1, min(ticks, task.max_ticks()))
        ticks = int(min(ticks, present))
        volts = None
        if self._tasks_drive_outputs:
            volts = np.repeat(self.last_volts[:, None], ticks, axis=1)
            for generation in self.outputs.values():
                bench_indices = list(generation.plan.bench_indices)
                volts[bench_indices] = generation.produce(tick, ticks, self.event_tick)
                self.last_volts[bench_indices] = generation.last_volts
        # Rates of tasks that are not running are included, so the filters remain settled.
        rates = {rate for task in self.tasks.values() if (rate := task.sample_rate) is not None}
        rates |= {acquisition.plan.rate for acquisition in self.inputs.values()}
        blocks = terminals.advance(volts, ticks, rates)
        self.position += ticks
        # Tasks that are started by other tasks are processed last.
        in_order = sorted(self.inputs.values(), key=lambda run: isinstance(run.plan.start, OtherTask))
        for acquisition in in_order:
            self._pass_block(acquisition, blocks[acquisition.plan.rate])
        bench_block = blocks[self.bench.rate]
        for listener in self.listeners if bench_block.samples.size else ():
            listener(self.bench, bench_block)
        self.changed.notify_all()
        self.sleepers.wake(self.position)
        notified = [task for task in (*self.inputs, *self.outputs) if task.notify_samples()]
        if notified and not self.clock.is_free_running:
            self._await_callbacks(notified)

    def _ticks_with_samples(self) -> float:
        """Wait for threads that write samples; return the ticks for which all outputs have samples, or infinity."""

        def present_limit() -> float:
            return min((run.ticks_to_last_written() for run in self.outputs.values()), default=math.inf)

        self.changed.wait_for(lambda: present_limit() > 0, _CALLBACK_WAIT_S)
        limit = present_limit()
        return limit if limit > 0 else math.inf

    def _await_callbacks(self, notified: Sequence[Runner]) -> None:
        """Wait for the callbacks of tasks, except of tasks whose callbacks were late at several events in a row."""
        awaited = [task for task in notified if self._unanswered.get(task, 0) < _MAX_UNANSWERED]
        self.changed.wait_for(lambda: all(task.callback_finished for task in awaited), _CALLBACK_WAIT_S)
        for task in notified:
            self._unanswered[task] = 0 if task.callback_finished else self._unanswered.get(task, 0) + 1

    def _pass_block(self, acquisition: Acquisition, block: Block) -> None:
        """Pass a block to an acquisition; stop it at the first sample that was lost after the converter."""
        if acquisition.done:
            return
        stop = block.first + block.samples.shape[1]
        lost_ranges = self.bench.lost_at(acquisition.plan.rate)
        lost_from = [first for first, last in lost_ranges if block.first <= last and first < stop]
        valid = slice(0, max(0, min(lost_from) - block.first)) if lost_from else slice(None)
        samples, overload = block.samples[:, valid], block.overload[:, valid]
        if samples.shape[1]:
            acquisition.add_block(block.first, samples, overload, self.event_tick)
        if lost_from and not acquisition.done:
            acquisition.stop(
                DaqError(
                    f"the samples from number {min(lost_from)} on were lost after the converter, as the scene requires "
                    "(converter.dropped_blocks). Stop and start the task to acquire again.",
                    Code.INPUT_FIFO_OVERFLOW_2,
                )
            )

    def event_tick(self, source: OtherTask) -> int | None:
        """Return the tick of a trigger of another task; None before it."""
        runs: dict[Runner, Any] = {**self.inputs} if source.direction == "ai" else {**self.outputs}
        ticks = (run.start_tick(source.reference, self.position) for task, run in runs.items() if task.provides(source))
        return next((tick for tick in ticks if tick is not None), None)

    def terminal_owner(self, module: Module) -> str:
        """Return the chassis of a module, or the separate device, in lower case; empty for a name of other hardware."""
        owner = (module.chassis or module.name).lower()
        return owner if owner in [name.lower() for name in self.devices.names] else ""

    def _ticks_to_awaited_trigger(self) -> int:
        """Return the number of ticks until the next sample of an input whose trigger starts an output."""
        awaited_sources = [
            run.plan.start
            for run in self.outputs.values()
            if not run.has_started and isinstance(run.plan.start, OtherTask) and run.plan.start.direction == "ai"
        ]
        return min(
            (
                run.ticks_until(1, self.position)
                for source in awaited_sources
                for run in self.inputs.values()
                if (source.reference or (not run.has_started and isinstance(run.plan.start, AnalogSource)))
                and self.event_tick(source) is None
            ),
            default=UNLIMITED_TICKS,
        )

    def report_problem(self, part: str, error: BaseException) -> str:
        """Report on stderr that a part of the instrument has ended early, and add this to `problems`; return it."""
        reason = str(error) if isinstance(error, ShotrigError | OSError) else unexpected_text(error)
        self.problems.append(f"{part} has ended: {reason}")
        # The terminal may be closed already.
        with suppress(OSError):
            print(self.problems[-1], file=sys.stderr, flush=True)
        return self.problems[-1]

    def raise_problems(self) -> None:
        """Raise `RunError` if a part of the instrument has ended early."""
        if self.problems:
            raise RunError("\n".join(self.problems))

    def fail(self, error: BaseException) -> None:
        """Report an error of the simulation, and end all waiting calls."""
        self.stop_runs(DaqError(self.report_problem("the simulation of the scene", error), Code.UNKNOWN))

    def stop_runs(self, error: DaqError, devices: Container[str] | None = None) -> None:
        """Stop with an error the runs of all tasks, or of the tasks on some devices (names in lower case)."""
        with self.changed:
            runs: dict[Runner, Acquisition | Generation] = {**self.inputs, **self.outputs}
            stopped = [task for task in runs if devices is None or task.device.lower() in devices]
            for task in stopped:
                runs[task].stop(error)
            self._wake_all()
            for task in stopped:
                task.notify_samples()

    def _wake_all(self) -> None:
        """Wake all waiting threads, because their conditions may have changed."""
        self.changed.notify_all()
        self.sleepers.wake()

    def report_delay(self, seconds: float) -> bool:
        """Stop all runs if the delay relative to the wall clock, s, exceeds `_MAX_DELAY_S`; return whether it does."""
        if seconds < _MAX_DELAY_S:
            return False
        self.stop_runs(
            DaqError(
                f"input overflow: this machine simulates the scene {seconds:.0f} s behind real time. Lower the rates, "
                "simplify the scene or use the fast clock.",
                Code.INPUT_FIFO_OVERFLOW_2,
            )
        )
        return True
