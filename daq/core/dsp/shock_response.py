"""Largest responses of single-degree-of-freedom oscillators to an acceleration of their base.

Ramp-invariant filter for the absolute acceleration: D. O. Smallwood, Shock Vib. Bull. 51 (1981) 279; ISO 18431-4. The
filter joins samples by straight lines, which attenuate the frequency f by sinc^2(f / rate). A filter of five samples
compensates for the attenuation.
"""

from math import ceil

import numpy as np
from scipy import signal

from rig.core.base.arrays import Array

# Minimum number of samples in a period of an oscillator. A parabola through three samples then gives its extremes with
# an error below 0.1 %, also where impacts cause sharp peaks.
_SAMPLES_PER_PERIOD = 20.0
# Length of the interpolation filter on each side, in samples of the motion, and shape of its Kaiser window. The band up
# to 0.46 times the sample rate passes, so motions with impacts have errors below 0.2 %.
_FILTER_SAMPLES, _FILTER_SHAPE = 40, 8.0
# Taps of the filter that compensates for the attenuation by straight lines, 1 + s^2 / 12 + s^4 / 90 with s = 2 sin(pi f
# / rate). Its error is below 0.01 % at a tenth of the sample rate.
_COMPENSATION = np.array([1.0, -11.5, 111.0, -11.5, 1.0]) / 90.0


def shock_response(acceleration: Array, rate: float, frequency: Array, q: float) -> tuple[Array, Array]:
    """Return the largest and the smallest acceleration of oscillators, during and after a motion of their base.

    `acceleration`: shape (samples,), from rest; `rate`: Hz; `frequency`: natural frequencies [Hz], shape (n,); `q`:
    quality factor, 1 / (2 damping ratio), above 0.5. Results in the unit of the acceleration, shape (n,).

    >>> largest, smallest = shock_response(np.ones(1000), 1000.0, np.array([10.0]), q=10.0)
    >>> f"{largest[0]:.2f}"  # a step of the base
    '1.86'
    """
    # After the motion, the extremes of an oscillator occur within one period.
    acceleration = np.append(acceleration, np.zeros(ceil(rate / float(np.min(frequency))) + 4))
    highest = float(np.max(frequency))
    if (factor := ceil(_SAMPLES_PER_PERIOD * highest / rate)) > 1:
        taps = signal.firwin(2 * _FILTER_SAMPLES * factor + 1, 1.0 / factor, window=("kaiser", _FILTER_SHAPE))
        # A shorter motion is reflected as a whole; zeros before its reflection are outside the range of the filter.
        count = min(_FILTER_SAMPLES, acceleration.size - 1)
        extended = _reflected(acceleration, count)
        acceleration = signal.resample_poly(extended, factor, 1, window=taps)[count * factor :]
        rate *= factor
    acceleration = np.convolve(_reflected(acceleration, _COMPENSATION.size // 2), _COMPENSATION, "valid")
    damping = 0.5 / q
    extremes = []
    for omega in 2.0 * np.pi * np.asarray(frequency) / rate:  # rad per sample
        damped = omega * np.sqrt(1.0 - damping**2)
        e = np.exp(-damping * omega)
        c, s = e * np.cos(damped), e * np.sin(damped) / damped
        response = signal.lfilter([1.0 - s, 2.0 * (s - c), e**2 - s], [1.0, -2.0 * c, e**2], acceleration)
        extremes.append((_largest(response), -_largest(-response)))
    largest, smallest = np.array(extremes).T
    return largest, smallest


def _reflected(values: Array, count: int) -> Array:
    """Return values with `count` reflected samples before them, so the slope has no step at their start."""
    return np.concatenate([2.0 * values[0] - values[count:0:-1], values])


def _largest(values: Array) -> float:
    """Return the largest value, at the vertex of the parabola through the largest sample and its neighbors."""
    index = int(np.argmax(values))
    if not 0 < index < values.size - 1:
        return float(values[index])
    before, here, after = values[index - 1 : index + 2]
    curvature = 2.0 * here - before - after
    return float(here + ((after - before) ** 2 / (8.0 * curvature) if curvature > 0.0 else 0.0))
