"""Common part of the shakers whose table drives a body through a coil spring."""

from typing import TYPE_CHECKING, Any, ClassVar

from rig.core.base.arrays import Array
from rig.core.scene.shaker.kind import KindOfShaker


class CoilSpringShaker(KindOfShaker):
    """A shaker whose table drives body `body` through the spring `spring`; the subclasses define the keys."""

    points: ClassVar = ("table", "shaker", "drive")

    if TYPE_CHECKING:
        body: Any
        spring: Any

    @property
    def bodies(self) -> tuple[int, ...]:
        """The driven body, from 1."""
        return (self.body,)

    @property
    def coil_spring(self) -> float:
        """Stiffness of the coil spring [N/m]."""
        return self.spring

    def force_terms(self, drive: str, table: str) -> dict[str, float]:
        """Return the two ends of the spring, F = k0 (x0 - x1)."""
        return {table: self.spring, f"body {self.body}": -self.spring}

    def force_row(self, states: int, table: int | None) -> Array:
        """Return the row of the spring force."""
        row = super().force_row(states, table)
        row[table], row[self.body - 1] = self.spring, -self.spring
        return row
