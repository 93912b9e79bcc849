"""Samples that a limit of the sensor or the amplifier has affected, though the converter was within its own range."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.dsp.circuit import RECOVERY
from daq.signal_chain.stage import Stage

Array = NDArray[np.float64]

# Share of the limit below which the shift of zero after an overload is negligible: the last digit of a data sheet.
NEGLIGIBLE_ZERO_SHIFT = 1e-3


class Overloads:
    """Flags samples with an interval at a limit, or with a shift of zero that is not negligible yet."""

    def __init__(self, stages: Sequence[Stage], rate: float, intervals: int) -> None:
        fades = [-section.a[0, 0] for section in stages[0].sections if section.name == RECOVERY]
        self._decay_intervals = rate / fades[0] if fades else 0.0
        self._intervals_per_sample = intervals
        self._severity = np.zeros(1)
        self._flagged_ahead = 0

    def place(self, intervals: int) -> Array:
        """Return the place for the severity of each interval; see `daq.dsp.propagation.propagate`."""
        last, self._severity = self._severity[-1], np.empty(1 + intervals)
        self._severity[0] = last
        return self._severity

    def flags(self, ends: slice) -> NDArray[np.bool_]:
        """Return the flag of each sample that ends at one of the intervals `ends`."""
        severity = self._severity[1:]  # 0: within the limit; otherwise 1 + zero shift / limit
        if self._flagged_ahead <= 0 and not severity.any():
            return np.zeros(severity[ends].size, dtype=bool)
        overloaded = np.flatnonzero(severity)
        # The zero shift decays exponentially; count the intervals until it is negligible.
        excess = np.maximum((severity[overloaded] - 1.0) / NEGLIGIBLE_ZERO_SHIFT, 1.0)
        recovery = np.ceil(self._decay_intervals * np.log(excess)).astype(np.int64)
        valid_from = np.zeros(severity.size + 1, dtype=np.int64)
        valid_from[0] = self._flagged_ahead  # carried over from the previous block
        valid_from[overloaded + 1] = overloaded + self._intervals_per_sample + recovery
        valid_from = np.maximum.accumulate(valid_from)
        self._flagged_ahead = int(valid_from[-1]) - severity.size
        return (valid_from[1:] > np.arange(severity.size))[ends]
