"""A shaker table with prescribed motion."""

from collections.abc import Callable, Iterable
from typing import Annotated, ClassVar, Literal

import numpy as np

from rig.core.base.arrays import ComplexArray
from rig.core.equations import Equations
from rig.core.scene.shaker.coil_spring import CoilSpringShaker
from rig.core.scene.shaker.kind import Glyph, ShakerEffect, servo_inverse
from rig.core.scene.shaker.parts import DRIVE_PER_VOLT, Body, CoilSpring, Output
from rig.core.settings.quantities import FREQUENCY, LENGTH
from rig.core.settings.quantity_field import Quantity


class TableShaker(CoilSpringShaker):
    """A table with prescribed displacement that drives body `body` through the coil spring."""

    kind: Literal["table"] = "table"
    body: Body
    """The driven body, by its number from 1 or its name."""
    spring: CoilSpring
    """Stiffness of the coil spring [N/m]."""
    bandwidth: Annotated[float, Quantity(FREQUENCY, above=0.0)] = 400.0
    """Corner frequency of the position servo [Hz], which acts as a critically damped low-pass filter of second order.
    The velocity of the table is then continuous, as required to measure its acceleration."""
    output: Output = Output()
    """The analog output whose voltage is the drive."""

    drive_quantity: ClassVar = LENGTH
    prescribed: ClassVar = True
    glyph: ClassVar = Glyph("shaker table", "box")

    @property
    def corner(self) -> float:
        """Corner frequency of the position servo [Hz]."""
        return self.bandwidth

    @property
    def newtons_per_drive(self) -> float:
        """Force of the coil spring per unit of drive while the body is at rest [N]."""
        return self.spring

    def add_to(self, equations: Equations, drive: str, table: str) -> None:
        """Add the spring and the table; the spring acts on the body, but not on the motion of the table."""
        row = equations.add_point(table, 0.0)
        equations.add_spring(self.body - 1, row, self.spring)
        equations.add_input(drive, self.drive_unit, {row: (2.0 * np.pi * self.corner) ** 2})
        equations.prescribe(row, self.corner)

    def required_drive(self, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the drive: the command of the servo. The force on the table has no effect."""
        return servo_inverse(self.corner, s), np.zeros_like(s)

    def effects(self, bodies: str, modes_at_rest: Callable[[], str]) -> Iterable[ShakerEffect]:
        """Yield spring and table; an impact test excites the modes at rest, because the spring remains attached."""
        modes = f"with this spring and the table at rest {modes_at_rest()}"
        detail = f"spring of {self.spring:.4g} N/m to {bodies}, {modes}; position servo of {self.bandwidth:.4g} Hz"
        yield ShakerEffect("coil spring and table", 2, detail)

    def output_text(self, suffix: str, bodies: str) -> str:
        """Describe the position of the table."""
        return f"table{suffix} position, {1e3 * DRIVE_PER_VOLT['m']:g} mm/V"
