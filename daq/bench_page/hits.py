"""Detection of hammer hits in the force, and of their faults: clipping, a double hit, a peak that is too low."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array

# Time before the rise of the force that belongs to a window, s.
_PRETRIGGER_S = 0.01
# A second pulse of at least this ratio to the peak makes a double hit, whose spectrum has deep minima.
_REBOUND_RATIO = 0.05
# Ratio of the trigger level to the weakest accepted peak: hits that are too weak are detected as well.
_TRIGGER_RATIO = 0.3
# Maximum gap within a pulse, s: the force of a ringing hammer crosses zero.
_PULSE_GAP_S = 1e-3
# Duration of the displayed force, s.
_SHOWN_S = 0.05


@dataclass(eq=False)
class Hit:
    """A hit, its faults, and whether it is accepted."""

    number: int  # From 1
    first: int  # First sample of its window
    peak: float  # N
    faults: list[str]  # Reasons to reject it
    force: Array  # Around the pulse, N
    readings: Array  # All channels over the window, shape (channels, samples)
    accepted: bool = field(init=False)  # Whether it enters the frequency response

    def __post_init__(self) -> None:
        self.accepted = not self.faults

    @property
    def size(self) -> int:
        """Length of its window, samples."""
        return self.readings.shape[1]


class HitDetector:
    """Detects hits in the hammer's channel, and assesses each at the end of its window.

    `row`: the hammer's channel; `min_peak`: smallest accepted peak, N; `window`: duration of a window, s.
    """

    def __init__(self, row: int, rate: float, min_peak: float, window: float) -> None:
        self._row, self._rate, self.min_peak = row, rate, min_peak
        self._pretrigger, self._size = round(_PRETRIGGER_S * rate), round(window * rate)
        self._readings: Array | None = None
        self._overload: NDArray[np.bool_] = np.zeros((0, 0), bool)
        self._first = 0
        self.hits: list[Hit] = []

    def add(self, first: int, readings: Array, overload: NDArray[np.bool_]) -> list[Hit]:
        """Add the next samples, the first numbered `first`; return the hits whose windows are complete."""
        if self._readings is None or first != self._first + self._readings.shape[1]:
            self._readings, self._overload, self._first = readings, overload, first
        else:
            self._readings = np.concatenate([self._readings, readings], axis=1)
            self._overload = np.concatenate([self._overload, overload], axis=1)
        n_before = len(self.hits)
        while (hit := self._next()) is not None:
            self.hits.append(hit)
        return self.hits[n_before:]

    def _next(self) -> Hit | None:
        assert self._readings is not None
        force = self._readings[self._row]
        above = force > _TRIGGER_RATIO * self.min_peak
        trigger = int(np.argmax(above)) if above.any() else force.size
        self._drop(max(0, trigger - self._pretrigger))
        if not above.any() or self._readings.shape[1] < self._size:
            return None
        window, overload = self._readings[:, : self._size], self._overload[:, : self._size]
        force = window[self._row]
        peak = float(force.max())
        faults = []
        if overload.any():
            faults.append("clipped")
        if pulses(force, max(_REBOUND_RATIO * peak, 0.1 * self.min_peak), _PULSE_GAP_S * self._rate) > 1:
            faults.append("double hit")
        # The true peak of a clipped hit is higher.
        if peak < self.min_peak and "clipped" not in faults:
            faults.append("too weak")
        displayed = force[: round(_SHOWN_S * self._rate)]
        hit = Hit(len(self.hits) + 1, self._first, peak, faults, displayed, window)
        self._drop(self._size)
        return hit

    def _drop(self, samples: int) -> None:
        assert self._readings is not None
        self._readings, self._overload = self._readings[:, samples:], self._overload[:, samples:]
        self._first += samples


def pulses(force: Array, threshold: float, gap: float) -> int:
    """Count the pulses above a threshold that are more than `gap` samples apart.

    >>> pulses(np.array([0.0, 5.0, 9.0, 4.0, 0.0, 0.0, 0.0, 3.0, 0.0]), threshold=1.0, gap=2)
    2
    """
    above = np.flatnonzero(force > threshold)
    return 0 if not above.size else 1 + int(np.count_nonzero(np.diff(above) > gap))
