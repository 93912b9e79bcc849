"""Number, diameters, density and time step of the grains of a bed (the particles of one damper)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.core.base.errors import SceneError
from rig.core.scene.damper import Grains
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import structural_model

#: Default time step, relative to Rayleigh's time of the smallest grain. A step ten times as long is still stable; with
#: this step, the ratio of rebound speed to closing speed is within 1 % of the restitution.
STEP_RATIO = 0.03
#: Restitution below which the default time step is proportional to the restitution.
_REDUCED_STEP_RESTITUTION = 0.2
#: Restitution below which the default time step is constant again, because the rebound is negligible.
_MIN_STEP_RESTITUTION = 0.1
#: The time step is at most this multiple of Rayleigh's time: with a longer step a contact has too few steps.
MAX_STEP_RATIO = 0.2


@dataclass(frozen=True)
class Spheres:
    """The grains of one bed."""

    settings: Grains
    mass: float  # mass of the bed [kg]
    clearance: float  # from the settled bed to the upper wall [m]
    count: int  # number of grains
    seed: int  # seed of the random diameters and positions

    def diameters(self) -> NDArray[np.float64]:
        """Draw the diameters [m]; shape (count,)."""
        deviations = np.random.default_rng([self.seed, 0]).uniform(-1.0, 1.0, self.count)
        return np.asarray(self.settings.diameter * (1.0 + self.settings.spread * deviations))

    def density(self) -> float:
        """Return the density of the grains for which their total mass is the mass of the bed, kg/m^3."""
        return self.mass / (math.pi / 6.0 * float((self.diameters() ** 3).sum()))

    def longest_step(self) -> float:
        """Return the longest time step of the simulation [s]: the setting, or the default for this restitution."""
        if self.settings.time_step is not None:
            return self.settings.time_step
        reduction = min(1.0, max(self.settings.restitution, _MIN_STEP_RESTITUTION) / _REDUCED_STEP_RESTITUTION)
        return STEP_RATIO * reduction * rayleigh_time(self.settings, self.density())


def spheres_of(scene: Scene) -> dict[int, Spheres]:
    """Return the grains of each bed that can move; key: the damper's position in the scene, from 0.

    Raises `SceneError` if a bed is lighter than half a grain, or the requested time step is too long for its grains.
    """
    spheres_by_row = {}
    for row, (damper, mass) in enumerate(zip(scene.dampers, structural_model(scene).damper_mass, strict=True)):
        if damper.grains is None or not damper.moves:
            continue
        grain_mass = damper.grains.density * math.pi / 6.0 * damper.grains.diameter**3
        # The mean cube of uniformly distributed diameters is the cube of their mean times 1 + spread^2.
        count = round(float(mass) / (grain_mass * (1.0 + damper.grains.spread**2)))
        if count < 1:
            raise SceneError(
                f"scene {scene.name!r}: dampers[{row + 1}]: {mass:.3g} kg is less than the mass of one grain "
                f"({grain_mass:.3g} kg). Set a larger mass, or a smaller grains.diameter."
            )
        spheres = Spheres(damper.grains, float(mass), damper.clearance, count, scene.seed + row)
        longest = MAX_STEP_RATIO * rayleigh_time(damper.grains, spheres.density())
        if spheres.longest_step() > longest:
            raise SceneError(
                f"scene {scene.name!r}: dampers[{row + 1}].grains.time_step: got {spheres.longest_step():.3g} s; "
                f"expected at most {longest:.3g} s, {MAX_STEP_RATIO:g} times the Rayleigh time of the smallest grain"
            )
        spheres_by_row[row] = spheres
    return spheres_by_row


def rayleigh_time(grains: Grains, density: float) -> float:
    """Return the time in which a surface (Rayleigh) wave travels half the circumference of the smallest grain [s].

    >>> round(1e6 * rayleigh_time(Grains(diameter="2 mm", modulus="10 MPa"), 11340.0), 1)
    189.3
    """
    shear = grains.modulus / (2.0 * (1.0 + grains.poisson_ratio))
    radius = 0.5 * grains.diameter * (1.0 - grains.spread)
    # The denominator is the usual approximation of the ratio of the speeds of Rayleigh and shear waves.
    return math.pi * radius * math.sqrt(density / shear) / (0.1631 * grains.poisson_ratio + 0.8766)


def contact_time(grains: Grains) -> float:
    """Return the duration of a central collision of two equal grains at 1 m/s without loss [s].

    By Hertz it is 2.87 (m^2 / (R E^2 v))^(1/5), with reduced mass m, radius R and modulus E, and closing speed v.

    >>> round(1e3 * contact_time(Grains(diameter="2 mm", modulus="10 MPa")), 3)
    0.356
    """
    radius = 0.25 * grains.diameter
    mass = 0.5 * grains.density * math.pi / 6.0 * grains.diameter**3
    modulus = grains.modulus / (2.0 * (1.0 - grains.poisson_ratio**2))
    return float(2.87 * (mass**2 / (radius * modulus**2)) ** 0.2)
