"""A voice coil with a current amplifier: a kind of shaker that exists only in the test suite."""

from collections.abc import Callable, Iterable
from typing import Annotated, ClassVar, Literal

import numpy as np

from rig.core.base.arrays import ComplexArray
from rig.core.equations import Equations
from rig.core.scene.shaker.coil_spring import CoilSpringShaker
from rig.core.scene.shaker.kind import Glyph, ShakerEffect
from rig.core.scene.shaker.parts import Body, CoilSpring, Output
from rig.core.settings.quantities import MASS, VOLTAGE
from rig.core.settings.quantity_field import Quantity


class VoiceCoil(CoilSpringShaker):
    """A force of 1 N/V on a free head that drives body `body` through the coil spring."""

    kind: Literal["voice_coil"] = "voice_coil"
    body: Body
    """The driven body, by its number from 1 or its name."""
    spring: CoilSpring
    """Stiffness of the coil spring [N/m]."""
    head: Annotated[float, Quantity(MASS, above=0.0)] = 0.1
    """Mass of the head [kg]."""
    limit: Annotated[float, Quantity(VOLTAGE, above=0.0, infinite=True)] = float("inf")
    """Largest drive [V]."""
    output: Output = Output()

    drive_quantity: ClassVar = VOLTAGE
    glyph: ClassVar = Glyph("voice coil", "cylinder")

    @property
    def drive_limit(self) -> float:
        """Largest drive, V."""
        return self.limit

    @property
    def newtons_per_drive(self) -> float:
        """One newton per volt."""
        return 1.0

    def add_to(self, equations: Equations, drive: str, table: str) -> None:
        """Add the head, its spring and the force on it."""
        row = equations.add_point(table, self.head)
        equations.add_spring(self.body - 1, row, self.spring)
        equations.support(row, 1000.0, 5.0)
        equations.add_input(drive, self.drive_unit, {row: 1.0}, self.drive_limit)

    def required_drive(self, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the force."""
        return self.head * s**2 + 5.0 * s + 1000.0, np.ones_like(s)

    def effects(self, bodies: str, modes_at_rest: Callable[[], str]) -> Iterable[ShakerEffect]:
        """Yield the head."""
        yield ShakerEffect("voice coil", 2, f"head of {self.head:.4g} kg on {bodies}")

    def output_text(self, suffix: str, bodies: str) -> str:
        """Describe the force."""
        return f"force on the head{suffix}, 1 N/V"
