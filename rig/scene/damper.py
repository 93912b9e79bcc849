"""A particle damper: the bed of shot in one cavity."""

from __future__ import annotations

from typing import Annotated, ClassVar

from rig.scene.quantities import (
    LENGTH,
    MASS,
    RATIO,
)
from rig.scene.quantity_field import Quantity
from rig.scene.settings import Settings
from rig.scene.shaker import Body


class Damper(Settings):
    """A particle damper: the bed as one mass that rides on, leaves and hits floor and ceiling of a cavity."""

    one_of: ClassVar = (("mass", "mass_ratio"),)
    body: Body
    """The body with the cavity, by its number from 1."""
    mass: Annotated[float, Quantity(MASS, above=0.0)] | None = None
    """Mass of the bed [kg]."""
    mass_ratio: Annotated[float, Quantity(RATIO, above=0.0)] | None = None
    """In place of `mass`: that as a share of the mass of its body."""
    clearance: Annotated[float, Quantity(LENGTH, at_least=0.0, infinite=True)]
    """Free height of the cavity above the bed [m]; infinite: no ceiling, 0: held."""
    restitution: Annotated[float, Quantity(RATIO, at_least=0.0, below=1.0)] = 0.0
    """Ratio of separation to approach speed in an impact, from 0 (perfectly plastic) to below 1."""
    locked: bool = False
    """Whether the bed is glued to the floor."""
