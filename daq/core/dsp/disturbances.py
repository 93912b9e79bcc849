"""Voltages that enter a channel besides its signal: noise and offsets."""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.polynomial.legendre import leggauss, legval
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.numerics.fma import fused
from rig.core.numerics.jit import unfused_kernel


class Disturbance(Protocol):
    """A source of disturbance voltages, one for each successive sample."""

    def fill(self, samples: Array) -> None:
        """Fill in the next samples [V], shape (samples,)."""


class Offset:
    """A constant voltage in V. With a time constant in s it rises exponentially from zero at sample 0.

    >>> bias = Offset(10.0, 2.0, 1.0)
    >>> samples = np.empty(6)
    >>> bias.fill(samples[:5])
    >>> bias.fill(samples[5:])
    >>> samples.round(3).tolist()
    [0.0, 3.935, 6.321, 7.769, 8.647, 9.179]
    """

    def __init__(self, level: float, time_constant: float | None, rate: float) -> None:
        self._level = level
        # Relative decrease of the deviation from the final level in a sample interval.
        self._decay = 1.0 if time_constant is None else float(-np.expm1(-1.0 / (time_constant * rate)))
        self._deviation = np.array([0.0 if time_constant is None else level])

    def fill(self, samples: Array) -> None:
        """Fill in the next samples [V]."""
        _fill_settling(samples, self._level, self._decay, self._deviation)


class OffsetPolynomial:
    """A Legendre coefficient of an `Offset` over the interval before each sample [V]; 0 before sample 0.

    `degree`: 0 to 2. The coefficients of these degrees represent the rise with an error of at most (interval / time
    constant)^3 / 100 of the level; the mean over an interval is exact.

    >>> samples = np.empty(4)
    >>> OffsetPolynomial(10.0, 2.0, 1.0, 0).fill(samples)
    >>> samples.round(3).tolist()  # means over the intervals before each sample
    [0.0, 2.131, 5.227, 7.105]
    """

    def __init__(self, level: float, time_constant: float | None, rate: float, degree: int) -> None:
        self._has_started, self._level = False, level if degree == 0 else 0.0
        self._decay, self._deviation = 1.0, np.zeros(1)
        if time_constant is not None:
            interval = 1.0 / (time_constant * rate)
            self._decay = float(-np.expm1(-interval))
            self._deviation[0] = level * _legendre_coefficient(interval, degree)

    def fill(self, samples: Array) -> None:
        """Fill in the next coefficients [V]."""
        first = 0 if self._has_started else min(1, samples.size)
        self._has_started |= first > 0
        samples[:first] = 0.0
        _fill_settling(samples[first:], self._level, self._decay, self._deviation)


def _legendre_coefficient(interval: float, degree: int) -> float:
    """Return the Legendre coefficient of ``exp(-t)`` over an interval that begins at t = 0.

    >>> round(_legendre_coefficient(1.0, 0), 6)  # 1 - exp(-1)
    0.632121
    """
    nodes, weights = leggauss(64)
    values = np.exp(-0.5 * interval * (1.0 + nodes)) * legval(nodes, [0.0] * degree + [degree + 0.5])
    return math.fsum((weights * values).tolist())


@unfused_kernel
def _fill_settling(samples: Array, level: float, decay: float, last_deviation: Array) -> None:
    """Fill in the samples one by one, so that they do not depend on where a block ends."""
    deviation = last_deviation[0]
    for i in range(samples.size):
        samples[i] = level - deviation
        deviation = fused(-decay, deviation, deviation)
    last_deviation[0] = deviation


class Disturbances:
    """All disturbances of a channel, each a voltage times a Legendre polynomial over the interval before a sample.

    `direct`: direct feedthrough of each disturbance to the output; `degrees`: degrees of the polynomials;
    `oversampling`: number of intervals in a sample interval. The disturbances of degrees 0, 1 and 2 of each noise
    follow one another. `has_direct`: whether any feedthrough is not 0.
    """

    def __init__(
        self, sources: Sequence[Disturbance], direct: Array, degrees: Sequence[int], oversampling: int
    ) -> None:
        self._sources, self._oversampling = tuple(sources), oversampling
        self._direct, self.has_direct = direct, bool(direct.any())
        self._degrees = tuple(degrees)
        self._n_intervals, self._n_samples = 0, 0  # numbers of intervals and of samples drawn so far
        self._last = np.zeros((len(sources), 1))

    def draw(self, intervals: int) -> Array:
        """Return the voltage of each disturbance in the next intervals [V], shape (disturbances, intervals)."""
        first, stop = self._n_intervals, self._n_intervals + intervals
        self._n_intervals = stop
        if not self._sources or intervals == 0:
            return np.zeros((len(self._sources), intervals))
        count = -(-(stop - 1) // self._oversampling) + 1 - self._n_samples  # rounded up
        voltages = np.empty((len(self._sources), count))
        for row, source in zip(voltages, self._sources, strict=True):
            source.fill(row)
        if self._oversampling > 1:
            # Index of the sample at or after the end of each interval. The voltages of a sample interval that began in
            # the previous block were drawn with that block.
            sample = -(-np.arange(first, stop) // self._oversampling)  # rounded up
            voltages_with_last = np.concatenate([self._last, voltages], axis=1)
            # With `take`, unlike with an index, the rows are contiguous, which is faster.
            voltages = voltages_with_last.take(sample - (self._n_samples - 1), axis=1)
            self._last = voltages_with_last[:, -1:]
            self._split_polynomials(voltages, (np.arange(first, stop) - 1) % self._oversampling)
        self._n_samples += count
        return voltages

    def _split_polynomials(self, voltages: Array, index: NDArray[np.int64]) -> None:
        """Convert polynomials over a sample interval to polynomials over each of its intervals, in place.

        `index`: number of each interval in its sample interval, from 0.
        """
        # A sample interval extends from -1 to 1.
        length = 1.0 / self._oversampling
        middle = (2 * index + 1) * length - 1.0
        for row, degree in enumerate(self._degrees):
            if degree == 1:
                voltages[row - 1] += middle * voltages[row]
                voltages[row] *= length
            elif degree == 2:
                voltages[row - 2] += (0.5 * (3.0 * middle * middle - 1.0) + 0.5 * length * length) * voltages[row]
                voltages[row - 1] += 3.0 * middle * length * voltages[row]
                voltages[row] *= length * length

    def add_direct(self, voltages: Array, volts: Array) -> None:
        """Add the direct feedthrough of `voltages` (from `draw`) to `volts`, the outputs at the ends of intervals."""
        _add_weighted(self._direct, voltages, volts)


@unfused_kernel
def _add_weighted(weights: Array, rows: Array, out: Array) -> None:
    """Add each row times its weight to `out`."""
    for e in range(weights.size):
        if weights[e] != 0.0:
            for k in range(out.size):
                out[k] = fused(weights[e], rows[e, k], out[k])
