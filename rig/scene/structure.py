"""The structure: a chain of bodies on springs, or matrices, and its damping."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, ClassVar

from pydantic import Field

from rig.scene.matrices import MOST_BODIES, Matrices
from rig.scene.quantities import (
    DASHPOT,
    MASS,
    RATE,
    RATIO,
    STIFFNESS,
    TIME,
)
from rig.scene.quantity_field import Quantity
from rig.scene.settings import Alternatives, Mistake, Settings, by_key


class ModalDamping(Settings):
    """A damping ratio for each natural mode of the structure without dampers and coil spring."""

    modal: Annotated[float | tuple[float, ...], Quantity(RATIO, at_least=0.0, listed=True)]
    """One ratio for all modes, or one for each (0.005 = 0.5 %); 1 is critical."""

    def relations(self) -> Iterable[Mistake]:
        """Check that the structure can oscillate."""
        ratios = self.modal if isinstance(self.modal, tuple) else (self.modal,)
        for k, ratio in enumerate(ratios):
            if ratio > 1.0:
                place = ("modal", k) if isinstance(self.modal, tuple) else ("modal",)
                yield Mistake(
                    place,
                    f"got {ratio:g}, which is {100 * ratio:g} % of critical; expected at most 100 %, such as {ratio:g} "
                    "% (heavier damping: dashpots, or a damping matrix)",
                )


class Rayleigh(Settings):
    """C = alpha M + beta K."""

    alpha: Annotated[float, Quantity(RATE, at_least=0.0)] = 0.0
    """Share of the mass matrix [1/s]."""
    beta: Annotated[float, Quantity(TIME, at_least=0.0)] = 0.0
    """Share of the stiffness matrix [s]."""


class RayleighDamping(Settings):
    """Damping in proportion to mass and stiffness."""

    rayleigh: Rayleigh
    """Keys alpha and beta."""


class Dashpots(Settings):
    """A dashpot beside each spring of the chain."""

    dashpots: tuple[Annotated[float, Quantity(DASHPOT, at_least=0.0)], ...]
    """One for each spring [N s/m]."""


Damping = Annotated[ModalDamping | RayleighDamping | Dashpots, Alternatives(by_key)]


class Structure(Settings):
    """The structure: a chain of bodies on springs, or any linear one given by matrices."""

    one_of: ClassVar = (("masses", "matrices"),)
    masses: tuple[Annotated[float, Quantity(MASS, above=0.0)], ...] | None = Field(
        None, min_length=1, max_length=MOST_BODIES
    )
    """Masses of the bodies [kg], body 1 first."""
    springs: tuple[Annotated[float, Quantity(STIFFNESS, at_least=0.0)], ...] | None = Field(
        None, min_length=1
    )
    """Stiffness of spring j between body j and body j-1, ground for j = 1 [N/m]. 0: not connected."""
    damping: Damping | None = None
    """Damping of the structure, in one of three forms. None: undamped."""
    matrices: Matrices | None = None
    """In place of masses and springs."""

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        if self.masses is not None:
            return len(self.masses)
        return len(self.matrices.mass) if self.matrices is not None else 0

    def relations(self) -> Iterable[Mistake]:
        """Check that the parts are of one structure."""
        count = self.bodies
        if self.masses is not None and self.springs is None:
            yield Mistake((), f"springs missing; expected {count}, one for each mass")
        if self.masses is not None and self.springs is not None and len(self.springs) != count:
            yield Mistake(
                ("springs",), f"got {len(self.springs)} springs; expected {count}, one for each mass"
            )
        if self.matrices is not None:
            if self.springs is not None:
                yield Mistake(("springs",), "given beside matrices, which hold the stiffness")
            if self.damping is not None and self.matrices.damping is not None:
                yield Mistake(("damping",), "given beside the damping matrix; expected one of them")
            if isinstance(self.damping, Dashpots):
                yield Mistake(
                    ("damping",), "dashpots lie along a chain; with matrices give matrices: {damping: ...}"
                )
        listed = {
            "modal": self.damping.modal if isinstance(self.damping, ModalDamping) else 0.0,
            "dashpots": self.damping.dashpots if isinstance(self.damping, Dashpots) else 0.0,
        }
        for key, values in listed.items():
            if isinstance(values, tuple) and len(values) != count:
                yield Mistake(
                    ("damping", key), f"got {len(values)} values; expected {count}, as there are bodies"
                )
