"""Landing on a spring-damper that pushes and never pulls: duration and restitution, stiffness and damping.

A bed of mass m_d meets a wall of a body of mass m_b at the relative speed v, both free otherwise. With the reduced
mass m = m_d m_b / (m_d + m_b), w^2 = k / m and the damping ratio z = c / (2 m w), the wall's force is

    F(t) = m v w e^{-z w t} sin(w_d t + 2 b) / cos b,     sin b = z,  w_d = w cos b

(the hyperbolic form of it beyond critical damping), a step to c v at the touch. It is zero again after

    T = 2 acos(z) / (w sqrt(1 - z^2)),     acosh and sqrt(z^2 - 1) for z > 1,

before the overlap is zero: there the bed leaves, at e = exp(-z w T) times its approach speed.

References
----------
Schwager, T., Poeschel, T., "Coefficient of restitution and linear-dashpot model revisited", Granular Matter 9 (2007)
465-469, Eqs 15-22.
"""

from __future__ import annotations

import math

#: Time in which a wall without restitution recovers from an overlap, c / k, in seconds. No contact that only pushes
#: takes all speed out of a rebound: its dashpot would be infinitely strong, and its spring soft. The strongest one
#: that has recovered before a bed comes back leaves less the shorter the landing is: 5 % at 2 ms, 0.15 % at 0.1 ms.
RECOVERY = 5e-3


def _angle(ratio: float) -> float:
    """acos(z) / sqrt(1 - z^2) of a damping ratio z, continued beyond critical damping."""
    if ratio == 1.0:
        return 1.0
    width = math.sqrt(abs((1.0 - ratio) * (1.0 + ratio)))
    return (math.acos(ratio) if ratio < 1.0 else math.acosh(ratio)) / width


def damping_ratio(duration: float, restitution: float) -> float:
    """Damping ratio of the contact with a duration [s] and a restitution.

    >>> damping_ratio(2e-3, 1.0), round(damping_ratio(2e-3, math.exp(-2.0)), 12), damping_ratio(RECOVERY, 0.0)
    (0.0, 1.0, 1.0)
    """
    # Few scenes need it, and its import is slow.
    from scipy.optimize import brentq

    if restitution == 0.0:
        # c / k = 2 z / w = z T / angle(z), which is z pi / 2 T for small and z^2 T / log(2 z) for large z.
        wanted = max(RECOVERY / duration, 1.0)
        return float(brentq(lambda z: z / _angle(z) - wanted, 0.5, 2.0 * wanted, xtol=1e-15))
    wanted = -math.log(restitution)
    # 2 z angle(z) lies between z pi for small and 2 log(2 z) for large z.
    return float(
        brentq(lambda z: 2.0 * z * _angle(z) - wanted, 0.0, 1.0 + math.exp(0.5 * wanted), xtol=1e-15)
    )


def spring_damper(duration: float, restitution: float, mass: float) -> tuple[float, float]:
    """Stiffness [N/m] and damping [N s/m] of the contact with a duration and a restitution.

    `duration`: from touch to release of a landing under no other force, s; `restitution`: ratio of separation to
    approach speed; 0: the lowest that is possible with `RECOVERY`; `mass`: reduced mass of damper and body, kg.

    >>> stiffness, damping = spring_damper(duration=2e-3, restitution=0.3, mass=0.04)
    >>> [round(value, 9) for value in landing(stiffness, damping, mass=0.04)]
    [0.002, 0.3]
    """
    ratio = damping_ratio(duration, restitution)
    rate = 2.0 * _angle(ratio) / duration
    return mass * rate**2, 2.0 * ratio * rate * mass


def landing(stiffness: float, damping: float, mass: float) -> tuple[float, float]:
    """Duration [s] and restitution of a landing on a contact; the inverse of `spring_damper`."""
    rate = math.sqrt(stiffness / mass)
    ratio = damping / (2.0 * mass * rate)
    duration = 2.0 * _angle(ratio) / rate
    return duration, math.exp(-ratio * rate * duration)
