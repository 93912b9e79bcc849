"""Decimation filter of a delta-sigma converter: weighted sums of moments of a signal over short intervals.

An oversampling converter has several intervals in each sample interval. The moments over an interval are integrals of
the signal times Legendre polynomials (`daq.dsp.discretization`).
"""

from __future__ import annotations

import numpy as np

from daq.dsp.block_buffers import SharedScratch
from rig.arrays import Array
from rig.numerics.fma import SUM_BLOCK, factored_sums
from rig.numerics.jit import unfused_kernel
from rig.numerics.simd import LANES, aligned_zeros


class Decimator:
    """Decimation filter of one channel, delayed by `delay` intervals.

    Write the moments of the next intervals into `moments_buffer`, then call `filter`. All channels share `scratch`.
    `taps`, shape (oversampling, moments, length): from `daq.signal_chain.decimation_filter.legendre_taps`.
    """

    def __init__(self, taps: Array, delay: int, scratch: SharedScratch) -> None:
        self._oversampling, moments, length = taps.shape
        self._weights = _lane_weights(taps, delay)
        self._scratch = scratch
        # Moments of the last intervals of the previous block, which precede those of the next.
        self._last = aligned_zeros(length * self._oversampling + delay - 1, moments)
        self._moments = self._last
        self._intervals = 0  # filtered so far
        self._samples = aligned_zeros(0)

    def moments_buffer(self, count: int) -> Array:
        """Return the array for the moments of the next `count` intervals, to be filled in; (> count, MOMENTS)."""
        begin = len(self._last)
        end = begin + count + SUM_BLOCK * self._oversampling
        self._moments = self._scratch.rows(end)
        self._moments[:begin] = self._last
        # The intervals after the block have the weight zero, but must be finite.
        self._moments[begin + count : end] = 0.0
        return self._moments[begin:]

    def filter(self, count: int) -> Array:
        """Return the samples that end in the next `count` intervals, whose moments are in `moments_buffer`."""
        oversampling = self._oversampling
        first_end = -self._intervals % oversampling
        samples = max(0, -(-(count - first_end) // oversampling))
        if self._samples.size < samples + SUM_BLOCK:
            self._samples = aligned_zeros(samples + SUM_BLOCK)
        _sum_moments(self._weights, self._moments, first_end, oversampling, self._samples, samples)
        self._intervals += count
        self._last[:] = self._moments[count : count + len(self._last)]
        return self._samples[:samples]


def _lane_weights(taps: Array, delay: int) -> Array:
    """Return the weights of the moments in `LANES` successive samples; (intervals * moments, LANES).

    `LANES` is the number of values in a processor register: these samples are computed at once.
    """
    oversampling, moments, _ = taps.shape
    # Row (p, j) of the taps has the weights of the interval j samples and p intervals before the sample.
    taps_backward = np.concatenate([np.zeros((delay, moments)), taps.transpose(2, 0, 1).reshape(-1, moments)])
    weights = aligned_zeros(len(taps_backward) + (LANES - 1) * oversampling, moments, LANES)
    for lane in range(LANES):
        weights[lane * oversampling :, :, lane][: len(taps_backward)] = taps_backward[::-1]
    return weights.reshape(-1, LANES)


@unfused_kernel
def _sum_moments(weights: Array, moments: Array, first: int, oversampling: int, samples: Array, count: int) -> None:
    """Fill in `count` samples: weighted sums of moments. The sum of the first sample begins at the interval `first`."""
    width = moments.shape[1]
    registers = -(-count // LANES)
    factored_sums(weights, moments, first * width, 1, LANES * oversampling * width, samples, 0, registers)
