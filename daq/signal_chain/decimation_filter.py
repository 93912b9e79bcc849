"""The decimation filter of a delta-sigma converter.

Such a converter oversamples and reports the output of a long symmetric low-pass filter, which removes content above
half the sample rate. Here the filter acts on the continuous signal: the chain provides the exact Legendre moments of
the signal over every sample interval, impacts included, and the filter, divided into sample intervals and expanded in
Legendre polynomials, weights these moments. The sum is the integral of signal times filter.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev, legendre
from numpy.typing import ArrayLike

from rig.arrays import Array

# Eight moments represent any signal over a sample interval with an error of 3e-6 of the filter's output.
MOMENTS = 8
# Edge of the pass band, ratio to the sample rate.
PASS = 0.4535
# Edge of the stop band, ratio to the sample rate.
STOP = 0.5465
# Delay in samples. A Kaiser window of this length falls by over 100 dB between pass and stop band.
DELAY = 38
# Design attenuation of the Kaiser window, dB.
_ATTENUATION_DB = 109.0


@dataclass(frozen=True)
class Decimation:
    """A linear-phase low pass: a sinc with a Kaiser window, symmetric about its delay.

    Flat within 0.0001 dB up to 0.4535 of the sample rate and below -100 dB from 0.5465 of it on, so that
    everything up to 0.4535 is free of aliases.

    >>> low_pass = Decimation.standard(5120.0)
    >>> [f"{20 * np.log10(abs(low_pass.magnitude(share * 5120.0))):.4f}" for share in (0.1, 0.4, 0.5)]
    ['0.0000', '0.0000', '-6.0206']
    """

    rate: float
    delay: float
    cutoff: float
    beta: float

    @classmethod
    def standard(cls, rate: float) -> Decimation:
        """Return the filter of this design for a sample rate in Hz."""
        return cls(rate, float(DELAY), 0.5 * (PASS + STOP), 0.1102 * (_ATTENUATION_DB - 8.7))

    @property
    def design(self) -> dict[str, float]:
        """Parameters, for metadata."""
        return asdict(self)

    @property
    def length(self) -> int:
        """Length in sample intervals."""
        return int(np.ceil(2 * self.delay))

    def impulse_response(self, time: Array) -> Array:
        """Value at times in samples from its middle; its integral is 1 within 1e-5."""
        inside = np.clip(1.0 - (time / self.delay) ** 2, 0.0, None)
        window = np.where(inside > 0, np.i0(self.beta * np.sqrt(inside)) / np.i0(self.beta), 0.0)
        return 2 * self.cutoff * np.sinc(2 * self.cutoff * time) * window

    def magnitude(self, frequency: ArrayLike) -> Array:
        """Response without the delay; real, as the filter is symmetric. Frequencies in Hz, any shape."""
        # A sum over 16 points a sample instead of the integral: accurate to 1e-6 up to 15 times the sample
        # rate.
        points = 16
        values = self.impulse_response(np.arange(self.delay * points) / points)
        values[1:] *= 2.0
        angle = 2 * np.pi * np.asarray(frequency, dtype=float) / (self.rate * points)
        return np.asarray(chebyshev.chebval(np.cos(angle), values / values.sum()))


@lru_cache(maxsize=8)
def taps_of(low_pass: Decimation, oversampling: int) -> Array:
    """Project the impulse response on the Legendre polynomials of every interval; (oversampling, MOMENTS, length).

    Entry (p, k, j) weighs moment k of the interval that ends p intervals and j samples before the output.
    """
    nodes, weights = legendre.leggauss(32)
    interval = np.arange(low_pass.length * oversampling)[:, None]
    # Time from the nodes of each interval (-1: start, 1: end) to the output.
    lag = (interval + 0.5 * (1.0 - nodes)) / oversampling
    values = low_pass.impulse_response(lag - low_pass.delay) * weights
    polynomials = legendre.legvander(nodes, MOMENTS - 1) * (2 * np.arange(MOMENTS) + 1)
    taps = values @ polynomials
    taps /= taps[:, 0].sum()
    return np.ascontiguousarray(taps.reshape(low_pass.length, oversampling, MOMENTS).transpose(1, 2, 0))
