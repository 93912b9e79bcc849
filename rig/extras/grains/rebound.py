"""The restitution setting of LAMMPS with which grains rebound with the desired restitution.

For the dashpot of a contact, LAMMPS uses the closing speed half a step before the instant of the force. With about
fifty steps in a contact, the rebound is therefore slower than desired, by 1 % for lead. This module applies the same
scheme to one central contact, and computes the setting that gives the desired restitution.
"""

import math

import numpy as np
from scipy.optimize import brentq

from rig.core.base.arrays import Array
from rig.core.scene.damper import Grains

#: Closing speed at which the rebound has the desired restitution [m/s]; impacts in a bed have 0.05 to 1 m/s.
_CLOSING_SPEED = 0.3
#: A contact may begin anywhere in a step; the rebound is averaged over this number of evenly spaced beginnings.
_START_COUNT = 16
#: Maximum number of time steps of a contact, so a contact that never ends is reported.
_MAX_STEPS = 100_000


def restitution_at_step(grains: Grains, mass: float, radius: float, step: float) -> float:
    """Compute the setting of LAMMPS with which grains rebound as specified, although the time step is finite.

    `mass`, `radius`: reduced mass [kg] and reduced radius [m] of the contact: equal to mass and radius of the grain at
    a wall, and half as large between two equal grains; `step`: time step [s].

    >>> lead = Grains(diameter="2 mm", modulus="10 MPa")
    >>> round(restitution_at_step(lead, mass=4.75e-5, radius=1e-3, step=5.7e-6), 3)
    0.202
    """

    def deviation(setting: float) -> float:
        """Return the mean restitution with a setting of LAMMPS, minus the desired restitution."""
        return float(_restitutions(grains, setting, mass, radius, step).mean()) - grains.restitution

    max_restitution = 1.0 - 1e-9
    if deviation(max_restitution) <= 0.0:
        return max_restitution
    return float(brentq(deviation, 0.5 * grains.restitution, max_restitution, xtol=1e-7))


def _restitutions(grains: Grains, setting: float, mass: float, radius: float, step: float) -> Array:
    """Compute the restitutions of contacts that begin at different instants of a step, shape (_START_COUNT,)."""
    # Contact law of LAMMPS: hertz/material with damping coeff_restitution.
    modulus = grains.modulus / (2.0 * (1.0 - grains.poisson_ratio**2))
    damping_ratio = -math.log(setting) / math.hypot(math.log(setting), math.pi)
    damping = 2.0 * math.sqrt(5.0 / 6.0) * damping_ratio * math.sqrt(2.0 * modulus * math.sqrt(radius) * mass)
    stiffness = 4.0 / 3.0 * modulus * math.sqrt(radius)
    overlap = -(np.arange(_START_COUNT) + 0.5) / _START_COUNT * _CLOSING_SPEED * step
    speed, force = np.full(_START_COUNT, _CLOSING_SPEED), np.zeros(_START_COUNT)
    for _ in range(_MAX_STEPS):
        mid_step_speed = speed - 0.5 * step * force / mass
        overlap = overlap + step * mid_step_speed
        penetration = np.maximum(overlap, 0.0)
        force = stiffness * penetration**1.5 + damping * penetration**0.25 * mid_step_speed
        speed = mid_step_speed - 0.5 * step * force / mass
        if (overlap <= 0.0).all() and (speed < 0.0).all():
            break
    return -speed / _CLOSING_SPEED
