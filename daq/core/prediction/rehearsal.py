"""Rehearse a test: simulate it on the virtual bench without a recording, to predict its extremes.

The size of the recording is estimated by recording a few blocks.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from daq.core.excitation import excitation, procedure_of
from daq.core.excitation.sensor_settling import settling_time
from daq.core.excitation.station import AbortedTest
from daq.core.measurement.bench_loop import BenchLoop
from daq.core.recording.recorder import Recorder
from daq.core.virtual_bench.bench import Bench, Block
from rig.core.base.arrays import Array
from rig.core.base.output_files import temporary_folder
from rig.core.laws.events import CONTACT_EVENTS, EVENT_NAMES, SLIP
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import Load, at_shaker
from rig.core.system.assembly import assemble

#: Readings in this fraction of the settling time of the sensor's bias belong to the power-on transient.
POWER_ON_RATIO = 0.5
# Time after a stored event without further stored events of this damper or joint [s], to limit the memory.
_MIN_EVENT_INTERVAL_S = 0.5
# Events at which a damper or joint acts; the others end a contact or slip.
_ACTING_EVENTS = EVENT_NAMES[[*CONTACT_EVENTS, SLIP]]
# Duration at the end of a rehearsal whose blocks are stored [s].
_STORED_END_S = 4.0


class Extremes:
    """Largest magnitude of each row of a quantity so far, and the index of its sample."""

    def __init__(self, rows: int) -> None:
        self.magnitude, self.sample = np.zeros(rows), np.zeros(rows, dtype=np.int64)

    def add(self, first: int, values: Array) -> Array:
        """Update with the next values (rows, samples), starting at sample `first`; return their largest magnitudes."""
        if not values.size:
            return np.zeros(len(values))
        largest = np.abs(values).max(axis=1)
        self.update(first, values, largest)
        return largest

    def update(self, first: int, values: Array, largest: Array) -> None:
        """Update with the next values, of known largest magnitudes; only rows with a larger value are searched."""
        for row in np.flatnonzero(largest > self.magnitude):
            self.magnitude[row] = largest[row]
            self.sample[row] = first + int(np.abs(values[row]).argmax())


@dataclass(frozen=True)
class Step:
    """The wait for the steady state of a tone, or the measurement of the tone."""

    first: int  # index of the first sample
    stop: int  # index of the sample after the last
    frequency: float  # Hz
    settled: bool  # whether the steady state was reached
    is_measurement: bool
    is_evaluated: bool  # whether its extremes and impacts are stored


class ShakerLoad(NamedTuple):
    """A quantity that loads a shaker; its name contains the shaker's number if there are several."""

    name: str
    load: Load
    weights: Array  # weights of displacements, velocities and accelerations, (3, points)


def loads_of(scene: Scene, points: Sequence[str]) -> list[ShakerLoad]:
    """Return the loads of all shakers; `points`: names of the rows of the motion."""
    result, count = [], len(scene.shakers)
    for number, shaker in enumerate(scene.shakers, 1):
        for load in shaker.loads:
            weights = np.zeros((3, len(points)))
            weights[:, points.index(at_shaker("table", number, count))] = load.weights[:3]
            weights[0, shaker.first_body - 1] += load.weights[3]
            result.append(ShakerLoad(f"{at_shaker(load.place, number, count)} {load.name}", load, weights))
    return result


class Rehearsal(BenchLoop):
    """A test on the bench that is not recorded; only the extremes of each quantity are stored.

    The first `excluded_dwells` dwells are run but not evaluated. Each quantity has a row for each channel (`readings`,
    in its unit), input (`drives`), body and table (`accelerations`, m/s²), or load of a shaker (`loads`).
    """

    def __init__(self, scene: Scene, excluded_dwells: int = 0, bench: Bench | None = None) -> None:
        super().__init__(scene, bench=bench)
        bench, self.station.evaluates_marks = self.bench, False
        self.scene, self.rate, self._excluded_dwells = scene, bench.rate, excluded_dwells
        self.readings = Extremes(len(bench.channels))
        powered_on_s = np.array([POWER_ON_RATIO * settling_time(info) for info in bench.channels])
        self._powered_on = np.round(powered_on_s * self.rate)
        # Extremes of the readings after the power-on transient; of all readings if there is no such transient.
        self.driven_readings = Extremes(len(bench.channels)) if self._powered_on.any() else self.readings
        # Largest readings in the measurements of tones, and those of each block since the last mark.
        self.measured_readings = np.zeros(len(bench.channels))
        self._block_maxima: list[tuple[int, Array]] = []
        self.overloaded = [False] * len(bench.channels)
        # Drive of each input of the rig, before the limits of output and amplifier.
        self.drives = Extremes(len(bench.inputs))
        self.accelerations = Extremes(len(bench.points))
        loads = loads_of(scene, bench.points)
        self._load_weights = np.stack([load.weights for load in loads], axis=1) if loads else None
        self.loads = Extremes(len(loads))  # loads in the order of `loads_of`
        # Largest closing speed of each damper before an impact [m/s].
        self.closing_speed = np.zeros(len(scene.dampers))
        # Times at which each damper or joint hits a wall, closes or slips [s], by its index in the system.
        elements = assemble(scene).elements
        self._rows = {(element.is_joint, element.number): row for row, element in enumerate(elements)}
        self.event_times: list[list[float]] = [[] for _ in elements]
        self._next_stored_s = [-1.0] * len(elements)  # time from which an event is stored next [s]
        self.steps: list[Step] = []
        # Last measured interval without a constant tone: its first sample, and the sample after its last.
        self.measured: tuple[int, int] | None = None
        # Time at which the bias of the sensors has settled [s].
        self.settled_sensors_s = 0.0
        # Simulated duration [s], whether the test ran to its end, and the completed fraction that it reported.
        self.seconds, self.complete, self.fraction = 0.0, False, 0.0
        # Reason why the test was aborted; None if it ran to its end.
        self.aborted: str | None = None
        # Blocks of the last seconds, from which the size of the recording is estimated.
        self.last_blocks: deque[Block] = deque()
        self._stored_samples = 0

    def run(self, max_duration: float) -> Self:
        """Run the test up to its end, an abort, or a maximum duration in s."""
        test = excitation(self.station)
        try:
            self.complete = self.run_test(test, next(test), max_duration)
        except AbortedTest as reason:
            self.aborted = str(reason)
        self.seconds = self.station.now / self.rate
        return self

    def is_measured(self, sample: int) -> bool:
        """Return whether a sample belongs to the measurement of a tone, or to a measured sweep."""
        if self.measured is not None and sample >= self.measured[0]:
            return True
        return any(step.first <= sample < step.stop for step in self.steps if step.is_measurement)

    def frequency_at(self, sample: int) -> float | None:
        """Return the frequency of the tone at a sample [Hz]; None if there is no single tone."""
        test = self.scene.test
        if self.measured is not None and test is not None and sample >= self.measured[0]:
            fraction = (sample - self.measured[0]) / max(1, self.measured[1] - self.measured[0])
            frequency = procedure_of(test).frequency_at(test, min(fraction, 1.0))
            if frequency is not None:
                return frequency
        earlier = [step for step in self.steps if step.first <= sample]
        return earlier[-1].frequency if earlier else None

    def report(self, fraction: float, message: str) -> None:
        """Store the completed fraction."""
        self.fraction = float(fraction)

    def ending_error(self, readings: Array) -> BaseException | None:
        """Return the error that ends the test at an exceeded limit; None while dwells are still excluded."""
        error = super().ending_error(readings)
        return None if self._excluded_dwells else error

    def on_block(self, block: Block, readings: Array) -> None:
        """Update the extremes of channels, bodies and shaker tables, and the events of dampers and joints."""
        self.last_blocks.append(block)
        self._stored_samples += block.samples.shape[1]
        while self._stored_samples - self.last_blocks[0].samples.shape[1] > _STORED_END_S * self.rate:
            self._stored_samples -= self.last_blocks.popleft().samples.shape[1]
        if self._excluded_dwells:
            return
        motion = block.motion
        largest = self.readings.add(block.first, readings)
        self._block_maxima.append((block.first, largest))
        if self.driven_readings is not self.readings:
            is_driven = block.first >= self._powered_on
            self.driven_readings.update(block.first, readings, np.where(is_driven, largest, 0.0))
        self.accelerations.add(motion.first, motion.acceleration)
        if self._load_weights is not None:
            displacement, velocity, acceleration = self._load_weights
            values = displacement @ motion.displacement + velocity @ motion.velocity
            self.loads.add(motion.first, values + acceleration @ motion.acceleration)
        if motion.events.size:
            self._add_events(motion.events)

    def _add_events(self, events: NDArray[Any]) -> None:
        """Update the closing speeds and the times of events."""
        acting = events[np.isin(events["kind"], _ACTING_EVENTS)]
        columns = (acting[name].tolist() for name in ("damper", "speed", "time"))
        joints = acting["joint"].tolist() if "joint" in (acting.dtype.names or ()) else [0] * len(acting)
        for number, speed, time, joint in zip(*columns, joints, strict=True):
            if number:
                self.closing_speed[number - 1] = max(self.closing_speed[number - 1], speed)
            row = self._rows[joint > 0, joint or number]
            if time > self._next_stored_s[row]:
                self.event_times[row].append(time)
                self._next_stored_s[row] = time + _MIN_EVENT_INTERVAL_S

    def on_window(self, first: int, drive: Array, overload: NDArray[np.bool_]) -> None:
        """Update the extremes of the drives, and the overloads."""
        if self._excluded_dwells:
            return
        self.drives.add(first, drive)
        for row in np.flatnonzero(overload.any(axis=1)):
            self.overloaded[row] = True

    def mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        """Store the tones and the sweep of the test, and the time at which the sensors have settled."""
        if kind == "settle" and fields.keys() == {"settled"}:
            self.settled_sensors_s = stop / self.rate
        elif kind in ("settle", "measure") and "frequency" in fields:
            settled = bool(fields.get("settled", True))
            is_measurement, is_evaluated = kind == "measure", not self._excluded_dwells
            self.steps.append(Step(first, stop, float(fields["frequency"]), settled, is_measurement, is_evaluated))
            self._excluded_dwells -= is_measurement and not is_evaluated
            # The first event of the next step is stored.
            self._next_stored_s = [stop / self.rate] * len(self._next_stored_s)
            if is_measurement:
                measured = [maxima for block_first, maxima in self._block_maxima if block_first >= first]
                self.measured_readings = np.max([self.measured_readings, *measured], axis=0)
            self._block_maxima.clear()
        elif kind == "measure":
            self.measured = first, stop


def recording_size(scene: Scene, bench: Bench, blocks: Iterable[Block], seconds: float) -> float:
    """Estimate the size [bytes] of the recording of a test that takes `seconds`, from some of its blocks."""
    with temporary_folder() as folder:
        path = folder / "size.mcap"
        written_samples = 0
        with Recorder(path, scene, bench.channels, bench.rate) as recorder:
            empty_size = recorder.size
            for block in blocks:
                if not block.samples.shape[1]:
                    continue
                if scene.recording.truth:
                    motion = replace(block.motion, first=written_samples, events=block.motion.events[:0])
                    recorder.write_truth(motion)
                recorder.write(block.samples)
                written_samples += block.samples.shape[1]
        total_size = path.stat().st_size
    return empty_size + (total_size - empty_size) / max(written_samples, 1) * seconds * bench.rate
