"""The structure: a chain of bodies on springs, or matrices, and its damping."""

import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field

from rig.core.scene.body_names import check_names
from rig.core.scene.matrices import MAX_BODIES, Matrices
from rig.core.settings.alternatives import Alternatives, by_key
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.quantities import DASHPOT, MASS, RATE, RATIO, STIFFNESS, TIME
from rig.core.settings.quantity_field import Quantity
from rig.core.settings.settings import Settings


class ModalDamping(Settings):
    """A damping ratio for each natural mode of the structure without dampers and coil spring."""

    modal: Annotated[float | tuple[float, ...], Quantity(RATIO, at_least=0.0, listed=True)]
    """One damping ratio for all modes, or a list with one for each (0.005 = 0.5 %); 1 is critical damping."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that no mode is damped more than critically."""
        ratios = self.modal if isinstance(self.modal, tuple) else (self.modal,)
        for k, ratio in enumerate(ratios):
            if ratio > 1.0:
                key_path = ("modal", k) if isinstance(self.modal, tuple) else ("modal",)
                yield Problem(
                    key_path,
                    f"got {ratio:g}, which is {100 * ratio:g} % of critical; expected at most 100 %, such as {ratio:g} "
                    "%. For more damping, use dashpots or a damping matrix.",
                )


class Rayleigh(Settings):
    """Coefficients of the damping matrix C = alpha M + beta K."""

    alpha: Annotated[float, Quantity(RATE, at_least=0.0)] = 0.0
    """Coefficient of the mass matrix [1/s]."""
    beta: Annotated[float, Quantity(TIME, at_least=0.0)] = 0.0
    """Coefficient of the stiffness matrix [s]."""


class RayleighDamping(Settings):
    """Rayleigh damping, proportional to mass and stiffness."""

    rayleigh: Rayleigh
    """Rayleigh damping: alpha times the mass matrix plus beta times the stiffness matrix."""


class Dashpots(Settings):
    """A dashpot parallel to each spring of the chain."""

    dashpots: tuple[Annotated[float, Quantity(DASHPOT, at_least=0.0)], ...]
    """Damping coefficient for each spring [N s/m]."""


Damping = Annotated[ModalDamping | RayleighDamping | Dashpots, Alternatives(by_key)]


def _or_by_name(schema: dict[str, Any]) -> None:
    """Allow a mapping from names to values in addition to a list."""
    schema["anyOf"].append({"type": "object", "additionalProperties": schema["anyOf"][0]["items"], "minProperties": 1})


class Structure(Settings):
    """The structure: a chain of bodies on springs, or any linear structure given by matrices."""

    one_of: ClassVar = (("masses", "matrices"),)
    masses: tuple[Annotated[float, Quantity(MASS, above=0.0)], ...] | None = Field(
        None, min_length=1, max_length=MAX_BODIES, json_schema_extra=_or_by_name
    )
    """Masses of the bodies [kg], body 1 first; or by names of the bodies, such as {base: 4.2 kg, arm: 1.1 kg}."""
    springs: tuple[Annotated[float, Quantity(STIFFNESS, at_least=0.0)], ...] | None = Field(None, min_length=1)
    """Stiffness of spring j between body j and body j-1, ground for j = 1 [N/m]. 0: not connected."""
    damping: Damping | None = None
    """Damping of the structure, in one of three forms. None: zero damping."""
    matrices: Matrices | None = None
    """Matrices instead of masses and springs."""
    names: tuple[str, ...] | None = Field(None, min_length=1, max_length=MAX_BODIES)
    """Names of the bodies of `matrices`, body 1 first, which can replace body numbers. None: numbers only."""

    @classmethod
    def prepare(cls, content: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[Problem]]:
        """Split masses with names into masses and names."""
        masses = content.get("masses")
        if not isinstance(masses, Mapping):
            return content, []
        has_names = content.get("names") is not None
        problems = [
            Problem(("names",), "names are given together with masses that have names. Remove names.")
        ] * has_names
        return {**content, "masses": list(masses.values()), "names": list(map(str, masses))}, problems

    @classmethod
    def key_path_as_given(cls, key_path: KeyPath, content: Mapping[str, Any]) -> KeyPath:
        """Return the key path as written in the scene file: with a body's name if the masses are given by names."""
        masses = content.get("masses")
        if not isinstance(masses, Mapping) or key_path[:1] not in (("masses",), ("names",)) or content.get("names"):
            return key_path
        return ("masses", *(list(masses)[key] if isinstance(key, int) else key for key in key_path[1:]))

    def label(self, location: str | int) -> str:
        """Return the display name of a body, its own name if it has one, from its number or a channel's location.

        >>> Structure(masses={"base": 4.2, "arm": 1.1}, springs=[1e3, 1e3]).label("body 2")
        'arm'
        """
        location = f"body {location}" if isinstance(location, int) else location
        if self.names is None or not location.startswith("body "):
            return location
        number = int(location.removeprefix("body "))
        return self.names[number - 1] if 1 <= number <= len(self.names) else location

    def listed(self, numbers: Iterable[int]) -> str:
        """Return the display names of several bodies: `base, arm`, or `body 1, 2`."""
        if self.names is None:
            return f"body {', '.join(map(str, numbers))}"
        return ", ".join(self.label(number) for number in numbers)

    def relabel(self, text: str) -> str:
        """Replace body numbers in a message with the names of the bodies."""
        return text if self.names is None else re.sub(r"\bbody \d+\b", lambda match: self.label(match[0]), text)

    @property
    def labels(self) -> tuple[str, ...]:
        """Display names of the bodies: their names, or body 1, body 2, ..."""
        return tuple(self.label(number) for number in range(1, self.bodies + 1))

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        if self.masses is not None:
            return len(self.masses)
        return len(self.matrices.mass) if self.matrices is not None else 0

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the lists have one value for each body, and that no quantity is given twice."""
        n_bodies = self.bodies
        for k, message in check_names(self.names, n_bodies) if self.names is not None else ():
            yield Problem(("names",) if k is None else ("names", k), message)
        if self.masses is not None and self.springs is None:
            yield Problem((), f"springs missing; expected {n_bodies}, one for each mass")
        if self.masses is not None and self.springs is not None and len(self.springs) != n_bodies:
            yield Problem(("springs",), f"got {len(self.springs)} springs; expected {n_bodies}, one for each mass")
        if self.matrices is not None:
            if self.springs is not None:
                yield Problem(("springs",), "springs and matrices are given together. Remove springs or matrices.")
            if self.damping is not None and self.matrices.damping is not None:
                yield Problem(("damping",), "damping is given together with matrices.damping. Remove one of the two.")
            if isinstance(self.damping, Dashpots):
                yield Problem(
                    ("damping",),
                    "dashpots are for a chain of masses. With matrices, give matrices: {damping: ...} instead.",
                )
        damping_values = (
            ("modal", "mode", self.damping.modal if isinstance(self.damping, ModalDamping) else 0.0),
            ("dashpots", "spring", self.damping.dashpots if isinstance(self.damping, Dashpots) else 0.0),
        )
        for key, item, values in damping_values:
            if isinstance(values, tuple) and len(values) != n_bodies:
                yield Problem(("damping", key), f"got {len(values)} values; expected {n_bodies}, one for each {item}")
