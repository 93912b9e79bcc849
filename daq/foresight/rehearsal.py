"""A rehearsal: the test on the scene's bench without a recording, with the extremes of every channel."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.excitation import Station, excitation
from daq.excitation.swept_sine import sweep_frequency
from daq.foresight.recording_size import LastBlocks
from daq.measurement.limits import ControlLoss, Limits
from daq.measurement.run import RAMP_S, ramp_down
from daq.virtual_bench.bench import Bench
from daq.virtual_bench.stream import Block
from rig.scene.excitation import SweptSine
from rig.scene.scene import Scene

Array = NDArray[np.float64]

# Impacts of a damper within this time after another are not stored, s.
_PAUSE = 0.5


@dataclass
class Extreme:
    """Largest magnitude of a quantity so far, and its sample."""

    size: float = 0.0
    sample: int = 0

    def add(self, first: int, values: Array) -> None:
        """Take the next values, the first with the number `first`."""
        if values.size:
            place = int(np.argmax(np.abs(values)))
            if abs(values[place]) > self.size:
                self.size, self.sample = float(abs(values[place])), first + place


@dataclass(frozen=True)
class Step:
    """A held tone: its samples, its frequency in Hz, and whether it settled."""

    first: int
    stop: int
    frequency: float
    settled: bool


@dataclass
class Rehearsal:
    """Result of a test on the bench; extremes are in the unit of each quantity."""

    scene: Scene
    rate: float
    readings: list[Extreme]
    overloaded: list[bool]
    drives: list[Extreme]  # of each input of the rig, before the limits of output and amplifier
    accelerations: dict[str, Extreme]  # of each point, m/s^2
    tables: dict[str, Extreme]  # displacement of each table, m
    closing_speed: Array  # largest of each damper of the scene, m/s
    strikes: list[list[float]]  # times of impacts of each damper, at most a few a second, s
    seconds: float = 0.0  # duration on the bench
    complete: bool = False
    aborted: str | None = None  # reason for which the test would abort
    steps: list[Step] = field(default_factory=list)  # held tones
    sweep: tuple[int, int] | None = None
    last_blocks: LastBlocks = field(default_factory=lambda: LastBlocks(0.0))

    def frequency_at(self, sample: int) -> float | None:
        """Frequency of the tone at a sample, Hz; None where the test plays no single tone."""
        test = self.scene.test
        if self.sweep is not None and isinstance(test, SweptSine) and sample >= self.sweep[0]:
            share = (sample - self.sweep[0]) / max(1, self.sweep[1] - self.sweep[0])
            return float(sweep_frequency(test, min(share, 1.0)))
        earlier = [step for step in self.steps if step.first <= sample]
        return earlier[-1].frequency if earlier else None


def rehearse(scene: Scene, longest: float, ahead: int = 0) -> Rehearsal:
    """Run a scene's test without recording it, at most `longest` s; extremes exclude the first `ahead` steps."""
    return _Run(scene, ahead).run(longest)


class _Run:
    """The loop between excitation and bench of `daq.measurement.run`, without a recording."""

    def __init__(self, scene: Scene, ahead: int) -> None:
        self._ahead = ahead
        self._control_lost: str | None = None
        self._bench = bench = Bench(scene)
        self._limits = Limits(scene, bench.channels, lambda *args, **fields: None)
        self._control = ControlLoss(scene, bench.channels)
        self._station = Station(
            scene, bench.channels, bench.inputs, bench.rate, mark=self._mark, latency=bench.latency
        )
        self._points = bench.points
        self._last = np.zeros((len(bench.inputs), 2))
        count = len(bench.channels)
        self._found = Rehearsal(
            scene=scene,
            rate=bench.rate,
            readings=[Extreme() for _ in range(count)],
            overloaded=[False] * count,
            drives=[Extreme() for _ in bench.inputs],
            accelerations={point: Extreme() for point in bench.points},
            tables={point: Extreme() for point in bench.points if point.startswith("table")},
            closing_speed=np.zeros(len(scene.dampers)),
            strikes=[[] for _ in scene.dampers],
            last_blocks=LastBlocks.of(bench.rate),
        )

    def run(self, longest: float) -> Rehearsal:
        """Run the test to its end, to an abort, or up to a duration."""
        test = excitation(self._station)
        drive, found = next(test), self._found
        quantum = self._station.samples(self._limits.interval)
        while found.aborted is None and self._station.now < longest * self._bench.rate:
            readings = []
            for start in range(0, drive.shape[1], quantum):
                readings.append(self._acquire(drive[:, start : start + quantum]))
                came = self._station.now - self._bench.latency - readings[-1].shape[1]
                trip = self._limits.watch(came, readings[-1])
                lost = self._control_lost if trip is None else str(trip)
                if lost is not None and not self._ahead:
                    found.aborted = lost
                    break
            else:
                try:
                    drive = test.send(readings[0] if len(readings) == 1 else np.concatenate(readings, axis=1))
                except StopIteration:
                    found.complete = True
                    break
        if found.aborted is not None:
            test.close()
            self._acquire(ramp_down(self._last, self._station.samples(RAMP_S)))
        elif found.complete and self._bench.latency:
            self._acquire(np.repeat(self._last[:, -1:], self._bench.latency, axis=1))
        found.seconds = self._station.now / self._bench.rate
        return found

    def _acquire(self, drive: Array) -> Array:
        bench, found, first = self._bench, self._found, self._station.now
        self._last = np.concatenate([self._last, drive[:, -2:]], axis=1)[:, -2:]
        got = bench.acquire(drive)
        found.last_blocks.add(got)
        readings = np.zeros((len(bench.channels), drive.shape[1]))
        overload = np.zeros(readings.shape, dtype=bool)
        came = slice(drive.shape[1] - got.samples.shape[1], None)
        readings[:, came] = bench.physical(got.samples)
        overload[:, came] = got.overload
        self._station.now = first + drive.shape[1]
        self._control_lost = self._control.watch(first, overload)
        if self._ahead:
            return readings
        for row, extreme in enumerate(found.readings):
            extreme.add(got.first, readings[row, came])
            found.overloaded[row] |= bool(overload[row].any())
        for row, extreme in enumerate(found.drives):
            extreme.add(first, drive[row])
        self._follow(got)
        return readings

    def _follow(self, got: Block) -> None:
        """Update the motion of tables and bodies, and the impacts of dampers."""
        motion, found = got.motion, self._found
        for row, point in enumerate(self._points):
            found.accelerations[point].add(motion.first, motion.acceleration[row])
            if point in found.tables:
                found.tables[point].add(motion.first, motion.displacement[row])
        for event in motion.events[motion.events["speed"] > 0.0]:
            damper = int(event["damper"]) - 1
            found.closing_speed[damper] = max(found.closing_speed[damper], event["speed"])
            struck = found.strikes[damper]
            if not struck or event["time"] - struck[-1] > _PAUSE:
                struck.append(float(event["time"]))

    def _mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        if kind == "measure" and "from" in fields:
            self._found.sweep = (first, stop)
        elif kind in ("settle", "measure") and "frequency" in fields:
            self._found.steps.append(
                Step(first, stop, float(fields["frequency"]), bool(fields.get("settled", True)))
            )
            self._ahead -= kind == "measure" and self._ahead > 0
