"""Samples in which a limit of sensor or amplifier has a part: overloads, though the converter was not at its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.dsp.circuit import RECOVERY
from daq.signal_chain.stage import Stage

Array = NDArray[np.float64]

# A shift of zero below this share of the limit is over.
_OVER = 1e-3


class Overloads:
    """Marks samples, block after block, from the intervals in which a limit was reached.

    A sample counts as overloaded if a limit was reached in any interval that it is made of, or if the shift of zero
    that is left behind is still more than a thousandth of the limit.

    Parameters
    ----------
    stages : sequence of Stage
        Sensor first.
    rate : float
        Intervals a second.
    intervals : int
        Intervals that a sample is made of, up to the one that ends at it.
    """

    def __init__(self, stages: Sequence[Stage], rate: float, intervals: int) -> None:
        fades = [-section.a[0, 0] for section in stages[0].sections if section.name == RECOVERY]
        self._fading = rate / fades[0] if fades else 0.0
        self._intervals = intervals
        self._reached = np.zeros(1)
        # Intervals from the start of the block for which the last overload still counts.
        self._lasts = 0

    def place(self, intervals: int) -> Array:
        """Give the place for what came of the intervals; see `daq.dsp.propagation.propagate`."""
        last, self._reached = self._reached[-1], np.empty(1 + intervals)
        self._reached[0] = last
        return self._reached

    def read(self, ends: slice) -> NDArray[np.bool_]:
        """Give the flags of the samples that end at some of these intervals."""
        reached = self._reached[1:]
        if self._lasts <= 0 and not reached.any():
            return np.zeros(reached[ends].size, dtype=bool)
        places = np.flatnonzero(reached)
        shift = np.maximum((reached[places] - 1.0) / _OVER, 1.0)
        until = np.zeros(reached.size + 1, dtype=np.int64)
        until[0] = self._lasts
        until[1 + places] = places + self._intervals + np.ceil(self._fading * np.log(shift)).astype(np.int64)
        until = np.maximum.accumulate(until)
        self._lasts = int(until[-1]) - reached.size
        return (until[1:] > np.arange(reached.size))[ends]
