"""A particle damper: the bed of shot in one cavity, contact with its walls that lasts, and its single grains."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, ClassVar

from rig.scene.quantities import DASHPOT, DENSITY, LENGTH, MASS, MODULUS, RATIO, STIFFNESS, TIME
from rig.scene.quantity_field import Quantity, expected
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


def walls_of(contact: Landing | SpringDamper | Walls | None) -> tuple[Landing | SpringDamper, ...]:
    """Give what floor and ceiling are, once where they are alike; nothing where contact is instant."""
    if isinstance(contact, Walls):
        return contact.floor, contact.ceiling
    return () if contact is None else (contact,)


class Grains(Settings):
    """The bed as spheres in an upright cylinder, by the discrete element method; without this it moves as one mass.

    Contact is Hertz's with a dashpot, Mindlin's along the surface up to Coulomb's limit, with no friction of rolling;
    the walls are of the same stuff as the grains. What is not given is that of lead shot: density and Poisson's ratio
    from handbooks, the restitution of lead balls from E. Hodgkinson (Report of the British Association, 1834).
    """

    diameter: Annotated[float, Quantity(LENGTH, above=0.0)]
    """Diameter of the spheres [m]."""
    spread: Annotated[float, Quantity(RATIO, at_least=0.0, below=0.5)] = 0.0
    """Diameters lie evenly between this share below and above `diameter`, drawn with the scene's seed."""
    density: Annotated[float, Quantity(DENSITY, above=0.0)] = 11340.0
    """Density [kg/m^3]; it is changed by what makes the bed a whole number of grains."""
    modulus: Annotated[float, Quantity(MODULUS, above=0.0)] = 1e8
    """Young's modulus [Pa], below that of lead, 16 GPa: steps of time are shorter the stiffer the grains are."""
    poisson_ratio: Annotated[float, Quantity(RATIO, at_least=0.0, below=0.5)] = 0.44
    """Poisson's ratio."""
    restitution: Annotated[float, Quantity(RATIO, above=0.0, below=1.0)] = 0.2
    """Ratio of separation to approach speed of two grains, or of a grain and a wall, head on."""
    friction: Annotated[float, Quantity(RATIO, at_least=0.0)] = 0.4
    """Coulomb's coefficient, of grains and walls; assumed: clean lead has more, graphited shot less."""
    side_friction: Annotated[float, Quantity(RATIO, at_least=0.0)] | None = None
    """That of the cavity's side, if it is another; 0 makes a narrow cavity stand for a piece of a wide one."""
    cavity: Annotated[float, Quantity(LENGTH, above=0.0)] = 40e-3
    """Diameter of the cavity [m]; 40 mm in the paper's rig."""
    time_step: Annotated[float, Quantity(TIME, above=0.0)] | None = None
    """Longest step of time [s]; by default 0.03 of the smallest grain's Rayleigh time, less below restitution 0.2."""

    def relations(self) -> Iterable[Mistake]:
        """Check that a grain has room."""
        if self.diameter * (1.0 + self.spread) > self.cavity:
            yield Mistake(
                ("cavity",), expected(f"{self.cavity:g} m", "at least the largest grain's diameter")
            )


class Damper(Settings):
    """A particle damper: the bed as one mass that rides on, leaves and hits floor and ceiling of a cavity."""

    one_of: ClassVar = (("mass", "mass_ratio"),)
    body: Body
    """The body with the cavity, by its number from 1 or its name; a body may have several."""
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
    grains: Grains | None = None
    """The bed as spheres (extra `grains`); without it the bed is one mass."""
    locked: bool = False
    """Whether the bed is glued to the floor."""

    @property
    def moves(self) -> bool:
        """Whether the bed can move in its cavity: it is not locked, and has clearance."""
        return not self.locked and self.clearance > 0.0

    def relations(self) -> Iterable[Mistake]:
        """Check that the restitution is said once, and that a bed is one mass or grains."""
        if self.grains is not None and self.restitution:
            yield Mistake(("restitution",), "given beside grains; expected it among grains, for each of them")
        if self.grains is not None and self.contact is not None:
            yield Mistake(
                ("contact",), "given beside grains, whose own contact lasts; expected one of the two"
            )
        lands = any(isinstance(wall, Landing) for wall in walls_of(self.contact))
        if self.restitution and self.contact is not None and not lands:
            yield Mistake(
                ("restitution",),
                "given beside the stiffness and damping of the contact, in which it lies; expected contact: duration",
            )
