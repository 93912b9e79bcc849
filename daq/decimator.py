"""The decimation filter at work: moments of a signal in, samples out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.jit import unfused

Array = NDArray[np.float64]


class Decimator:
    """The filter at work on one channel.

    Parameters
    ----------
    taps : ndarray, shape (oversampling, MOMENTS, length)
        From `Decimation.taps`.
    """

    def __init__(self, taps: Array) -> None:
        # Zeros fill the rows up to what a processor works off at a time; singles at the end would take as long.
        self._taps = np.pad(taps, [(0, 0), (0, 0), (0, -taps.shape[2] % 16)])
        self._pending = np.zeros(self._taps.shape[2])
        self._interval = 0

    def filter(self, moments: Array, count: int) -> Array:
        """Give the samples that fall due.

        Parameters
        ----------
        moments : ndarray, shape (MOMENTS, intervals or more)
            Moments of the following intervals. The first interval of all ends at sample 0.
        count : int
            Number of intervals.

        Returns
        -------
        ndarray, shape (samples,)
            One sample for every interval that ends at one.
        """
        oversampling = self._taps.shape[0]
        due = -(-(self._interval + count) // oversampling) - -(-self._interval // oversampling)
        sums = np.zeros(due + self._pending.size + 1)
        sums[: self._pending.size] = self._pending
        _accumulate(moments, count, self._taps, -self._interval % oversampling, sums)
        self._interval += count
        self._pending = sums[due : due + self._pending.size]
        return sums[:due]


@unfused
def _accumulate(moments: Array, count: int, taps: Array, phase: int, sums: Array) -> None:
    """Add what each interval contributes to this and the following samples.

    `phase` is the number of intervals from the end of the first one to the sample it falls to; `sums` holds
    the samples from that one on. Each contribution is a sum in one fixed order, however the intervals are
    split.
    """
    sample = 0
    for i in range(count):
        m0, m1, m2, m3 = moments[0, i], moments[1, i], moments[2, i], moments[3, i]
        m4, m5, m6, m7 = moments[4, i], moments[5, i], moments[6, i], moments[7, i]
        for j in range(taps.shape[2]):
            sums[sample + j] += (
                (m0 * taps[phase, 0, j] + m1 * taps[phase, 1, j])
                + (m2 * taps[phase, 2, j] + m3 * taps[phase, 3, j])
            ) + (
                (m4 * taps[phase, 4, j] + m5 * taps[phase, 5, j])
                + (m6 * taps[phase, 6, j] + m7 * taps[phase, 7, j])
            )
        if phase == 0:
            sample += 1
            phase = taps.shape[0]
        phase -= 1
