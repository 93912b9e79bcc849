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
    """A particle damper: the bed as one mass that rides on, leaves and hits floor and ceiling of a cavity.

    Attributes
    ----------
    body : int
        The body with the cavity, from 1.
    mass : float, optional
        Mass of the bed [kg]; or else
    mass_ratio : float, optional
        as a share of the mass of its body.
    clearance : float
        Free height of the cavity above the bed [m]; infinite: no ceiling, 0: held.
    restitution : float
        Ratio of separation to approach speed in an impact, from 0 (perfectly plastic) to below 1.
    locked : bool
        Whether the bed is glued to the floor.
    """

    one_of: ClassVar = (("mass", "mass_ratio"),)
    body: Body
    mass: Annotated[float, Quantity(MASS, above=0.0)] | None = None
    mass_ratio: Annotated[float, Quantity(RATIO, above=0.0)] | None = None
    clearance: Annotated[float, Quantity(LENGTH, at_least=0.0, infinite=True)]
    restitution: Annotated[float, Quantity(RATIO, at_least=0.0, below=1.0)] = 0.0
    locked: bool = False
