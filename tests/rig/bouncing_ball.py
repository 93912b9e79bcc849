"""The completely inelastic bouncing ball: a damper of vanishing mass on a body that moves as a sine.

A body moves as G sin(p) in units of g/w^2, with p = w t the phase and G its peak acceleration over g. The
ball rides it until the body falls faster than gravity, at sin(p) = 1/G; it flies, lands without rebound, and
rides again if the body's acceleration there lets it, else it takes off at once with the body's velocity.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# The peak acceleration, over g, from which the first flight takes a full period or longer: the ball then
# lands where it took off or later. Follows from a flight of 2 pi starting at sin(p) = 1/G, whence G cos(p) =
# pi.
FULL_PERIOD = float(np.hypot(1.0, np.pi))


@dataclass(frozen=True)
class Flight:
    """One flight of the ball; phases in radians, counted on from the phase of take-off.

    `start`, `end`: phase of take-off and of landing.
    """

    start: float
    end: float
    speed: float  # closing speed at landing, in units of g/w
    sticks: bool  # whether the ball rides after landing (else it takes off again at once)


def take_off(acceleration: float) -> float:
    """Phase in [0, pi/2] at which the ball leaves; `acceleration` is the body's peak over g, 1 or more.

    >>> round(take_off(2.0) / np.pi, 6)
    0.166667
    """
    if not acceleration >= 1:
        raise ValueError(f"peak acceleration {acceleration} g: below 1 g the ball never leaves")
    return float(np.arcsin(1 / acceleration))


def fly(acceleration: float, start: float) -> Flight:
    """Flight that begins at phase `start` with the body's own velocity.

    The gap is h(t) = G (sin p0 - sin(p0 + t)) + G cos(p0) t - t^2/2. Its curvature G sin(p0 + t) - 1 changes
    sign at known phases only; between them h is convex or concave, so its first zero is isolated without a
    search.
    """
    g = acceleration

    def gap(t: float) -> float:
        return float(g * (np.sin(start) - np.sin(start + t)) + g * np.cos(start) * t - t * t / 2)

    def slope(t: float) -> float:
        return float(g * (np.cos(start) - np.cos(start + t)) - t)

    rise = take_off(g)
    low = 0.0
    # Curvature is positive between rise and pi - rise in every turn; take-off itself is where it vanishes.
    turns = np.arange(np.ceil(np.sqrt(8 * g) + g) + 3)[:, None] + np.floor(start / (2 * np.pi))
    bends = (np.array([rise, np.pi - rise]) + 2 * np.pi * turns).ravel() - start
    for high in bends[bends > 1e-9]:
        convex = g * np.sin(start + 0.5 * (low + high)) > 1
        if convex and slope(low) < 0 < slope(high):
            lowest = _zero(slope, low, high)
            if gap(lowest) < 0:
                return _landing(g, start, _zero(gap, low, lowest))
        elif gap(high) < 0:
            return _landing(g, start, _zero(gap, low, high))
        low = float(high)
    raise AssertionError("a ball in free fall lands")


def sequence(acceleration: float, longest: int = 1000) -> list[Flight]:
    """Flights from a first take-off after riding until the ball rides again: one sticking cycle.

    The motion repeats with it. At some accelerations the ball never rides again; the list then stops after
    `longest` flights, its last one not sticking.
    """
    flights = [fly(acceleration, take_off(acceleration))]
    while not flights[-1].sticks and len(flights) < longest:
        flights.append(fly(acceleration, flights[-1].end))
    return flights


def _landing(g: float, start: float, t: float) -> Flight:
    speed = t - g * (np.cos(start) - np.cos(start + t))
    return Flight(start, start + t, float(speed), bool(g * np.sin(start + t) < 1))


def _zero(function: Callable[[float], float], low: float, high: float) -> float:
    from scipy.optimize import brentq

    return float(brentq(function, low, high, xtol=1e-15, rtol=4 * np.finfo(float).eps))
