"""Sampling of the voltage at the converter's input: at an instant, as an average, or through a decimation filter.

The voltage is computed in equal intervals, one or more per sample (oversampling). Its moments over an interval are the
integrals of the voltage times the Legendre polynomials; the first is the average.
"""

from typing import Protocol

import numpy as np

from daq.core.dsp.block_buffers import Overlap, SharedScratch
from daq.core.dsp.circuit import Circuit
from daq.core.dsp.decimator import Decimator
from daq.core.signal_chain.decimation_filter import MOMENTS, DecimationFilter, legendre_taps
from rig.core.base.arrays import Array
from rig.core.numerics.fma import SUMS_AT_ONCE
from rig.core.numerics.simd import LANES


class Sampler(Protocol):
    """Computes the samples of a block from the voltage at the converter's input."""

    moments: int  # required number of moments of the voltage over each interval
    intervals: int  # number of intervals on which a sample depends, up to the interval that ends at it
    # Required outputs at the end of each interval are output_matrix @ state + feedthrough * input.
    output_matrix: Array  # (outputs, states)
    feedthrough: Array  # (outputs,)

    def moments_buffer(self, intervals: int) -> Array:
        """Return the array into which the moments of the next intervals are written.

        Its shape is (rows, LANES), with at least intervals + SUMS_AT_ONCE rows. It has no rows if no moments are
        required.
        """

    def read(self, outputs: Array, sample_ends: slice) -> Array:
        """Return the samples of a block [V] from the outputs (outputs, intervals) and the moments in the buffer.

        `sample_ends` selects the intervals that end at a sample. The result is valid until the next call.
        """


class PointSampler:
    """Reads the voltage at the instant of the sample; impulses between two instants are missed."""

    moments = 0

    def __init__(self, circuit: Circuit, gain: float, oversampling: int, delay_intervals: int) -> None:
        self.output_matrix, self.feedthrough = circuit.c[None], np.array([circuit.d[0] * gain])
        self.intervals = oversampling + delay_intervals
        self._delay_intervals, self._voltage = delay_intervals, Overlap(delay_intervals)
        self._no_moments = np.zeros((0, LANES))

    def moments_buffer(self, intervals: int) -> Array:
        """Return the array for the moments; see `Sampler`."""
        return self._no_moments

    def read(self, outputs: Array, sample_ends: slice) -> Array:
        """Return the samples; see `Sampler`."""
        if not self._delay_intervals:
            return np.asarray(outputs[0, sample_ends])
        self._voltage.reserve(outputs.shape[1])[:] = outputs[0]
        return self._voltage.samples[sample_ends].copy()


class AverageSampler:
    """Averages the voltage over the sample interval that ends at the sample, so no impulse is missed."""

    moments = 1

    def __init__(self, circuit: Circuit, oversampling: int, delay_intervals: int, buffers: SharedScratch) -> None:
        self.output_matrix, self.feedthrough = np.zeros((0, circuit.c.size)), np.zeros(0)
        self._oversampling, self._averages = oversampling, Overlap(oversampling - 1 + delay_intervals)
        self.intervals = oversampling + delay_intervals
        self._buffers = buffers
        self._moments = buffers.rows(0)

    def moments_buffer(self, intervals: int) -> Array:
        """Return the array for the moments; see `Sampler`."""
        self._moments = self._buffers.rows(intervals + SUMS_AT_ONCE)
        return self._moments

    def read(self, outputs: Array, sample_ends: slice) -> Array:
        """Return the samples; see `Sampler`."""
        self._averages.reserve(outputs.shape[1])[:] = self._moments[: outputs.shape[1], 0]
        averages = self._averages.samples
        samples = averages[sample_ends].copy()
        for offset in range(1, self._oversampling):
            samples += averages[sample_ends.start + offset : sample_ends.stop + offset : sample_ends.step]
        samples /= self._oversampling
        return samples


class FilteredSampler:
    """Returns the output of the decimation filter of a delta-sigma converter, delayed by `delay_intervals`."""

    moments = MOMENTS

    def __init__(
        self,
        circuit: Circuit,
        low_pass: DecimationFilter,
        oversampling: int,
        delay_intervals: int,
        buffers: SharedScratch,
    ) -> None:
        self.output_matrix, self.feedthrough = np.zeros((0, circuit.c.size)), np.zeros(0)
        self._filter = Decimator(legendre_taps(low_pass, oversampling), delay_intervals, buffers)
        self.intervals = low_pass.length * oversampling + delay_intervals

    def moments_buffer(self, intervals: int) -> Array:
        """Return the array for the moments; see `Sampler`."""
        return self._filter.moments_buffer(intervals)

    def read(self, outputs: Array, sample_ends: slice) -> Array:
        """Return the samples; see `Sampler`."""
        return self._filter.filter(outputs.shape[1])


class Jitter:
    """Timing jitter: the error of each sample is the timing error times the slope between neighboring samples.

    The difference quotient underestimates the slope of a sinusoid by the factor sinc(f / rate). Second-order terms and
    delays of whole intervals are neglected. `standard_deviation` of the sampling instant and `filter_delay` of the
    decimation filter are in sample intervals.
    """

    def __init__(self, standard_deviation: float, filter_delay: int) -> None:
        self._standard_deviation = standard_deviation
        self._voltage = Overlap(filter_delay + 1)

    def error(self, voltage: Array, timing_error: Array) -> Array:
        """Return the error of each sample [V] from the voltages without jitter.

        `timing_error` is in standard deviations of the jitter.
        """
        count = voltage.size
        self._voltage.reserve(count)[:] = voltage
        delayed = self._voltage.samples
        error = np.subtract(delayed[1 : count + 1], delayed[:count])
        error *= timing_error
        error *= self._standard_deviation
        return error
