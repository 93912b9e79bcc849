"""The chassis on the bench: one sample clock, the modules on it, and the tasks that run on them.

There is an input for every channel of the scene (the hammer's force among them) and an output, `ao0`, to the
shaker amplifier. Time is counted in samples of that one clock: what runs together is simultaneous to the
sample, and the output acts on the inputs through the plant.

What an output volt does depends on the shaker: a volt at the amplifier (electrodynamic), a newton (kind
force), a millimetre of table travel (kind table). The output keeps its last value when a task ends. The
bench stands still while no task needs it.

As long as no script has ever taken the output, the scene's own test is played (see
`daq.instrument.background_test`), so that
there is something to measure and to trigger on. The hammer of an impulse scene goes on hitting in any case.
"""

from __future__ import annotations

import math
import threading
import time
import traceback
import warnings
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

import rig
from daq.face.triggers import OtherTask
from daq.instrument.acquisition import Acquisition
from daq.instrument.background_test import Operator
from daq.instrument.clock import Clock
from daq.instrument.errors import DaqError, DAQmxErrors
from daq.instrument.generation import Generation
from daq.instrument.sample_rates import coerced
from daq.signal_chain.bench import AcquiredBlock, Bench
from daq.signal_chain.channel import ChannelInfo
from rig.errors import SceneError
from rig.scene.measurement_chain import Converter
from rig.scene.presets import filled_in

if TYPE_CHECKING:
    from daq.face.task import Task

# What a volt at the output becomes, by the unit of the shaker's drive.
DRIVE_PER_VOLT = {"V": 1.0, "N": 1.0, "m": 1e-3}

_BLOCK = 4096
# The bench may fall behind the wall clock by this long before its inputs count as overflown, s.
_PATIENCE = 5.0


class Chassis:
    """Devices in front of a bench.

    Parameters
    ----------
    scene : Scene
        What is on the bench.
    clock : Clock
        What lets its time pass.

    Attributes
    ----------
    position : int
        Samples that have passed since the bench was switched on; a change of rate switches it on anew, at
        rest.
    changed : threading.Condition
        Notified when samples have passed; its lock guards everything here.
    """

    def __init__(self, scene: rig.Scene, clock: Clock) -> None:
        self.scene, self.clock = scene, clock
        self.changed = threading.Condition(threading.RLock())
        self.position = 0
        self.running_inputs: dict[Task, Acquisition] = {}
        self.running_outputs: dict[Task, Generation] = {}
        self.held = np.zeros(1)
        self._output_taken = False
        self._passed = 0.0
        self._alarms: list[tuple[float, Callable[[], None]]] = []
        self._reserved: weakref.WeakKeyDictionary[Task, tuple[str, ...]] = weakref.WeakKeyDictionary()
        self._awake: weakref.WeakSet[Task] = weakref.WeakSet()
        self._names: weakref.WeakValueDictionary[str, Task] = weakref.WeakValueDictionary()
        self._switch_on(self.coerce_rate(scene.converter.rate))

    def _switch_on(self, rate: float) -> None:
        scene = self.scene
        if rate != scene.converter.rate:
            scene = _at_rate(scene, rate)
        self._passed = self.elapsed if self.position else self._passed
        self._bench = Bench(scene)
        if self.clock.runs_free:
            # What has to be compiled is compiled before time begins to run: reads would wait for it in vain.
            Bench(scene).acquire(np.zeros((len(self._bench.inputs), 64)))
        self._operator = Operator(self._bench)
        if self._output_taken:
            self._operator.leave_shaker()
        self.position = 0
        # The fast and the manual clock know no date; times are then counted from the bench's power-on.
        self._epoch_ns = time.time_ns() if self.clock.runs_free else 0

    @property
    def rate(self) -> float:
        """Samples per second of the bench's clock."""
        return self._bench.rate

    @property
    def bench_scene(self) -> rig.Scene:
        """The scene with the rate the clock runs at."""
        return self._bench.scene

    @property
    def elapsed(self) -> float:
        """Seconds that have passed on the bench since it was connected."""
        return self._passed + (self.position / self.rate if self.position else 0.0)

    def at(self, seconds: float, action: Callable[[], None]) -> None:
        """Have something done once so many seconds have passed on the bench."""
        self._alarms.append((seconds, action))

    def pass_time(self, seconds: float) -> None:
        """Let some bench time pass; while no task needs the bench, the wall clock's."""
        with self.changed:
            bench, end = self._bench, self.position + round(seconds * self.rate)

            def over() -> bool:
                return not self.live or self._bench is not bench or self.position >= end

            if self.live:
                self.clock.wait(self, over, lambda: end - self.position, -1.0)
                return
        if self.clock.runs_free:
            threading.Event().wait(seconds)

    def time_ns(self, tick: int) -> int:
        """Time of a tick, ns: since 1970 on the real clock, since power-on on the others."""
        return self._epoch_ns + round(tick * 1e9 / self.rate)

    @property
    def inputs(self) -> tuple[ChannelInfo, ...]:
        """What is connected to ai0, ai1, ...; each tells where it sits, what it measures, its sensitivity."""
        return self._bench.channels

    @property
    def outputs(self) -> int:
        """Number of analog outputs: one if the scene has a shaker."""
        return int("shaker" in self._bench.inputs)

    @property
    def drive_per_volt(self) -> float:
        """What a volt at ao0 becomes, in the unit of the shaker's drive (V, N or m)."""
        return DRIVE_PER_VOLT[self._bench.drive_units[self._bench.inputs.index("shaker")]]

    @property
    def input_range(self) -> float:
        """Full scale of the inputs, ± V; infinite if the scene's converter has no range."""
        return float(self.converter.range or math.inf)

    @property
    def converter(self) -> Converter:
        """The scene's converter, with what its module's datasheet fills in."""
        return filled_in(self.scene.converter)

    def coerce_rate(self, rate: float) -> float:
        """Give the rate the sample clock makes of a request, see `daq.instrument.sample_rates`."""
        return coerced(rate, self.scene.converter)

    # Tasks

    def admit(self, task: Task, name: str) -> str:
        """Take a new task in and give it its name."""
        with self.changed:
            if not name:
                number = 0
                while f"_unnamedTask<{number}>" in self._names:
                    number += 1
                name = f"_unnamedTask<{number}>"
            elif name in self._names:
                raise DaqError(
                    f"there is a task named {name!r} already: close it first, or choose another name",
                    DAQmxErrors.DUPLICATE_TASK,
                )
            self._names[name] = task
            return name

    def dismiss(self, task: Task) -> None:
        """Forget a task that has been closed."""
        with self.changed:
            self.release(task)
            self._awake.discard(task)
            self._names.pop(task.name, None)

    def reserve(self, task: Task, resources: tuple[str, ...], rate: float | None) -> None:
        """Reserve modules for a task and set the clock to its rate.

        Raises
        ------
        DaqError
            With -50103, if another task has a module, or runs the clock at another rate.
        """
        with self.changed:
            for other, theirs in self._reserved.items():
                shared = set(resources) & set(theirs)
                if other is task or not (shared or (rate is not None and rate != self.rate)):
                    continue
                what = (
                    f"{', '.join(sorted(shared))} is in use"
                    if shared
                    else f"the sample clock runs at {self.rate:g} S/s"
                )
                raise DaqError(
                    f"the resource is reserved: {what} by task {other.name!r}; stop or close that task, "
                    "put the "
                    "channels into one task, or let both run at one rate",
                    DAQmxErrors.PAL_RESOURCE_RESERVED,
                    task.name,
                )
            if rate is not None and rate != self.rate:
                self._switch_on(rate)
            if "ao0" in resources:
                self._output_taken = True
                self._operator.leave_shaker()
            self._reserved[task] = resources

    def release(self, task: Task) -> None:
        """Give back what a task reserved and run it no more."""
        with self.changed:
            self._reserved.pop(task, None)
            self.running_inputs.pop(task, None)
            self.running_outputs.pop(task, None)
            self.changed.notify_all()

    def wake(self, task: Task) -> None:
        """Let time pass from now on, for as long as this task is open."""
        with self.changed:
            self._awake.add(task)
            self.clock.start(self)

    @property
    def live(self) -> bool:
        """Whether any task that has been started is still open."""
        return len(self._awake) > 0

    @property
    def samples_dtype(self) -> type[np.generic]:
        """Kind of the converter's samples."""
        return np.float64 if self.inputs and self.inputs[0].volts_per_count is None else np.int32

    # Time

    def advance(self, samples: int) -> None:
        """Let samples pass: outputs drive the plant, inputs take what comes, callbacks are called."""
        with self.changed:
            bench, target = self._bench, self.position + samples
            while self._bench is bench and self.position < target:
                self._step(target - self.position)

    def _step(self, limit: int) -> None:
        bench, tick = self._bench, self.position
        samples = self._operator.horizon(min(limit, _BLOCK))
        if self._output_waits_on_data():
            samples = 1
        for task in self.running_inputs:
            samples = min(samples, task.run.log_horizon())
        if not self.clock.runs_free:
            # Callbacks come exactly when they are due, so that what they find does not depend on who waits.
            for task in [*self.running_inputs, *self.running_outputs]:
                samples = min(samples, task.events.horizon())
        drive = self._operator.drive(samples).copy()
        if self._output_taken and self.outputs:
            shaker = bench.inputs.index("shaker")
            drive[shaker] = self.held[0]
            for generation in self.running_outputs.values():
                drive[shaker] = generation.produce(tick, samples, self.moment)[0]
                self.held = generation.held
            drive[shaker] *= self.drive_per_volt
        block = bench.acquire(drive)
        self.position += samples
        # Tasks that wait for others come last.
        for acquisition in sorted(
            self.running_inputs.values(), key=lambda each: isinstance(each.plan.start, OtherTask)
        ):
            self._give(acquisition, block)
        self._operator.hear(block.samples, samples)
        for task in [*self.running_inputs, *self.running_outputs]:
            task.run.log_samples()
        self.changed.notify_all()
        if not self.clock.runs_free:
            for task in [*self.running_inputs, *self.running_outputs]:
                task.events.deliver()
        for alarm in [each for each in self._alarms if each[0] <= self.elapsed]:
            self._alarms.remove(alarm)
            alarm[1]()

    def _give(self, acquisition: Acquisition, block: AcquiredBlock) -> None:
        """Give an acquisition its samples, up to a stretch that is lost on the way."""
        if acquisition.done:
            return
        stop = block.first + block.samples.shape[1]
        lost = [first for first, last in self._bench.lost if block.first <= last and first < stop]
        kept = slice(0, max(0, min(lost) - block.first)) if lost else slice(None)
        acquisition.take(block.first, block.samples[:, kept], block.overload[:, kept], self.moment)
        if lost and not acquisition.done:
            acquisition.stop(
                DaqError(
                    f"samples were lost on the way from the converter, from number {min(lost)} on "
                    "(the scene's converter.dropped_blocks); stop and start the task to acquire again",
                    DAQmxErrors.INPUT_FIFO_OVERFLOW_2,
                )
            )

    def moment(self, source: OtherTask) -> int | None:
        """Find the tick at which another task started or was triggered; None if it has not been."""
        runs = self.running_inputs if source.kind == "ai" else self.running_outputs
        device = source.device.lower()
        named = [run for task, run in runs.items() if device and task.device.lower().startswith(device)]
        for run in named or runs.values():
            if isinstance(run, Acquisition):
                found = run.start_tick(source.reference, self.position)
            else:
                found = None if source.reference else run.start_tick(self.position)
            if found is not None:
                return found
        return None

    def _output_waits_on_data(self) -> bool:
        """Whether samples not yet taken may start an output: then time goes by the sample."""
        waiting = [
            run.plan.start
            for run in self.running_outputs.values()
            if run.first_tick is None
            and isinstance(run.plan.start, OtherTask)
            and run.plan.start.kind == "ai"
        ]
        return any(
            source.reference or run.waits_on_data
            for source in waiting
            for run in self.running_inputs.values()
            if self.moment(source) is None
        )

    def fail(self, error: BaseException) -> None:
        """Hear that the simulation has failed: show why, and end what waits for it."""
        traceback.print_exception(error)
        self._stop_all(DaqError(f"the simulation of the scene has failed: {error!r}", DAQmxErrors.UNKNOWN))

    def _stop_all(self, error: DaqError) -> None:
        with self.changed:
            for acquisition in self.running_inputs.values():
                acquisition.stop(error)
            for generation in self.running_outputs.values():
                generation.stop(error)
            self.changed.notify_all()

    def lag(self, seconds: float) -> bool:
        """Hear how far the bench is behind the wall clock; too far, and its buffers have overflown."""
        if seconds < _PATIENCE:
            return False
        self._stop_all(
            DaqError(
                f"input overflow: this machine simulates the scene {seconds:.0f} s behind real time at "
                f"{self.rate:g} S/s; lower the rate, simplify the scene or use the fast clock",
                DAQmxErrors.INPUT_FIFO_OVERFLOW_2,
            )
        )
        return True


def _at_rate(scene: rig.Scene, rate: float) -> rig.Scene:
    """Change a scene's sample rate; its test stays away where samples at that rate cannot tell its tones."""
    converter = scene.converter.replace(rate=rate)
    try:
        return scene.replace(converter=converter)
    except SceneError as error:
        quiet = scene.replace(converter=converter, test=None)
        warnings.warn(
            f"the test of scene {scene.name!r} cannot be played, the bench stays quiet until a script drives it: "
            f"{error}",
            RuntimeWarning,
            stacklevel=2,
        )
        return quiet
