"""A shaker table that carries the whole structure, for base excitation."""

from collections.abc import Callable, Iterable
from typing import Annotated, ClassVar, Literal

import numpy as np

from rig.core.base.arrays import ComplexArray
from rig.core.equations import Equations
from rig.core.scene.shaker.kind import Glyph, KindOfShaker, ShakerEffect
from rig.core.scene.shaker.parts import DRIVE_PER_VOLT, Output
from rig.core.settings.quantities import ACCELERATION, FREQUENCY
from rig.core.settings.quantity_field import Quantity


class BaseShaker(KindOfShaker):
    """A table with prescribed acceleration that carries the whole structure; springs to ground are attached to it."""

    kind: Literal["base"] = "base"
    centering: Annotated[float, Quantity(FREQUENCY, above=0.0)] = 0.5
    """Corner frequency of the servo that returns the table to its center [Hz], which acts as a critically damped high
    pass of second order. Far above this frequency, the acceleration of the table equals the drive."""
    output: Output = Output()
    """The analog output whose voltage is the drive."""

    drive_quantity: ClassVar = ACCELERATION
    level_keys: ClassVar = ("drive",)
    level_remark: ClassVar = "exerts no single force"
    prescribed: ClassVar = True
    carries_structure: ClassVar = True
    references: ClassVar = ("table",)
    glyph: ClassVar = Glyph("shaker table", "box")

    @property
    def newtons_per_drive(self) -> float:
        """Force per unit of drive on a structure of 1 kg [N]."""
        return 1.0

    def add_to(self, equations: Equations, drive: str, table: str) -> None:
        """Put the structure on the table, whose motion does not depend on the structure."""
        row = equations.add_point(table, 0.0)
        equations.move_ground(row)
        equations.add_input(drive, self.drive_unit, {row: 1.0})
        equations.prescribe(row, self.centering)

    def required_drive(self, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the acceleration, with compensation of the centering; it does not depend on the force on the table."""
        return np.asarray(np.square(s + 2.0 * np.pi * self.centering)), np.zeros_like(s)

    def effects(self, bodies: str, modes_at_rest: Callable[[], str]) -> Iterable[ShakerEffect]:
        """Yield the table; the modes belong to the structure on a table at rest."""
        yield ShakerEffect("base excitation", 2, f"of the whole structure; centering servo of {self.centering:.4g} Hz")

    def output_text(self, suffix: str, bodies: str) -> str:
        """Describe the acceleration of the table."""
        return f"table{suffix} acceleration, {DRIVE_PER_VOLT[self.drive_unit]:g} m/s² per V"

    def force_hint(self, table: str) -> str:
        """Name the table as the reference."""
        return f"a shaker of kind base exerts no single force. Measure the motion of the table instead (at: {table})."
