"""The completely inelastic bouncing ball in closed form: a damper of vanishing mass on a body with sinusoidal motion.

The displacement of the body is G sin(p) in units of g/w^2. Here p = w t is the phase, and G the peak acceleration in
units of g. The ball is at rest on the body until the body accelerates downward by more than g, from sin(p) = 1/G on. It
flies and lands without rebound. It sticks if the body's downward acceleration is then less than g. Otherwise it takes
off at once, with the velocity of the body.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Peak acceleration, in g, from which the first flight takes a full period or longer. A flight of 2 pi from sin(p) = 1/G
# requires G cos(p) = pi.
FULL_PERIOD_ACCELERATION_G = float(np.hypot(1.0, np.pi))


@dataclass(frozen=True)
class Flight:
    """A flight of the ball: phases of take-off and landing, rad; they increase over several periods."""

    start: float
    end: float
    speed: float  # closing speed at landing, in units of g/w


def take_off_phase(acceleration: float) -> float:
    """Return the phase of take-off in [0, pi/2]; `acceleration`: peak acceleration of the body, at least 1 g.

    >>> round(take_off_phase(2.0) / np.pi, 6)
    0.166667
    """
    if not acceleration >= 1:
        raise ValueError(f"peak acceleration {acceleration} g: below 1 g the ball never takes off")
    return float(np.arcsin(1 / acceleration))


def fly(acceleration: float, start: float) -> Flight:
    """Return the flight that begins at phase `start` (p0) with the velocity of the body.

    At the phase t after take-off, the gap is h(t) = G (sin p0 - sin(p0 + t)) + G cos(p0) t - t^2/2. Its curvature
    G sin(p0 + t) - 1 changes sign only at known phases. Between them h is convex or concave, so that its first zero can
    be bracketed.
    """
    peak_g = acceleration

    def gap(t: float) -> float:
        return float(peak_g * (np.sin(start) - np.sin(start + t)) + peak_g * np.cos(start) * t - t * t / 2)

    def slope(t: float) -> float:
        return float(peak_g * (np.cos(start) - np.cos(start + t)) - t)

    first_inflection = take_off_phase(peak_g)
    low = 0.0
    # In every period the curvature is positive from the first inflection to pi minus it.
    periods = np.arange(np.ceil(np.sqrt(8 * peak_g) + peak_g) + 3)[:, None] + np.floor(start / (2 * np.pi))
    inflections = (np.array([first_inflection, np.pi - first_inflection]) + 2 * np.pi * periods).ravel() - start
    for high in inflections[inflections > 1e-9]:
        is_convex = peak_g * np.sin(start + 0.5 * (low + high)) > 1
        if is_convex and slope(low) < 0 < slope(high):
            minimum = _zero(slope, low, high)
            if gap(minimum) < 0:
                return _landing(peak_g, start, _zero(gap, low, minimum))
        elif gap(high) < 0:
            return _landing(peak_g, start, _zero(gap, low, high))
        low = float(high)
    raise AssertionError("a ball in free fall lands")


def _landing(peak_g: float, start: float, t: float) -> Flight:
    speed = t - peak_g * (np.cos(start) - np.cos(start + t))
    return Flight(start, start + t, float(speed))


def _zero(function: Callable[[float], float], low: float, high: float) -> float:
    from scipy.optimize import brentq

    return float(brentq(function, low, high, xtol=1e-15, rtol=4 * np.finfo(float).eps))
