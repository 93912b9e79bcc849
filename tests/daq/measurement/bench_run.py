"""Run of a test on the virtual bench without a recorder, and an independent estimate of its spring force."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import rig
from daq.core.excitation import Excitation, Station, excitation
from daq.core.virtual_bench.bench import Bench
from rig.core.base.arrays import Array, ComplexArray


def scene_with(test: dict[str, Any], **changes: Any) -> rig.Scene:
    """Return the bare structure on an ideal table with ideal sensors, with a test and other changed settings."""
    return rig.load("bare-structure").replace(test=test, **changes)


@dataclass
class BenchRun:
    """Results of a run: drive (inputs, samples), readings (channels, samples) in their units, and messages."""

    bench: Bench
    drive: Array = field(default_factory=lambda: np.zeros((0, 0)))
    readings: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # Kind, first sample, sample after the last, and fields of each mark.
    marks: list[tuple[str, int, int, dict[str, Any]]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    reports: list[tuple[float, str]] = field(default_factory=list)  # completed fraction, message

    def marks_of(self, kind: str) -> list[tuple[int, int, dict[str, Any]]]:
        """Return the marks of a kind as (first, stop, fields)."""
        return [(first, stop, fields) for name, first, stop, fields in self.marks if name == kind]

    def spring_force(self, first: int, stop: int, frequency: float) -> complex:
        """Return the complex amplitude of the spring force in N in a window of a steady tone."""
        return complex(self.amplitudes(first, stop, frequency) @ self.force_weights(frequency))

    def force_weights(self, frequency: float) -> ComplexArray:
        """Return the weight of each channel in the spring force, N per unit of its reading; shape (channels,)."""
        shaker = self.bench.scene.shaker
        assert shaker is not None and shaker.spring is not None
        places = [channel.at for channel in self.bench.channels]
        weights = np.zeros(len(places), dtype=complex)
        for place, sign in (("table", 1.0), (f"body {shaker.body}", -1.0)):
            row = places.index(place)
            weights[row] = sign * shaker.spring * self.displacement_factor(row, frequency)
        return weights

    def displacement_factor(self, row: int, frequency: float) -> complex:
        """Return the displacement in m for a unit amplitude of a channel, by integration in the frequency domain."""
        channel = self.bench.channels[row]
        order = ["displacement", "velocity", "acceleration"].index(channel.quantity)
        return complex(1.0 / channel.response(frequency) / (2j * np.pi * frequency) ** order)

    def amplitudes(self, first: int, stop: int, frequency: float) -> ComplexArray:
        """Return the complex amplitudes of all channels in a window, by a least-squares fit of a sine and an offset."""
        time = np.arange(stop - first) / self.bench.rate
        angle = 2 * np.pi * frequency * time
        model = np.stack([np.cos(angle), np.sin(angle), np.ones_like(time)], axis=1)
        cosine, sine, _ = np.linalg.lstsq(model, self.readings[:, first:stop].T, rcond=None)[0]
        return np.asarray(cosine - 1j * sine)


def run(
    scene: rig.Scene,
    max_block: int | None = None,
    make_excitation: Callable[[Station], Excitation] = excitation,
) -> BenchRun:
    """Run a scene's test, or another excitation, on its bench; acquire at most `max_block` samples at a time."""
    bench = Bench(scene)
    result = BenchRun(bench)
    station = Station(
        scene,
        bench.channels,
        bench.inputs,
        bench.rate,
        mark=lambda kind, first, stop, **fields: result.marks.append((kind, first, stop, fields)),
        report=lambda fraction, message: result.reports.append((fraction, message)),
        warn=result.warnings.append,
    )
    drives, readings = [], []
    test = make_excitation(station)
    drive = next(test)
    while True:
        block = drive.shape[1] if max_block is None else max_block
        blocks = [
            bench.to_units(bench.acquire(drive[:, start : start + block]).samples)
            for start in range(0, drive.shape[1], block)
        ]
        station.now += drive.shape[1]
        drives.append(drive)
        readings.append(np.concatenate(blocks, axis=1))
        try:
            drive = test.send(readings[-1])
        except StopIteration:
            result.drive = np.concatenate(drives, axis=1)
            result.readings = np.concatenate(readings, axis=1)
            return result
