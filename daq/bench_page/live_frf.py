"""Frequency responses during a test: H1 and coherence, averaged over Hann blocks with half overlap, or over hits.

A quick view for the operator. `analysis frf` estimates the response from the recording, with its uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daq.excitation import Station
from rig.arrays import Array, ComplexArray
from rig.errors import SceneError

if TYPE_CHECKING:
    from daq.bench_page.hits import Hit
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.scene import Scene


# Lines below this ratio to the largest line of the force's auto-spectrum have not been excited.
_EXCITED_RATIO = 1e-3


@dataclass(frozen=True)
class LiveCurves:
    """Dynamic compliance (m/N) and coherence at the excited frequencies; rows are the channels on bodies."""

    names: list[str]
    frequency: Array
    value: ComplexArray
    coherence: Array
    averages: int


class _Sums:
    """Summed auto- and cross-spectra of force and motion."""

    def __init__(self, motions: int, lines: int) -> None:
        self.force = np.zeros(lines)
        self.motion = np.zeros((motions, lines))
        self.cross = np.zeros((motions, lines), complex)
        self.count = 0

    def add(self, force: ComplexArray, motion: ComplexArray) -> None:
        self.force += np.abs(force) ** 2
        self.motion += np.abs(motion) ** 2
        self.cross += motion * force.conj()
        self.count += 1


class LiveFrf:
    """Estimates the responses of all channels on bodies to the force on the structure.

    The test is that of the scene; `block` is the length of a block or of a hit's window in s, `band` is in Hz. Raises
    `SceneError` if no channel measures the force.
    """

    def __init__(
        self, scene: Scene, channels: Sequence[ChannelInfo], rate: float, block: float, band: tuple[float, float]
    ) -> None:
        self._size = round(block * rate)
        frequency = np.fft.rfftfreq(self._size, 1.0 / rate)
        self._lines = np.flatnonzero((frequency >= max(band[0], 1.0 / block)) & (frequency <= band[1]))
        self.frequency = np.asarray(frequency[self._lines], dtype=float)
        station = Station(scene, channels, (), rate, mark=lambda *arguments, **fields: None)
        self._force = _force_weights(station, self.frequency)
        on_body = (row for row, info in enumerate(channels) if info.at.startswith("body"))
        self._rows = [row for row in on_body if channels[row].quantity != "force"]
        self.names = [channels[row].name for row in self._rows]
        self._motion = np.array([station.displacement_factor(row, self.frequency) for row in self._rows])
        self._window = np.hanning(self._size)
        self._pending = np.zeros((len(channels), 0))
        self._sums = _Sums(len(self._rows), self._lines.size)
        self._hits: list[tuple[Hit, ComplexArray]] = []

    def add(self, readings: Array) -> None:
        """Add the next readings of a continuous test, shape (channels, samples)."""
        self._pending = np.concatenate([self._pending, readings], axis=1)
        while self._pending.shape[1] >= self._size:
            block = self._pending[:, : self._size]
            spectra = self._spectra((block - block.mean(axis=1, keepdims=True)) * self._window)
            self._sums.add(*self._force_and_motion(spectra))
            self._pending = self._pending[:, self._size // 2 :]

    def add_hit(self, hit: Hit) -> None:
        """Add the window of a hit, which is included as long as the hit is accepted."""
        window = hit.readings[:, : self._size]
        padding = self._size - window.shape[1]
        self._hits.append((hit, self._spectra(np.pad(window, ((0, 0), (0, padding))))))

    def curves(self) -> LiveCurves | None:
        """Return the present estimate; None before the first block."""
        sums = self._sums
        if self._hits:
            sums = _Sums(len(self._rows), self._lines.size)
            for hit, spectra in self._hits:
                if hit.accepted:
                    sums.add(*self._force_and_motion(spectra))
        if not sums.count:
            return None
        excited = sums.force > _EXCITED_RATIO * sums.force.max()
        force, motion, cross = sums.force[excited], sums.motion[:, excited], sums.cross[:, excited]
        with np.errstate(divide="ignore", invalid="ignore"):
            coherence = np.abs(cross) ** 2 / (force * motion)
        return LiveCurves(self.names, self.frequency[excited], cross / force, coherence, sums.count)

    def _spectra(self, block: Array) -> ComplexArray:
        return np.asarray(np.fft.rfft(block, axis=1)[:, self._lines])

    def _force_and_motion(self, spectra: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Convert the spectra of all channels to force (lines,) and displacements (motions, lines)."""
        return (self._force * spectra).sum(axis=0), self._motion * spectra[self._rows]


def _force_weights(station: Station, frequency: Array) -> ComplexArray:
    """Return the weights, (channels, lines), with which the channels' spectra add up to the force on the structure."""
    test = station.scene.test
    hammer = test is not None and test.kind == "impulse"
    for row, info in enumerate(station.channels):
        if info.quantity == "force" and (info.at == "hammer") == hammer:
            weights = np.zeros((len(station.channels), frequency.size), complex)
            weights[row] = 1.0 / info.response(frequency)
            return weights
    shaker = station.scene.driven_shaker
    if hammer or shaker is None or shaker.spring is None:
        place = "hammer" if hammer else "shaker"
        raise SceneError(f"channels: no channel measures the force at the {place}. Add {{name: force, at: {place}}}.")
    return station.force_weights(frequency)
