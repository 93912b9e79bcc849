"""Settings of a damper: its mass or bed of particles, spring, contact with the walls (floor, ceiling), and grains."""

import math
from collections.abc import Iterable
from typing import Annotated, ClassVar, Self

from rig.core.scene.shaker import Body
from rig.core.settings.alternatives import Alternatives, by_key
from rig.core.settings.problems import Problem
from rig.core.settings.quantities import DASHPOT, DENSITY, LENGTH, MASS, MODULUS, RATIO, STIFFNESS, TIME
from rig.core.settings.quantity_field import Quantity, unexpected_value_message
from rig.core.settings.settings import Settings


class TimedContact(Settings):
    """Wall contact given by its duration; the restitution of the damper determines the rebound speed."""

    duration: Annotated[float, Quantity(TIME, above=0.0)]
    """Contact duration of an isolated impact [s]; without loss, half the natural period of bed and body on the
    contact stiffness."""


class SpringDamper(Settings):
    """Wall contact given by spring and dashpot, which also determine the restitution."""

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0.0)]
    """Contact stiffness: force per penetration depth [N/m]."""
    damping: Annotated[float, Quantity(DASHPOT, at_least=0.0)] = 0.0
    """Viscous damping coefficient of the contact [N s/m]."""


Wall = Annotated[TimedContact | SpringDamper, Alternatives(by_key)]


class Walls(Settings):
    """Different settings for floor and ceiling."""

    floor: Wall
    """The floor: duration, or stiffness and damping."""
    ceiling: Wall
    """The ceiling: duration, or stiffness and damping."""


Contact = Annotated[TimedContact | SpringDamper | Walls, Alternatives(by_key)]


def walls_of(contact: TimedContact | SpringDamper | Walls | None) -> tuple[TimedContact | SpringDamper, ...]:
    """Return the contact settings of floor and ceiling, one item if they are equal; empty for instantaneous contact."""
    if isinstance(contact, Walls):
        return contact.floor, contact.ceiling
    return () if contact is None else (contact,)


class Grains(Settings):
    """The bed as spheres in an upright cylinder (discrete element method); by default the bed moves as one mass.

    Normal contact is Hertzian with a dashpot. Tangential contact follows Mindlin up to Coulomb's limit, without
    rolling friction. The walls have the grains' material. Defaults are those of lead shot: density and Poisson's
    ratio from handbooks, restitution of lead balls from E. Hodgkinson (Report of the British Association, 1834).
    """

    diameter: Annotated[float, Quantity(LENGTH, above=0.0)]
    """Diameter of the spheres [m]."""
    spread: Annotated[float, Quantity(RATIO, at_least=0.0, below=0.5)] = 0.0
    """Half-width of the uniform distribution of diameters, relative to `diameter`; diameters are random (`seed`)."""
    density: Annotated[float, Quantity(DENSITY, above=0.0)] = 11340.0
    """Density [kg/m^3]; it is adjusted slightly so that the mass of the bed is that of a whole number of grains."""
    modulus: Annotated[float, Quantity(MODULUS, above=0.0)] = 1e8
    """Young's modulus [Pa]; the default is below the 16 GPa of lead, because stiff grains need short time steps."""
    poisson_ratio: Annotated[float, Quantity(RATIO, at_least=0.0, below=0.5)] = 0.44
    """Poisson's ratio."""
    restitution: Annotated[float, Quantity(RATIO, above=0.0, below=1.0)] = 0.2
    """Ratio of rebound speed to closing speed of two grains, or of a grain and a wall, head on."""
    friction: Annotated[float, Quantity(RATIO, at_least=0.0)] = 0.4
    """Coefficient of friction of grains and walls. The default is assumed; graphited shot has less."""
    side_friction: Annotated[float, Quantity(RATIO, at_least=0.0)] | None = None
    """Friction coefficient of the side wall; 0 for a narrow cavity that represents part of a wide cavity. None: as
    `friction`."""
    cavity: Annotated[float, Quantity(LENGTH, above=0.0)] = 40e-3
    """Diameter of the cavity [m]; 40 mm in the rig of Inoue, Yokomichi and Hiraki (2011)."""
    time_step: Annotated[float, Quantity(TIME, above=0.0)] | None = None
    """Largest time step [s]; by default 0.03 Rayleigh times of the smallest grain, less if restitution is below 0.2."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that a grain fits into the cavity."""
        if self.diameter * (1.0 + self.spread) > self.cavity:
            yield Problem(
                ("cavity",),
                unexpected_value_message(
                    f"{self.cavity:g} m",
                    f"at least the diameter of the largest grain, {self.diameter * (1.0 + self.spread):g} m",
                ),
            )


class Damper(Settings):
    """A particle damper (its bed rests on a floor or flies), a mass on a spring, or a mass that slides."""

    one_of: ClassVar = (("mass", "mass_ratio"),)
    required_unless: ClassVar = {"clearance": "spring"}
    body: Body
    """The body with the cavity, by its number from 1 or its name; a body may have several."""
    mass: Annotated[float, Quantity(MASS, above=0.0)] | None = None
    """Mass of the bed, or of a mass on a spring or with friction [kg]."""
    mass_ratio: Annotated[float, Quantity(RATIO, above=0.0)] | None = None
    """Instead of `mass`: ratio of this mass to the mass of the body."""
    clearance: Annotated[float, Quantity(LENGTH, at_least=0.0, infinite=True)] = math.inf
    """Free height of the cavity above the bed, or above the mass at rest on its spring [m]; infinite: no ceiling.
    Without `spring` it is required, and 0 means that the bed cannot move."""
    clearance_below: Annotated[float, Quantity(LENGTH, at_least=0.0, infinite=True)] | None = None
    """Distance of a mass at rest on its spring from the floor [m]; infinite: no floor, None: as `clearance`."""
    spring: Annotated[float, Quantity(STIFFNESS, above=0.0)] | None = None
    """Stiffness of the spring [N/m] on which the mass rests: an impact damper or, without walls, a tuned mass damper.
    Its displacement is measured from its position at rest."""
    damping: Annotated[float, Quantity(DASHPOT, at_least=0.0)] | None = None
    """Viscous damping coefficient of the dashpot parallel to the spring [N s/m]; None: no dashpot."""
    friction: Annotated[float, Quantity(RATIO, at_least=0.0)] | None = None
    """Coefficient of friction of a horizontal damper, 0 without friction. The mass then slides in the direction of
    vibration, and its weight acts perpendicular to the motion. It starts in the middle between two walls; `clearance`
    is its free distance, infinite without walls. None: the mass moves vertically.
    """
    restitution: Annotated[float, Quantity(RATIO, at_least=0.0, below=1.0)] = 0.0
    """Ratio of rebound speed to closing speed in an impact, from 0 (perfectly plastic) to below 1."""
    contact: Contact | None = None
    """Finite-duration contact with floor and ceiling; by default contact is instantaneous."""
    grains: Grains | None = None
    """The bed as spheres (requires the optional dependency `grains`); by default the bed is one mass."""
    locked: bool = False
    """Whether the mass is glued to its body."""

    @property
    def dashpot(self) -> float:
        """Return the damping of the dashpot [N s/m]; 0 without a dashpot."""
        return self.damping or 0.0

    @property
    def moves(self) -> bool:
        """Return whether the mass can move in its body: it is not locked and has clearance."""
        return not self.locked and max(self.clearance, self.clearance_below or 0.0) > 0.0

    @property
    def below(self) -> float:
        """Return the distance of a mass on a spring from its floor [m]."""
        return self.clearance if self.clearance_below is None else self.clearance_below

    @property
    def distances(self) -> tuple[float, float]:
        """Return the distances of the mass at rest from its floor and from its ceiling [m]."""
        if self.friction is not None:
            return 0.5 * self.clearance, 0.5 * self.clearance
        return 0.0 if self.spring is None else self.below, self.clearance

    @property
    def falls_freely(self) -> bool:
        """Return whether the mass is a bed, on which only its weight acts between contacts."""
        return self.spring is None and self.friction is None

    @property
    def has_walls(self) -> bool:
        """Return whether there is a wall: the floor of a bed, or a wall above or below another mass."""
        return self.falls_freely or min(self.clearance, self.below) < math.inf

    @property
    def impacts(self) -> bool:
        """Return whether the mass can hit a wall, or slides with friction; otherwise the damper is linear."""
        return self.moves and (self.has_walls or self.friction is not None)

    @property
    def impacts_instantaneously(self) -> bool:
        """Return whether an impact changes velocities in zero time, so the acceleration is infinite."""
        return self.moves and self.has_walls and self.contact is None and self.grains is None

    @property
    def action(self) -> tuple[str, str]:
        """Return what the mass does at a high level, and what it does at a low level."""
        if self.friction:
            return "slips", "sticks"
        return ("flies", "stays on its floor") if self.falls_freely else ("hits a wall", "hits no wall")

    @property
    def walls_text(self) -> str:
        """Return the distances of the walls from a mass on its spring, such as "1 mm below and 2 mm above"."""
        distances = {"below": self.below, "above": self.clearance}
        finite = [f"{1e3 * value:.4g} mm {side}" for side, value in distances.items() if math.isfinite(value)]
        return f"walls {' and '.join(finite)}" if finite else "no walls"

    def without_walls(self) -> Self:
        """Return the mass on its spring without walls, for the linear motion before the mass reaches a wall."""
        return self.replace(clearance=math.inf, clearance_below=None, restitution=0.0, contact=None)

    def check_consistency(self) -> Iterable[Problem]:
        """Check that no key contradicts the kind of damper, and that the restitution is given once."""
        slides = self.friction is not None
        other = "" if slides else ", or add spring"
        if self.spring is None and self.damping:
            yield Problem(("damping",), f"damping requires a mass on a spring. Remove damping{other}.")
        if self.spring is None and self.clearance_below is not None:
            reason = "a sliding mass starts in the middle between its walls" if slides else "a bed rests on its floor"
            yield Problem(("clearance_below",), f"{reason}. Remove clearance_below{other}.")
        for key in ("restitution", "contact") if not self.has_walls else ():
            if getattr(self, key):
                yield Problem((key,), f"the mass has no walls. Add a clearance, or remove {key}.")
        if self.spring is not None and self.grains is not None:
            yield Problem(("grains",), "a bed of grains cannot be on a spring. Remove grains, or remove the spring.")
        for key in ("spring", "contact", "grains") if slides else ():
            if getattr(self, key) is not None:
                message = f"{key} and friction are given together, but a damper with friction slides horizontally and "
                yield Problem((key,), f"{message}has no {key}. Remove {key}, or remove friction.")
        if self.grains is not None and self.restitution:
            yield Problem(("restitution",), "restitution and grains are given together. Move restitution into grains.")
        if self.grains is not None and self.contact is not None:
            message = "contact and grains are given together, but grains have a contact law. Remove contact or grains."
            yield Problem(("contact",), message)
        has_duration = any(isinstance(wall, TimedContact) for wall in walls_of(self.contact))
        if self.restitution and self.contact is not None and not has_duration:
            yield Problem(
                ("restitution",),
                "stiffness and damping of the contact determine the restitution. Remove restitution, or give the "
                "contact by its duration.",
            )
