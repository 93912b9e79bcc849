"""Run of an excitation on a real bench without a recorder, with a log of the events."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import rig
from daq.excitation import Excitation, Station, excitation
from daq.virtual_bench.bench import Bench
from rig.arrays import Array, ComplexArray

BODIES = (0.74, 0.71, 0.64), (24.3e3, 21.8e3, 19.8e3)


def scene_with(test: dict[str, Any], **changes: Any) -> rig.Scene:
    """The bare structure on an ideal table with ideal sensors, and a test."""
    return rig.load("bare-structure").replace(test=test, **changes)


@dataclass
class BenchRun:
    """Results of a run: drive (inputs, samples), readings (channels, samples), marks, warnings, reports."""

    bench: Bench
    drive: Array = field(default_factory=lambda: np.zeros((0, 0)))
    readings: Array = field(default_factory=lambda: np.zeros((0, 0)))
    marks: list[tuple[str, int, int, dict[str, Any]]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    reports: list[tuple[float, str]] = field(default_factory=list)

    def marked(self, kind: str) -> list[tuple[int, int, dict[str, Any]]]:
        """Marks of a kind as (first, stop, fields)."""
        return [(first, stop, fields) for name, first, stop, fields in self.marks if name == kind]

    def spring_force(self, first: int, stop: int, frequency: float) -> complex:
        """Amplitude of the spring force in a window of a steady tone, and its phase from the first sample."""
        return complex(self.amplitudes(first, stop, frequency) @ self.weights(frequency))

    def weights(self, frequency: float) -> ComplexArray:
        """Weights of the channels in the spring force, computed independently of the product."""
        shaker = self.bench.scene.shaker
        assert shaker is not None and shaker.spring is not None
        places = [channel.at for channel in self.bench.channels]
        weights = np.zeros(len(places), dtype=complex)
        for place, sign in (("table", 1.0), (f"body {shaker.body}", -1.0)):
            row = places.index(place)
            weights[row] = sign * shaker.spring * self.to_displacement(row, frequency)
        return weights

    def to_displacement(self, row: int, frequency: float) -> complex:
        """Factor from a channel's amplitude to the displacement."""
        channel = self.bench.channels[row]
        order = ["displacement", "velocity", "acceleration"].index(channel.quantity)
        return complex(1.0 / channel.response(frequency) / (2j * np.pi * frequency) ** order)

    def amplitudes(self, first: int, stop: int, frequency: float) -> ComplexArray:
        """Complex amplitudes of all channels in a window, by a plain least-squares fit."""
        time = np.arange(stop - first) / self.bench.rate
        angle = 2 * np.pi * frequency * time
        model = np.stack([np.cos(angle), np.sin(angle), np.ones_like(time)], axis=1)
        cosine, sine, _ = np.linalg.lstsq(model, self.readings[:, first:stop].T, rcond=None)[0]
        return np.asarray(cosine - 1j * sine)


def run(scene: rig.Scene, split: int | None = None, excite: Callable[[Station], Excitation] = excitation) -> BenchRun:
    """Run a scene's test on its bench, or another one, acquiring at most `split` samples at a time."""
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
    test = excite(station)
    drive = next(test)
    while True:
        size = drive.shape[1] if split is None else split
        parts = [
            bench.physical(bench.acquire(drive[:, start : start + size]).samples)
            for start in range(0, drive.shape[1], size)
        ]
        station.now += drive.shape[1]
        drives.append(drive)
        readings.append(np.concatenate(parts, axis=1))
        try:
            drive = test.send(readings[-1])
        except StopIteration:
            result.drive = np.concatenate(drives, axis=1)
            result.readings = np.concatenate(readings, axis=1)
            return result
