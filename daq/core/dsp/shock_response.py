"""Largest responses of single-degree-of-freedom oscillators to an acceleration of their base.

Ramp-invariant filter for the absolute acceleration: D. O. Smallwood, Shock Vib. Bull. 51 (1981) 279; ISO 18431-4.
"""

from math import ceil

import numpy as np
from scipy import signal

from rig.core.base.arrays import Array

# Minimum number of samples in a period of an oscillator. A parabola through three samples then gives its extremes with
# an error below 0.1 %.
_SAMPLES_PER_PERIOD = 10.0


def shock_response(acceleration: Array, rate: float, frequency: Array, q: float) -> tuple[Array, Array]:
    """Return the largest and the smallest acceleration of oscillators, during and after a motion of their base.

    `acceleration`: shape (samples,), from rest; `rate`: Hz; `frequency`: natural frequencies, Hz, shape (n,); `q`:
    quality factor, 1 / (2 damping ratio), above 0.5. Results in the unit of the acceleration, shape (n,).

    >>> largest, smallest = shock_response(np.ones(1000), 1000.0, np.array([10.0]), q=10.0)
    >>> f"{largest[0]:.2f}"  # a step of the base
    '1.86'
    """
    factor = ceil(_SAMPLES_PER_PERIOD * float(np.max(frequency)) / rate)
    if factor > 1:
        acceleration, rate = signal.resample_poly(acceleration, factor, 1), factor * rate
    # After the motion, the extremes of an oscillator occur within one period.
    acceleration = np.append(acceleration, np.zeros(ceil(rate / float(np.min(frequency))) + 1))
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


def _largest(values: Array) -> float:
    """Return the largest value, at the vertex of the parabola through the largest sample and its neighbors."""
    index = int(np.argmax(values))
    if not 0 < index < values.size - 1:
        return float(values[index])
    before, here, after = values[index - 1 : index + 2]
    curvature = 2.0 * here - before - after
    return float(here + ((after - before) ** 2 / (8.0 * curvature) if curvature > 0.0 else 0.0))
