"""Sampling of the voltage at the converter's input."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from daq.dsp.block_buffers import BlockBuffers, History
from daq.dsp.circuit import Circuit
from daq.dsp.decimator import Decimator
from daq.signal_chain.decimation_filter import MOMENTS, Decimation, taps_of
from rig.arrays import Array
from rig.numerics.fma import SUMS_AT_ONCE
from rig.numerics.simd import LANES


class Sampler(Protocol):
    """Takes samples."""

    integrals: int  # required moments of the voltage over each interval
    intervals: int  # intervals that affect a sample, up to the interval that ends at it
    rows: Array  # required voltages at the end of each interval, from the state; (outputs, states)
    rows_input: Array  # and from the input; (outputs,)

    def place(self, intervals: int) -> Array:
        """Return the place for moments, shape (at least intervals + SUMS_AT_ONCE or 0, LANES)."""

    def read(self, points: Array, ends: slice) -> Array:
        """Return the samples in V, valid until the next call, from the voltages of `rows` and the latest moments."""


class PointSampler:
    """Reads the voltage at the instant of the sample; an impulse between two instants does not show."""

    integrals = 0

    def __init__(self, circuit: Circuit, gain: float, oversampling: int, late: int) -> None:
        self.rows, self.rows_input = circuit.c[None], np.array([circuit.d[0] * gain])
        self.intervals = oversampling + late
        self._late, self._voltage = late, History(late)
        self._no_moments = np.zeros((0, LANES))

    def place(self, intervals: int) -> Array:
        """Return the place for moments; see `Sampler`."""
        return self._no_moments

    def read(self, points: Array, ends: slice) -> Array:
        """Return the samples; see `Sampler`."""
        if not self._late:
            return np.asarray(points[0, ends])
        self._voltage.place(points.shape[1])[:] = points[0]
        return self._voltage.samples[ends].copy()


class AverageSampler:
    """Averages the voltage over the interval that ends at the sample: for a signal that may hold impulses."""

    integrals = 1

    def __init__(self, circuit: Circuit, oversampling: int, late: int, buffers: BlockBuffers) -> None:
        self.rows, self.rows_input = np.zeros((0, circuit.c.size)), np.zeros(0)
        self._oversampling, self._past = oversampling, History(oversampling - 1 + late)
        self.intervals = oversampling + late
        self._buffers = buffers
        self._averages = buffers.rows(0)

    def place(self, intervals: int) -> Array:
        """Return the place for moments; see `Sampler`."""
        self._averages = self._buffers.rows(intervals + SUMS_AT_ONCE)
        return self._averages

    def read(self, points: Array, ends: slice) -> Array:
        """Return the samples; see `Sampler`."""
        self._past.place(points.shape[1])[:] = self._averages[: points.shape[1], 0]
        samples = self._past.samples[ends].copy()
        for later in range(1, self._oversampling):
            samples += self._past.samples[ends.start + later : ends.stop + later : ends.step]
        samples /= self._oversampling
        return samples


class FilteredSampler:
    """Reads behind the decimation filter of a delta-sigma converter, `late` intervals further back."""

    integrals = MOMENTS

    def __init__(
        self, circuit: Circuit, low_pass: Decimation, oversampling: int, late: int, buffers: BlockBuffers
    ) -> None:
        self.rows, self.rows_input = np.zeros((0, circuit.c.size)), np.zeros(0)
        self._filter = Decimator(taps_of(low_pass, oversampling), late, buffers)
        self.intervals = low_pass.length * oversampling + late

    def place(self, intervals: int) -> Array:
        """Return the place for moments; see `Sampler`."""
        return self._filter.place(intervals)

    def read(self, points: Array, ends: slice) -> Array:
        """Return the samples; see `Sampler`."""
        return self._filter.filter(points.shape[1])


class Jitter:
    """Takes samples early or late, through the slope of the voltage between samples.

    The slope reduces the effect on fast signals by sinc(f / rate); second order and delays of whole intervals are
    neglected.
    """

    def __init__(self, circuit: Circuit, gain: float, deviation: float, wait: int) -> None:
        self.row, self.row_input = circuit.c, float(circuit.d[0] * gain)
        self._deviation = deviation
        self._voltage = History(wait + 1)

    def error(self, voltage: Array, late: Array) -> Array:
        """Return the change of each sample, V, from the nominal voltage and the lateness in standard deviations."""
        count = voltage.size
        self._voltage.place(count)[:] = voltage
        due = self._voltage.samples
        error = np.subtract(due[1 : count + 1], due[:count])
        error *= late
        error *= self._deviation
        return error
