"""A shaker table with prescribed motion."""

from __future__ import annotations

from typing import Annotated, Literal

from rig.scene.shaker.parts import Body, CoilSpring, Output
from rig.settings.quantities import FREQUENCY
from rig.settings.quantity_field import Quantity
from rig.settings.settings import Settings


class TableShaker(Settings):
    """A table with prescribed displacement that drives body `body` through the coil spring."""

    kind: Literal["table"] = "table"
    body: Body
    """The driven body, by its number from 1 or its name."""
    spring: CoilSpring
    """Stiffness of the coil spring [N/m]."""
    bandwidth: Annotated[float, Quantity(FREQUENCY, above=0.0)] = 400.0
    """Corner frequency of the position servo [Hz], a critically damped second-order system. The table velocity is
    continuous, as required to measure its acceleration."""
    output: Output = Output()
    """The analog output whose voltage is the drive."""

    @property
    def bodies(self) -> tuple[int, ...]:
        """The driven body, from 1."""
        return (self.body,)
