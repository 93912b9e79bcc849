"""The decimation filter of a delta-sigma converter.

A delta-sigma converter oversamples. A long linear-phase low-pass filter then removes content above half the sample
rate. Here the filter acts on the continuous signal. Each sample interval is divided into `oversampling` equal
*intervals*. The signal chain provides the exact moments of the signal over each interval, impacts included: integrals
of the signal times Legendre polynomials. The impulse response of the filter is expanded in Legendre polynomials over
the same intervals. The sum of moments times coefficients is the convolution integral.
"""

from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.polynomial import chebyshev, legendre
from numpy.typing import ArrayLike

from rig.core.base.arrays import Array

# Number of Legendre moments per interval. The relative error of the filter's output is then at most 3e-6.
MOMENTS = 8
# Edge of the passband as a ratio to the sample rate, as in data sheets of delta-sigma converters.
PASSBAND_EDGE = 0.4535
# Edge of the stopband as a ratio to the sample rate: frequencies from half the sample rate to this edge fold to the
# edge of the passband or above.
STOPBAND_EDGE = 0.5465
# Delay of the filter, half its length. With a Kaiser window of this length, the stopband is below -100 dB.
DELAY_SAMPLES = 38
# Design attenuation of the Kaiser window; beta = 0.1102 (attenuation - 8.7) (J. F. Kaiser, 1974).
_ATTENUATION_DB = 109.0


@dataclass(frozen=True)
class DecimationFilter:
    """A linear-phase low-pass filter: a sinc with a Kaiser window, symmetric about its delay.

    The response is flat within 0.0001 dB up to 0.4535 of the sample rate, and below -100 dB from 0.5465 of it.
    Frequencies up to 0.4535 of the sample rate are therefore free of aliases.

    >>> low_pass = DecimationFilter.standard(5120.0)
    >>> [f"{20 * np.log10(abs(low_pass.amplitude_response(ratio * 5120.0))):.4f}" for ratio in (0.1, 0.4, 0.5)]
    ['0.0000', '0.0000', '-6.0206']
    """

    rate: float  # sample rate [Hz]
    delay: float  # half the length of the impulse response, in sample intervals
    cutoff: float  # ratio to the sample rate
    beta: float  # shape parameter of the Kaiser window

    @classmethod
    def standard(cls, rate: float) -> Self:
        """Return the filter of every delta-sigma converter here, for a sample rate in Hz."""
        return cls(rate, float(DELAY_SAMPLES), 0.5 * (PASSBAND_EDGE + STOPBAND_EDGE), 0.1102 * (_ATTENUATION_DB - 8.7))

    @property
    def parameters(self) -> dict[str, float]:
        """The fields, for the metadata of a recording."""
        return asdict(self)

    @property
    def length(self) -> int:
        """Length of the impulse response, in sample intervals."""
        return int(np.ceil(2 * self.delay))

    def impulse_response(self, time: Array) -> Array:
        """Return the impulse response at times from its middle, in sample intervals; its integral is 1 within 1e-5."""
        inside = np.clip(1.0 - (time / self.delay) ** 2, 0.0, None)
        window = np.where(inside > 0, np.i0(self.beta * np.sqrt(inside)) / np.i0(self.beta), 0.0)
        return 2 * self.cutoff * np.sinc(2 * self.cutoff * time) * window

    def amplitude_response(self, frequency: ArrayLike) -> Array:
        """Return the zero-phase response: the frequency response without the delay, at frequencies in Hz."""
        # The Fourier integral is computed as a sum. With 16 points per sample, its error is below 1e-6 up to 15 times
        # the sample rate.
        points_per_sample = 16
        values = self.impulse_response(np.arange(self.delay * points_per_sample) / points_per_sample)
        values[1:] *= 2.0
        angle = 2 * np.pi * np.asarray(frequency, dtype=float) / (self.rate * points_per_sample)
        # A sum of cosines of multiples of an angle is a Chebyshev series in the cosine of the angle.
        return np.asarray(chebyshev.chebval(np.cos(angle), values / values.sum()))


@lru_cache(maxsize=8)
def legendre_taps(low_pass: DecimationFilter, oversampling: int) -> Array:
    """Return the Legendre coefficients of the impulse response, shape (oversampling, MOMENTS, length).

    `length` is the length of the response in sample intervals. Entry (p, k, j) multiplies moment k of the interval
    whose end is j sample intervals and p intervals before the output sample.
    """
    # Exact for polynomials up to the degree 63.
    nodes, weights = legendre.leggauss(32)
    interval = np.arange(low_pass.length * oversampling)[:, None]
    # Time from each quadrature node of an interval (-1: start, 1: end) to the output sample, in sample intervals.
    lag = (interval + 0.5 * (1.0 - nodes)) / oversampling
    values = low_pass.impulse_response(lag - low_pass.delay) * weights
    polynomials = legendre.legvander(nodes, MOMENTS - 1) * (2 * np.arange(MOMENTS) + 1)
    taps = values @ polynomials
    taps /= taps[:, 0].sum()
    return np.ascontiguousarray(taps.reshape(low_pass.length, oversampling, MOMENTS).transpose(1, 2, 0))
