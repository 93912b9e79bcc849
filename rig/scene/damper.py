"""A particle damper: the bed of shot in one cavity, and contact with floor and ceiling that lasts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, ClassVar

from rig.scene.quantities import DASHPOT, LENGTH, MASS, RATIO, STIFFNESS, TIME
from rig.scene.quantity_field import Quantity
from rig.scene.settings import Alternatives, Mistake, Settings, by_key
from rig.scene.shaker import Body


class Landing(Settings):
    """A wall on which a landing lasts a given time; the damper's restitution says how much speed it gives back."""

    duration: Annotated[float, Quantity(TIME, above=0.0)]
    """From touch to release of a landing under no other force [s]; without loss, half a period of damper and body."""


class SpringDamper(Settings):
    """A wall given by its spring and dashpot, in which the restitution lies as well."""

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0.0)]
    """Force per overlap [N/m]."""
    damping: Annotated[float, Quantity(DASHPOT, at_least=0.0)] = 0.0
    """Force per speed of approach [N s/m]."""


Wall = Annotated[Landing | SpringDamper, Alternatives(by_key)]


class Walls(Settings):
    """Floor and ceiling that differ."""

    floor: Wall
    """The floor: duration, or stiffness and damping."""
    ceiling: Wall
    """The ceiling: duration, or stiffness and damping."""


Contact = Annotated[Landing | SpringDamper | Walls, Alternatives(by_key)]


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
    contact: Contact | None = None
    """Floor and ceiling on which a landing lasts; without it a landing is instant."""
    locked: bool = False
    """Whether the bed is glued to the floor."""

    def relations(self) -> Iterable[Mistake]:
        """Check that the restitution is said once."""
        walls = (
            (self.contact.floor, self.contact.ceiling) if isinstance(self.contact, Walls) else (self.contact,)
        )
        if self.restitution and self.contact is not None and not any(isinstance(w, Landing) for w in walls):
            yield Mistake(
                ("restitution",),
                "given beside the stiffness and damping of the contact, in which it lies; expected contact: duration",
            )
