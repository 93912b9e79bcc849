"""Detects hammer impacts in the live force signal, and their faults: clipping, a double impact, a low peak."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array

# The window of an impact begins this time before the trigger [s]: it contains the rise of the pulse.
_PRETRIGGER_S = 0.01
# An impact is double if the peak of its second pulse is at least this fraction of the highest peak. A double impact is
# rejected, because its spectrum has deep minima.
_REBOUND_RATIO = 0.05
# The trigger level is this fraction of the smallest accepted peak, so smaller impacts are also detected, and
# rejected.
_TRIGGER_RATIO = 0.3
# Samples above the trigger level belong to one pulse if the gap between them is shorter than this value [s]. The force
# of a ringing hammer crosses zero several times in a pulse.
_PULSE_GAP_S = 1e-3
# Duration of the displayed force [s].
_DISPLAYED_S = 0.05


@dataclass(eq=False)
class Impact:
    """An impact, its faults, and whether it is accepted."""

    number: int  # Number of the impact, from 1
    first: int  # First sample of the window
    peak: float  # Peak force [N]
    faults: list[str]  # Reasons to reject the impact
    force: Array  # Force around the pulse [N]
    readings: Array  # Readings of all channels in the window, shape (channels, samples)
    overloaded: list[int]  # Rows of the readings with an overload in the window
    is_complete: bool = True  # Whether the window is complete
    accepted: bool = field(init=False)  # Whether the impact is averaged; the operator can change this

    def __post_init__(self) -> None:
        self.accepted = not self.faults

    @property
    def window_samples(self) -> int:
        """Number of samples of its window."""
        return self.readings.shape[1]


class ImpactDetector:
    """Detects impacts in the channel of the hammer, and checks each impact for faults at the end of its window.

    `row` is the row of this channel in the readings, `min_peak` the smallest accepted peak [N]. `window` is the
    duration of a window [s]: the time after the trigger, and a short time before it, that belong to one impact.
    `pending` is the impact whose window is not yet complete, as far as it is known; None without such an impact.
    """

    def __init__(self, row: int, rate: float, min_peak: float, window: float) -> None:
        self._row, self._rate, self.min_peak = row, rate, min_peak
        self._pretrigger, self._window_samples = round(_PRETRIGGER_S * rate), round(window * rate)
        self._readings: Array | None = None
        self._overload: NDArray[np.bool_] = np.zeros((0, 0), bool)
        self._first = 0
        self.impacts: list[Impact] = []
        self.pending: Impact | None = None

    def add(self, first: int, readings: Array, overload: NDArray[np.bool_]) -> list[Impact]:
        """Add the next readings, the first with the number `first`; return the impacts whose windows are complete."""
        if self._readings is None or first != self._first + self._readings.shape[1]:
            self._readings, self._overload, self._first = readings, overload, first
        else:
            self._readings = np.concatenate([self._readings, readings], axis=1)
            self._overload = np.concatenate([self._overload, overload], axis=1)
        n_before = len(self.impacts)
        while (impact := self._next_impact()) is not None:
            self.impacts.append(impact)
        return self.impacts[n_before:]

    def _next_impact(self) -> Impact | None:
        """Return and remove the first impact whose window is complete; None if there is none."""
        assert self._readings is not None
        self.pending = None
        force = self._readings[self._row]
        is_above = force > _TRIGGER_RATIO * self.min_peak
        trigger = int(np.argmax(is_above)) if is_above.any() else force.size
        self._drop(max(0, trigger - self._pretrigger))
        if not is_above.any():
            return None
        if self._readings.shape[1] < self._window_samples:
            self.pending = self._judge(self._readings, self._overload)
            return None
        impact = self._judge(self._readings[:, : self._window_samples], self._overload[:, : self._window_samples])
        self._drop(self._window_samples)
        return impact

    def _judge(self, window: Array, overload: NDArray[np.bool_]) -> Impact:
        """Return the impact in a window that begins with the next sample, with its faults."""
        force = window[self._row]
        peak = float(force.max())
        faults = []
        if overload.any():
            faults.append("clipped")
        if count_pulses(force, max(_REBOUND_RATIO * peak, 0.1 * self.min_peak), _PULSE_GAP_S * self._rate) > 1:
            faults.append("double impact")
        # The true peak of a clipped impact is higher.
        if peak < self.min_peak and "clipped" not in faults:
            faults.append("too weak")
        displayed = force[: round(_DISPLAYED_S * self._rate)]
        is_complete = window.shape[1] == self._window_samples
        overloaded = np.flatnonzero(overload.any(axis=1)).tolist()
        return Impact(len(self.impacts) + 1, self._first, peak, faults, displayed, window, overloaded, is_complete)

    def _drop(self, samples: int) -> None:
        """Remove the oldest stored samples."""
        assert self._readings is not None
        self._readings, self._overload = self._readings[:, samples:], self._overload[:, samples:]
        self._first += samples


def count_pulses(force: Array, threshold: float, gap: float) -> int:
    """Count the pulses above a threshold that are more than `gap` samples apart.

    >>> count_pulses(np.array([0.0, 5.0, 9.0, 4.0, 0.0, 0.0, 0.0, 3.0, 0.0]), threshold=1.0, gap=2)
    2
    """
    indices_above = np.flatnonzero(force > threshold)
    return 0 if not indices_above.size else 1 + int(np.count_nonzero(np.diff(indices_above) > gap))
