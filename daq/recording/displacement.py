"""Displacement of points for pictures: its source among channels and truth, and its integration without drift."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rig.arrays import Array

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo

# Below this frequency an integrated signal is drift and noise rather than motion.
HIGH_PASS_HZ = 1.0
_INTEGRATIONS = {"velocity": "once", "acceleration": "twice"}


@dataclass(frozen=True)
class MotionSource:
    """Source of the displacement of a point; without a channel it is the truth, or the point is not measured."""

    point: str
    channel: str | None
    quantity: str

    @property
    def sentence(self) -> str:
        """The source in words."""
        if self.channel is None:
            return "recorded truth" if self.quantity == "truth" else "not measured, drawn at rest"
        if self.quantity == "displacement":
            return f"channel {self.channel}"
        times = _INTEGRATIONS[self.quantity]
        return f"channel {self.channel}, {self.quantity} integrated {times} (high-passed at {HIGH_PASS_HZ:g} Hz)"


def motion_sources(points: Iterable[str], channels: Sequence[ChannelInfo], truth: bool) -> tuple[MotionSource, ...]:
    """Choose the source of each point: a displacement channel, else truth, else a channel that is integrated."""
    sources = []
    for point in points:
        at = {info.quantity: info.name for info in channels if info.at == point}
        quantities = ("displacement",) if truth else ("displacement", "velocity", "acceleration")
        quantity = next((each for each in quantities if each in at), None)
        if quantity is None:
            sources.append(MotionSource(point, None, "truth" if truth else "nothing"))
        else:
            sources.append(MotionSource(point, at[quantity], quantity))
    return tuple(sources)


class DisplacementEstimate:
    """Integrates a sampled signal to a displacement, block by block, high-passed at `HIGH_PASS_HZ`.

    With w the corner, an acceleration is filtered by ``s^2 / (s^2 + sqrt(2) w s + w^2)^2``, a velocity by
    ``s / (s^2 + sqrt(2) w s + w^2)``, both by bilinear transform; a displacement is not changed.
    """

    def __init__(self, quantity: str, rate: float) -> None:
        self._sections: Array | None = None
        if quantity == "displacement":
            return
        from scipy.signal import bilinear_zpk, zpk2sos

        corner = 2 * np.pi * HIGH_PASS_HZ * np.exp(1j * np.pi * np.array([0.75, -0.75]))
        order = {"velocity": 1, "acceleration": 2}[quantity]
        zeros, poles = np.zeros(order), np.tile(corner, order)
        self._sections = zpk2sos(*bilinear_zpk(zeros, poles, 1.0, fs=rate))
        self._state = np.zeros((self._sections.shape[0], 2))

    def run(self, samples: Array) -> Array:
        """Return the displacement at the next samples, metres for SI input."""
        if self._sections is None or not samples.size:
            return samples
        from scipy.signal import sosfilt

        result, self._state = sosfilt(self._sections, samples, zi=self._state)
        return np.asarray(result)
