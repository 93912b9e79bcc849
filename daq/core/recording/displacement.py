"""Displacements for the drawing of a recorded rig: choice of the measured source, and integration without drift."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rig.core.base.arrays import Array

if TYPE_CHECKING:
    from daq.core.signal_chain.channel import ChannelInfo

# Corner of the high-pass filter [Hz]. Below this frequency, an integrated signal is mostly drift and noise.
HIGH_PASS_HZ = 1.0
_INTEGRATIONS = {"velocity": "once", "acceleration": "twice"}


@dataclass(frozen=True)
class MotionSource:
    """Source of the displacement of a point of the drawn rig, such as ``body 1``.

    `quantity` is the quantity of the channel. Without a channel it is ``truth``, or ``nothing`` if the point is not
    measured.
    """

    point: str
    channel: str | None
    quantity: str

    @property
    def sentence(self) -> str:
        """Description of the source for the user."""
        if self.channel is None:
            return "recorded truth" if self.quantity == "truth" else "not measured, drawn at rest"
        if self.quantity == "displacement":
            return f"channel {self.channel}"
        count = _INTEGRATIONS[self.quantity]
        return f"channel {self.channel}, {self.quantity} integrated {count} (high-passed at {HIGH_PASS_HZ:g} Hz)"


def motion_sources(points: Iterable[str], channels: Sequence[ChannelInfo], has_truth: bool) -> tuple[MotionSource, ...]:
    """Return the source of each point: a displacement channel, otherwise the truth, otherwise another channel."""
    sources = []
    for point in points:
        channel_of_quantity = {info.quantity: info.name for info in channels if info.at == point}
        quantities = ("displacement",) if has_truth else ("displacement", "velocity", "acceleration")
        quantity = next((candidate for candidate in quantities if candidate in channel_of_quantity), None)
        if quantity is None:
            sources.append(MotionSource(point, None, "truth" if has_truth else "nothing"))
        else:
            sources.append(MotionSource(point, channel_of_quantity[quantity], quantity))
    return tuple(sources)


class DisplacementFilter:
    """Integrates a sampled signal to a displacement, block by block, high-passed at `HIGH_PASS_HZ`.

    With the corner w in rad/s, an acceleration is filtered by ``s^2 / (s^2 + sqrt(2) w s + w^2)^2`` and a velocity by
    ``s / (s^2 + sqrt(2) w s + w^2)``, both by bilinear transform; a displacement is not changed.
    """

    def __init__(self, quantity: str, rate: float) -> None:
        self._order = {"displacement": 0, "velocity": 1, "acceleration": 2}[quantity]
        self._rate = rate
        self._state: Array | None = None

    @cached_property
    def _sections(self) -> Array:
        """Second-order sections, designed with the first samples: a prediction writes none and imports no scipy."""
        from scipy.signal import bilinear_zpk, zpk2sos

        corner = 2 * np.pi * HIGH_PASS_HZ * np.exp(1j * np.pi * np.array([0.75, -0.75]))
        zeros, poles = np.zeros(self._order), np.tile(corner, self._order)
        return np.asarray(zpk2sos(*bilinear_zpk(zeros, poles, 1.0, fs=self._rate)))

    def run(self, samples: Array) -> Array:
        """Return the displacement at the next samples, in m; the samples are in SI units, shape (samples,)."""
        if self._order == 0 or not samples.size:
            return samples
        from scipy.signal import sosfilt

        if self._state is None:
            self._state = np.zeros((self._sections.shape[0], 2))
        result, self._state = sosfilt(self._sections, samples, zi=self._state)
        return np.asarray(result)
