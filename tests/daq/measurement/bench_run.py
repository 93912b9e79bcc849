"""Run of a test on the virtual bench without a recorder, and an independent estimate of its spring force."""

from typing import Any

import numpy as np

import rig
from daq.core.excitation import excitation
from daq.core.measurement.bench_loop import BenchLoop
from daq.core.virtual_bench.bench import Block
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RunError


def scene_with(test: dict[str, Any], **changes: Any) -> rig.Scene:
    """Return the bare structure on an ideal table with ideal sensors, with a test and other changed settings."""
    return rig.load("bare-structure").replace(test=test, **changes)


class BenchRun(BenchLoop):
    """A run with its drive, its readings in their units, and messages."""

    def __init__(self, scene: rig.Scene, max_block: int | None) -> None:
        super().__init__(scene, max_block)
        # Kind, first sample, sample after the last, and fields of each mark.
        self.marks: list[tuple[str, int, int, dict[str, Any]]] = []
        self.reports: list[tuple[float, str]] = []  # completed fraction, message
        self.drives: list[Array] = []  # windows, shape (inputs, samples)
        self.blocks: list[Array] = []  # readings, shape (channels, samples)
        self.reason = ""  # message of a test that aborted

    def mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        self.marks.append((kind, first, stop, fields))

    def report(self, fraction: float, message: str) -> None:
        self.reports.append((fraction, message))

    def on_block(self, block: Block, readings: Array) -> None:
        self.blocks.append(readings)

    def on_window(self, first: int, drive: Array, overload: Any) -> None:
        self.drives.append(drive)

    @property
    def drive(self) -> Array:
        """The whole drive, shape (inputs, samples)."""
        return np.concatenate(self.drives, axis=1)

    @property
    def readings(self) -> Array:
        """All readings, shape (channels, samples)."""
        return np.concatenate(self.blocks, axis=1)

    def fields_of(self, kind: str) -> list[dict[str, Any]]:
        """Return the fields of the marks of a kind."""
        return [fields for *_, fields in self.marks_of(kind)]

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


def run(scene, max_block=None, make_excitation=excitation):
    """Run a scene's test, or another excitation, on its bench; acquire at most `max_block` samples at a time."""
    result = BenchRun(scene, max_block)
    test = make_excitation(result.station)
    try:
        result.run_test(test, next(test))
    except RunError as error:
        result.reason = str(error)
    return result
