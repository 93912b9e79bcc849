"""Base class of all kinds of shaker: the properties that other modules use, with the values that most kinds share.

The class of a kind defines the properties of this kind. Other modules use the properties, and do not depend on the
kind.
"""

from collections.abc import Callable, Iterable
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from rig.core.base.arrays import Array, ComplexArray
from rig.core.equations import Equations
from rig.core.settings.problems import KeyPath
from rig.core.settings.quantities import Kind
from rig.core.settings.settings import Settings


class Glyph(NamedTuple):
    """Symbol of a shaker in drawings of the rig."""

    title: str
    shape: Literal["arrow", "box", "cylinder"]


class AmplifierOutput(NamedTuple):
    """Output of a power amplifier."""

    unit: str
    gain: float  # output per unit of drive
    limit: float  # largest output


class Load(NamedTuple):
    """A quantity that loads a shaker, with its limit in the data sheet.

    The quantity is a sum with the factors `weights`: displacement, velocity and acceleration of the shaker's table, and
    displacement of the driven body.
    """

    place: str  # part of the shaker
    name: str
    unit: str
    weights: tuple[float, float, float, float]
    limit: float  # infinite without a limit


class ShakerEffect(NamedTuple):
    """A physical effect of a shaker, for `rig explain`."""

    name: str
    states: int
    detail: str


class KindOfShaker(Settings):
    """A kind of shaker. Subclasses are the sections `shaker` of a scene; this class has no keys.

    `drive_quantity`: quantity of the drive. `level_keys`: permitted keys of a test's level; `level_remark`: reason why
    others are not permitted. `points`: locations at the shaker where a channel can measure. `prescribed`: whether the
    table has a prescribed motion. `carries_structure`: whether the table is the ground of the structure.
    `drive_is_force`: whether the drive is the force on the structure. `references`: denominators of responses, the
    default first. `glyph`: drawing.
    """

    drive_quantity: ClassVar[Kind]
    level_keys: ClassVar[tuple[str, ...]] = ("force", "drive")
    level_remark: ClassVar[str] = ""
    points: ClassVar[tuple[str, ...]] = ("table", "drive")
    prescribed: ClassVar[bool] = False
    carries_structure: ClassVar[bool] = False
    drive_is_force: ClassVar[bool] = False
    references: ClassVar[tuple[str, ...]] = ("force", "table")
    glyph: ClassVar[Glyph]

    @property
    def name_of_kind(self) -> str:
        """Value of the key `kind`."""
        return str(type(self).model_fields["kind"].default)

    @property
    def drive_unit(self) -> str:
        """Unit of the drive."""
        return self.drive_quantity.si

    @property
    def bodies(self) -> tuple[int, ...]:
        """The bodies on which the shaker acts, from 1."""
        return ()

    @property
    def body_keys(self) -> tuple[KeyPath, ...]:
        """Key path of each of `bodies`."""
        is_list = isinstance(getattr(self, "body", None), tuple)
        return tuple(("body", k) if is_list else ("body",) for k in range(len(self.bodies)))

    @property
    def first_body(self) -> int:
        """The first body on which the shaker acts, from 1; body 1 if the table carries the structure."""
        return self.bodies[0] if self.bodies else 1

    @property
    def coil_spring(self) -> float | None:
        """Stiffness of the spring between the table and the driven body [N/m]; None without a spring."""
        return None

    @property
    def corner(self) -> float:
        """Corner frequency of the servo of the table [Hz]; 0 without a servo."""
        return 0.0

    @property
    def power_amplifier(self) -> AmplifierOutput | None:
        """The power amplifier of the shaker, or None."""
        return None

    @property
    def drive_limit(self) -> float:
        """Largest drive within the range of the amplifier."""
        amplifier = self.power_amplifier
        return np.inf if amplifier is None else amplifier.limit / amplifier.gain

    @property
    def loads(self) -> tuple[Load, ...]:
        """The loads that a prediction compares with their limits."""
        return (Load("table", "travel", "m", (1.0, 0.0, 0.0, 0.0), np.inf),) if "table" in self.points else ()

    @property
    def newtons_per_drive(self) -> float:
        """Rough static force on the structure per unit of drive [N]."""
        raise NotImplementedError

    def add_to(self, equations: Equations, drive: str, table: str) -> None:
        """Add the shaker to the equations of motion; `drive`, `table`: names of its input and of its table."""
        raise NotImplementedError

    def force_terms(self, drive: str, table: str) -> dict[str, float]:
        """Return the locations of the channels from which the force on the structure follows, and their weights.

        `drive`, `table`: locations of the force and of the table. The weight is 1 for a force, otherwise N per m of
        displacement.
        """
        return {}

    def force_row(self, states: int, table: int | None) -> Array:
        """Return the row vector that gives the force on the structure [N] from the state; `table`: row of the table."""
        # The row is zero if the force does not depend on the state.
        return np.zeros(states)

    def required_drive(self, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the drive that the table requires per meter of its motion, and per newton on it; `s` = iω.

        Without a prescribed motion, the drive is known except for a constant gain.
        """
        raise NotImplementedError

    def effects(self, bodies: str, modes_at_rest: Callable[[], str]) -> Iterable[ShakerEffect]:
        """Yield the effects; `bodies`: names of the bodies; `modes_at_rest`: modes with the table at rest, as text."""
        raise NotImplementedError

    def output_text(self, suffix: str, bodies: str) -> str:
        """Describe the driven quantity, and its value per volt; `suffix`: " 2" for the second of several shakers."""
        raise NotImplementedError

    def force_hint(self, table: str) -> str:
        """Return why no channel measures the force, and what to measure instead; `table`: location of the table."""
        raise NotImplementedError


def servo_inverse(corner: float, s: complex | ComplexArray) -> ComplexArray:
    """Return the command of a position servo per displacement; `corner`: corner frequency [Hz]."""
    return np.asarray(np.square(1.0 + s / (2.0 * np.pi * corner)), dtype=np.complex128)
