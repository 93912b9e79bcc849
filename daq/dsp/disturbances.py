"""Voltages that enter a channel besides its signal: noise and offsets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.numerics.fma import fused
from rig.numerics.jit import unfused_kernel


class Disturbance(Protocol):
    """A source of a voltage for every sample, in order."""

    def fill(self, samples: Array) -> None:
        """Fill in the next samples, V, shape (samples,)."""


class Offset:
    """A constant voltage, which settles exponentially from zero at sample 0 if it has a time constant in s.

    >>> bias = Offset(10.0, 2.0, 1.0)
    >>> samples = np.empty(6)
    >>> bias.fill(samples[:5])
    >>> bias.fill(samples[5:])
    >>> samples.round(3).tolist()
    [0.0, 3.935, 6.321, 7.769, 8.647, 9.179]
    """

    def __init__(self, level: float, time: float | None, rate: float) -> None:
        self._level, self._loss = level, 1.0 if time is None else float(-np.expm1(-1.0 / (time * rate)))
        # Difference to the final level.
        self._missing = np.array([0.0 if time is None else level])

    def fill(self, samples: Array) -> None:
        """Fill in the next samples, V."""
        _settle(samples, self._level, self._loss, self._missing)


@unfused_kernel
def _settle(samples: Array, level: float, loss: float, missing: Array) -> None:
    """Fill in the samples one by one, so that they do not depend on where a block ends."""
    deviation = missing[0]
    for i in range(samples.size):
        samples[i] = level - deviation
        deviation = fused(-loss, deviation, deviation)
    missing[0] = deviation


class Disturbances:
    """All disturbances of a channel, each a Legendre polynomial over the interval that ends at its sample.

    `direct` is the share of each that reaches the output at once; degrees 1 and 2 follow a disturbance of degree
    0.
    """

    def __init__(
        self, sources: Sequence[Disturbance], direct: Array, degrees: Sequence[int], oversampling: int
    ) -> None:
        self._sources, self._oversampling = tuple(sources), oversampling
        self._direct, self._has_direct = direct, bool(direct.any())
        self._degrees = tuple(degrees)
        self._interval, self._drawn = 0, 0
        self._last = np.zeros((len(sources), 1))

    def draw(self, intervals: int) -> Array:
        """Draw the disturbances of the next intervals, polynomials over each; shape (disturbances, intervals), V."""
        first, stop = self._interval, self._interval + intervals
        self._interval = stop
        if not self._sources or intervals == 0:
            return np.zeros((len(self._sources), intervals))
        count = -(-(stop - 1) // self._oversampling) + 1 - self._drawn
        voltages = np.empty((len(self._sources), count))
        for row, source in zip(voltages, self._sources, strict=True):
            source.fill(row)
        if self._oversampling > 1:
            # The sample at or after the end of each interval; an interval of a sample that began in the last block
            # continues with the numbers drawn there.
            sample = -(-np.arange(first, stop) // self._oversampling)
            voltages_with_last = np.concatenate([self._last, voltages], axis=1)
            voltages, self._last = voltages_with_last[:, sample - (self._drawn - 1)], voltages_with_last[:, -1:]
            self._split(voltages, (np.arange(first, stop) - 1) % self._oversampling)
        self._drawn += count
        return voltages

    def _split(self, voltages: Array, place: NDArray[np.int64]) -> None:
        """Write polynomials over samples for the interval at a place in each sample."""
        length = 1.0 / self._oversampling
        middle = (2 * place + 1) * length - 1.0
        for row, degree in enumerate(self._degrees):
            if degree == 1:
                voltages[row - 1] += middle * voltages[row]
                voltages[row] *= length
            elif degree == 2:
                voltages[row - 2] += (0.5 * (3.0 * middle * middle - 1.0) + 0.5 * length * length) * voltages[row]
                voltages[row - 1] += 3.0 * middle * length * voltages[row]
                voltages[row] *= length * length

    def add_direct(self, voltages: Array, volts: Array) -> None:
        """Add the direct feedthrough of the disturbances of `draw`, at intervals that end at a sample, to the volts."""
        if self._has_direct:
            _sum_up(self._direct, voltages, volts)


@unfused_kernel
def _sum_up(shares: Array, rows: Array, out: Array) -> None:
    """Add rows, each times its share."""
    for e in range(shares.size):
        if shares[e] != 0.0:
            for k in range(out.size):
                out[k] = fused(shares[e], rows[e, k], out[k])
