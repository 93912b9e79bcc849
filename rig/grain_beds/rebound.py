"""The restitution to set in LAMMPS so that grains rebound with the desired restitution.

LAMMPS takes the speed of approach, for the dashpot of a contact, half a step before the force; with some fifty steps
in a contact a rebound then is slower, by 1 % for lead. The same scheme, followed here for one head-on contact, says by
how much, and so what to ask for.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq

from rig.arrays import Array
from rig.scene.damper import Grains

#: Speed of approach at which the restitution is met, m/s: impacts of a bed come at 0.05 to 1.
_SPEED = 0.3
#: Contacts begin anywhere in a step: number of positions that are averaged.
_PLACES = 16
_MOST_STEPS = 100_000


def restitution_at_step(grains: Grains, mass: float, radius: float, step: float) -> float:
    """Restitution to set.

    `mass`, `radius`: reduced mass [kg] and radius [m] of the contact: of a grain at a wall its own, of two grains
    half of that; `step`: step of time, s.

    >>> lead = Grains(diameter="2 mm", modulus="10 MPa")
    >>> round(restitution_at_step(lead, mass=4.75e-5, radius=1e-3, step=5.7e-6), 3)
    0.202
    """

    def missing(setting: float) -> float:
        return float(_rebounds(grains, setting, mass, radius, step).mean()) - grains.restitution

    most = 1.0 - 1e-9
    if missing(most) <= 0.0:
        return most
    return float(brentq(missing, 0.5 * grains.restitution, most, xtol=1e-7))


def _rebounds(grains: Grains, setting: float, mass: float, radius: float, step: float) -> Array:
    """Restitutions of contacts that begin at different positions in a step."""
    modulus = grains.modulus / (2.0 * (1.0 - grains.poisson_ratio**2))
    loss = -math.log(setting) / math.hypot(math.log(setting), math.pi)
    damping = 2.0 * math.sqrt(5.0 / 6.0) * loss * math.sqrt(2.0 * modulus * math.sqrt(radius) * mass)
    stiffness = 4.0 / 3.0 * modulus * math.sqrt(radius)
    overlap = -(np.arange(_PLACES) + 0.5) / _PLACES * _SPEED * step
    speed, force = np.full(_PLACES, _SPEED), np.zeros(_PLACES)
    for _ in range(_MOST_STEPS):
        half = speed - 0.5 * step * force / mass
        overlap = overlap + step * half
        pressed = np.maximum(overlap, 0.0)
        force = stiffness * pressed**1.5 + damping * pressed**0.25 * half
        speed = half - 0.5 * step * force / mass
        if (overlap <= 0.0).all() and (speed < 0.0).all():
            break
    return -speed / _SPEED
