"""Decimation: moments of a signal in, filtered samples out."""

from __future__ import annotations

import numpy as np

from daq.dsp.block_buffers import BlockBuffers
from rig.arrays import Array
from rig.numerics.fma import SUM_BLOCK, factored_sums
from rig.numerics.jit import unfused_kernel
from rig.numerics.simd import LANES, aligned_zeros


class Decimator:
    """Applies the filter with the given `Decimation.taps` to one channel, delayed by `delay` intervals."""

    def __init__(self, taps: Array, delay: int, buffers: BlockBuffers) -> None:
        self._oversampling, moments, length = taps.shape
        self._weights = _lane_weights(taps, delay)
        self._buffers = buffers
        # The last moments of the previous block; in a block, they come first.
        self._last = aligned_zeros(length * self._oversampling + delay - 1, moments)
        self._moments = self._last
        self._interval = 0
        self._samples = aligned_zeros(0)

    def place(self, count: int) -> Array:
        """Return the place for the moments of the next intervals, shape (count and SUMS_AT_ONCE or more, MOMENTS)."""
        past = len(self._last)
        end = past + count + SUM_BLOCK * self._oversampling
        self._moments = self._buffers.rows(end)
        self._moments[:past] = self._last
        # The intervals behind have no weight, but must be finite.
        self._moments[past + count : end] = 0.0
        return self._moments[past:]

    def filter(self, count: int) -> Array:
        """Return the samples that end with the next `count` intervals, whose moments are in `place`."""
        oversampling = self._oversampling
        wait = -self._interval % oversampling
        due = max(0, -(-(count - wait) // oversampling))
        if self._samples.size < due + SUM_BLOCK:
            self._samples = aligned_zeros(due + SUM_BLOCK)
        _weigh(self._weights, self._moments, wait, oversampling, self._samples, due)
        self._interval += count
        self._last[:] = self._moments[count : count + len(self._last)]
        return self._samples[:due]


def _lane_weights(taps: Array, delay: int) -> Array:
    """Arrange the taps as weights (intervals x MOMENTS, LANES) for as many samples at a time as a register holds."""
    oversampling, moments, _ = taps.shape
    # Row (p, j) of the taps weighs the interval j samples and p intervals before the sample.
    history = np.concatenate([np.zeros((delay, moments)), taps.transpose(2, 0, 1).reshape(-1, moments)])
    weights = aligned_zeros(len(history) + (LANES - 1) * oversampling, moments, LANES)
    for lane in range(LANES):
        weights[lane * oversampling :, :, lane][: len(history)] = history[::-1]
    return weights.reshape(-1, LANES)


@unfused_kernel
def _weigh(weights: Array, moments: Array, first: int, oversampling: int, samples: Array, count: int) -> None:
    """Weigh the moments of each sample, from the interval `first` on."""
    width = moments.shape[1]
    registers = -(-count // LANES)
    factored_sums(weights, moments, first * width, 1, LANES * oversampling * width, samples, 0, registers)
