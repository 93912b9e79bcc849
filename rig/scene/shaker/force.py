"""A force on the structure, without a shaker that adds mass or stiffness."""

from __future__ import annotations

from typing import Annotated, Literal

from rig.scene.shaker.parts import BodyOrBodies, Output
from rig.settings.settings import Settings


class ForceShaker(Settings):
    """A force that acts on one body, or the same force on several, with nothing attached to them."""

    kind: Literal["force"] = "force"
    body: Annotated[int | tuple[int, ...], BodyOrBodies()]
    """The number of a body, from 1, or its name; or a list of bodies."""
    output: Output = Output()
    """The analog output whose voltage is the drive."""

    @property
    def bodies(self) -> tuple[int, ...]:
        """The driven bodies, from 1."""
        return self.body if isinstance(self.body, tuple) else (self.body,)

    @property
    def spring(self) -> None:
        """There is no coil spring."""
