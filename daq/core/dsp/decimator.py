"""Decimation filter of a delta-sigma converter: weighted sums of moments of a signal over short intervals.

An oversampling converter has several intervals in each sample interval. The moments over an interval are integrals of
the signal times Legendre polynomials (`daq.core.dsp.discretization`).
"""

import numpy as np

from daq.core.dsp.block_buffers import SharedScratch
from rig.core.base.arrays import Array
from rig.core.numerics.fma import SUM_BLOCK, factored_sums
from rig.core.numerics.jit import unfused_kernel
from rig.core.numerics.simd import LANES, aligned_zeros


class Decimator:
    """Decimation filter of one channel, delayed by `delay` intervals.

    Write the moments of the next intervals into `moments_buffer`, then call `filter`. All channels share `scratch`.
    `taps`, shape (oversampling, moments, length): from `daq.core.signal_chain.decimation_filter.legendre_taps`.
    """

    def __init__(self, taps: Array, delay: int, scratch: SharedScratch) -> None:
        self._oversampling, moments, length = taps.shape
        self._weights = _lane_weights(taps, delay)
        self._scratch = scratch
        # Moments of the last intervals of the previous block; the moments of the next block follow them.
        self._history = aligned_zeros(length * self._oversampling + delay - 1, moments)
        self._moments = self._history
        self._intervals = 0  # number of samples filtered so far
        self._samples = aligned_zeros(0)

    def moments_buffer(self, count: int) -> Array:
        """Return the array for the moments of the next `count` intervals, to be filled in; (> count, moments)."""
        begin = len(self._history)
        end = begin + count + SUM_BLOCK * self._oversampling
        self._moments = self._scratch.rows(end)
        self._moments[:begin] = self._history
        # Padding: multiplied by zero weights, so that it must be finite.
        self._moments[begin + count : end] = 0.0
        return self._moments[begin:]

    def filter(self, count: int) -> Array:
        """Return the samples that end in the next `count` intervals, whose moments are in `moments_buffer`."""
        # Index of the first interval that ends a sample, and index in `_moments` of the first interval of this sample's
        # sum.
        first_end = -self._intervals % self._oversampling
        samples = max(0, -(-(count - first_end) // self._oversampling))  # rounded up
        if self._samples.size < samples + SUM_BLOCK:
            self._samples = aligned_zeros(samples + SUM_BLOCK)
        _sum_moments(self._weights, self._moments, first_end, self._oversampling, self._samples, samples)
        self._intervals += count
        self._history[:] = self._moments[count : count + len(self._history)]
        return self._samples[:samples]


def _lane_weights(taps: Array, delay: int) -> Array:
    """Return the weights of the moments in `LANES` successive samples; (intervals * moments, LANES).

    `LANES` is the number of values in a processor register; this number of samples is computed at once.
    """
    oversampling, moments, _ = taps.shape
    # taps[p, :, j] are the weights of the interval that is j samples and p intervals before the sample.
    taps_backward = np.concatenate([np.zeros((delay, moments)), taps.transpose(2, 0, 1).reshape(-1, moments)])
    weights = aligned_zeros(len(taps_backward) + (LANES - 1) * oversampling, moments, LANES)
    for lane in range(LANES):
        weights[lane * oversampling :, :, lane][: len(taps_backward)] = taps_backward[::-1]
    return weights.reshape(-1, LANES)


@unfused_kernel
def _sum_moments(weights: Array, moments: Array, first: int, oversampling: int, samples: Array, count: int) -> None:
    """Fill in `count` samples: weighted sums of moments. The first sum begins at interval `first` of `moments`."""
    width = moments.shape[1]
    registers = -(-count // LANES)  # rounded up
    factored_sums(weights, moments, first * width, 1, LANES * oversampling * width, samples, 0, registers)
