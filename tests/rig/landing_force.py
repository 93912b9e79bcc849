"""The largest force of a finite-duration impact, in closed form."""

from __future__ import annotations

import math


def peak_force(stiffness: float, damping: float, mass: float, speed: float) -> float:
    """Largest contact force of an impact at a relative speed [m/s], N.

    It comes at the angle w_d t = pi / 2 - 3 b after the touch, or right there from a damping ratio of 1/2 on.
    """
    rate = math.sqrt(stiffness / mass)
    ratio = damping / (2.0 * mass * rate)
    if ratio >= 0.5:
        return damping * speed
    lean = math.asin(ratio)
    return mass * speed * rate * math.exp(-math.tan(lean) * (0.5 * math.pi - 3.0 * lean))
