"""Displacements for the drawing of a recorded rig: choice of the measured source, and integration without drift."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array

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
        self._sections = _high_passed_integration(self._order, rate)
        self._state = np.zeros((self._order, 2))

    def run(self, samples: Array) -> Array:
        """Return the displacement at the next samples, in m; the samples are in SI units, shape (samples,)."""
        if self._order == 0 or not samples.size:
            return samples
        # Imported here, because a recording without such a channel needs no compiled functions.
        from daq.core.dsp.second_order import filter_sections

        result = np.empty(samples.size)
        filter_sections(self._sections, self._state, np.ascontiguousarray(samples), result)
        return result


def _high_passed_integration(order: int, rate: float) -> Array:
    """Return the second-order sections of `DisplacementFilter`, shape (order, 6), for a number of integrations."""
    doubled_rate = 2.0 * rate
    corners = np.tile(2 * np.pi * HIGH_PASS_HZ * np.exp(1j * np.pi * np.array([0.75, -0.75])), order)
    gain = np.real(doubled_rate**order / np.prod(doubled_rate - corners))
    # The bilinear transform adds a zero at -1 for each zero at 1 of a derivative.
    numerators = ([], [[1.0, 0.0, -1.0]], [[1.0, 2.0, 1.0], [1.0, -2.0, 1.0]])[order]
    poles = (doubled_rate + corners) / (doubled_rate - corners)
    denominators = [[1.0, -2.0 * pole.real, (pole * pole.conj()).real] for pole in poles[::2]]
    sections = np.array([[*rows[0], *rows[1]] for rows in zip(numerators, denominators, strict=True)]).reshape(order, 6)
    sections[:1, :3] *= gain
    return sections
