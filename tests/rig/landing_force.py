"""The peak force of a finite-duration impact (linear spring and dashpot), in closed form."""

import math


def peak_force(stiffness: float, damping: float, mass: float, speed: float) -> float:
    """Return the largest contact force of an impact at a closing speed [m/s], N; `mass`: reduced mass, kg.

    With the damping ratio sin(b), the force is largest at w_d t = pi / 2 - 3 b after the start of contact. From a ratio
    of 1/2 on it is largest at the start.
    """
    omega = math.sqrt(stiffness / mass)
    damping_ratio = damping / (2.0 * mass * omega)
    if damping_ratio >= 0.5:
        return damping * speed
    b = math.asin(damping_ratio)
    return mass * speed * omega * math.exp(-math.tan(b) * (0.5 * math.pi - 3.0 * b))
