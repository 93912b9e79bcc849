"""Largest responses of single-degree-of-freedom oscillators to an acceleration of their base.

Ramp-invariant filter for the absolute acceleration: D. O. Smallwood, Shock Vib. Bull. 51 (1981) 279; ISO 18431-4. The
filter joins samples by straight lines, which attenuate the frequency f by sinc^2(f / rate). A filter of five samples
compensates for the attenuation.
"""

from math import ceil

import numpy as np
from scipy import signal
from scipy.interpolate import BSpline

from rig.core.base.arrays import Array

# Minimum number of samples in a period of an oscillator. A parabola through three samples then gives its extremes with
# an error below 0.1 %.
_SAMPLES_PER_PERIOD = 10.0
# Minimum number of samples in a period for interpolation by a spline, whose error is then below 0.5 %. In contrast to a
# band-limited interpolation, a spline does not oscillate about an abrupt start of the motion.
_SAMPLES_FOR_SPLINE = 5.0
# Taps of the filter that compensates for the attenuation by straight lines, 1 + s^2 / 12 + s^4 / 90 with s = 2 sin(pi f
# / rate). Its error is below 0.01 % at a tenth of the sample rate.
_COMPENSATION = np.array([1.0, -11.5, 111.0, -11.5, 1.0]) / 90.0
# Number of samples by which the spline is extended: it depends on more distant samples by less than rounding.
_REFLECTED = 30


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
    if (factor := ceil(_SAMPLES_FOR_SPLINE * highest / rate)) > 1:
        acceleration, rate = signal.resample_poly(acceleration, factor, 1), factor * rate
    if (factor := ceil(_SAMPLES_PER_PERIOD * highest / rate)) > 1:
        acceleration, rate = _interpolate(acceleration, factor), factor * rate
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


def _interpolate(values: Array, factor: int) -> Array:
    """Return values of a cubic spline at a multiple of the sample rate; the last samples are zero."""
    extended = _reflected(values, _REFLECTED)
    basis = BSpline.basis_element(np.arange(-2, 3))(np.arange(1 - 2 * factor, 2 * factor) / factor)
    spline = signal.upfirdn(basis, signal.cspline1d(extended), factor)
    first = (extended.size - values.size + 2) * factor - 1
    return np.asarray(spline[first : first + (values.size - 1) * factor + 1])


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
