"""A force on the structure, without a shaker that adds mass or stiffness."""

from collections.abc import Callable, Iterable
from typing import Annotated, ClassVar, Literal

from rig.core.equations import Equations
from rig.core.scene.shaker.kind import Glyph, KindOfShaker, ShakerEffect
from rig.core.scene.shaker.parts import DRIVE_PER_VOLT, BodyOrBodies, Output
from rig.core.settings.quantities import FORCE


class ForceShaker(KindOfShaker):
    """A force that acts on one body, or the same force on several, with nothing attached to them."""

    kind: Literal["force"] = "force"
    body: Annotated[int | tuple[int, ...], BodyOrBodies()]
    """The number of a body, from 1, or its name; or a list of bodies."""
    output: Output = Output()
    """The analog output whose voltage is the drive."""

    drive_quantity: ClassVar = FORCE
    level_keys: ClassVar = ("force",)
    level_remark: ClassVar = "is driven by its force"
    points: ClassVar = ("shaker", "drive")
    drive_is_force: ClassVar = True
    references: ClassVar = ("force",)
    glyph: ClassVar = Glyph("force", "arrow")

    @property
    def bodies(self) -> tuple[int, ...]:
        """The driven bodies, from 1."""
        return self.body if isinstance(self.body, tuple) else (self.body,)

    @property
    def newtons_per_drive(self) -> float:
        """Force per unit of drive: 1, because the drive is the force."""
        return 1.0

    def add_to(self, equations: Equations, drive: str, table: str) -> None:
        """Add an input that is the force on each body."""
        equations.add_input(drive, self.drive_unit, {body - 1: 1.0 for body in self.bodies})

    def force_terms(self, drive: str, table: str) -> dict[str, float]:
        """Return the location of a force sensor."""
        return {drive: 1.0}

    def effects(self, bodies: str, modes_at_rest: Callable[[], str]) -> Iterable[ShakerEffect]:
        """Yield the effect of the shaker: a force, without stiffness or mass."""
        yield ShakerEffect("force", 0, f"on {bodies}, nothing attached")

    def output_text(self, suffix: str, bodies: str) -> str:
        """Describe the bodies on which the force acts, and the force per volt."""
        return f"force on {bodies}, {DRIVE_PER_VOLT['N']:g} N/V"
