"""Contact that lasts: floor and ceiling of a damper's cavity as spring-dampers that push and never pull."""

from __future__ import annotations

from typing import Annotated

from rig.scene.quantities import DASHPOT, STIFFNESS, TIME
from rig.scene.quantity_field import Quantity
from rig.scene.settings import Alternatives, Settings, by_key


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
