"""Settings of the shaker: what drives the structure, and through what."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from rig.scene.quantities import (
    CURRENT,
    DASHPOT,
    FORCE_FACTOR,
    FREQUENCY,
    INDUCTANCE,
    MASS,
    RATIO,
    RESISTANCE,
    STIFFNESS,
    TRANSCONDUCTANCE,
    VOLTAGE,
    Kind,
)
from rig.scene.quantity_field import Quantity, refusal
from rig.scene.settings import Alternatives, Place, Settings, by_kind

Body = Annotated[int, Field(ge=1)]
CoilSpring = Annotated[float, Quantity(STIFFNESS, above=0.0)]


class _BodyOrBodies:
    """One body or a list of bodies, counted from 1."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        one = {"type": "integer", "minimum": 1}
        return {"anyOf": [one, {"type": "array", "items": one, "minItems": 1, "uniqueItems": True}]}

    def _read(self, value: Any) -> int | tuple[int, ...]:
        listed = isinstance(value, list | tuple)
        try:
            bodies = tuple(
                int(item) if isinstance(item, str) else item for item in (value if listed else [value])
            )
        except ValueError:
            bodies = ()
        if not bodies or any(type(body) is not int or body < 1 for body in bodies):
            raise refusal(value, "the number of a body, from 1, or a list of such")
        if len(set(bodies)) != len(bodies):
            raise refusal(value, "a list that names each body once")
        return bodies if listed else bodies[0]


class ForceShaker(Settings):
    """A force that acts on one body, or the same force on several, with nothing attached to them."""

    kind: Literal["force"] = "force"
    body: Annotated[int | tuple[int, ...], _BodyOrBodies()]
    """The number of a body, from 1, or a list of such."""

    @property
    def bodies(self) -> tuple[int, ...]:
        """The driven bodies, from 1."""
        return self.body if isinstance(self.body, tuple) else (self.body,)

    @property
    def spring(self) -> None:
        """There is no coil spring."""


class TableShaker(Settings):
    """A table whose displacement is prescribed, pulling body `body` through the coil spring."""

    kind: Literal["table"] = "table"
    body: Body
    """The body it pulls, by its number from 1."""
    spring: CoilSpring
    """Stiffness of the coil spring [N/m]."""
    bandwidth: Annotated[float, Quantity(FREQUENCY, above=0.0)] = 400.0
    """Corner of the position servo [Hz], a critically damped second order: the table follows the drive with a
    continuous velocity, as its acceleration is measured."""

    @property
    def bodies(self) -> tuple[int, ...]:
        """The driven body, from 1."""
        return (self.body,)


class Coil(Settings):
    """Moving coil."""

    resistance: Annotated[float, Quantity(RESISTANCE, above=0.0)] = 2.0
    """Resistance [ohm]."""
    inductance: Annotated[float, Quantity(INDUCTANCE, above=0.0)] = 0.2e-3
    """Inductance [H]."""
    force_factor: Annotated[float, Quantity(FORCE_FACTOR, above=0.0)] = 10.0
    """Force factor [N/A = V s/m]."""


class Armature(Settings):
    """Moving armature on its suspension."""

    mass: Annotated[float, Quantity(MASS, above=0.0)] = 0.25
    """Mass, the table included [kg]."""
    stiffness: Annotated[float, Quantity(STIFFNESS, at_least=0.0)] = 8000.0
    """Stiffness of the suspension [N/m]."""
    damping: Annotated[float, Quantity(DASHPOT, at_least=0.0)] = 8.0
    """Damping of the suspension [N s/m]."""


class Amplifier(Settings):
    """Power amplifier: a voltage or a current source."""

    mode: Literal["voltage", "current"] = "voltage"
    gain: Annotated[float, Quantity(RATIO, TRANSCONDUCTANCE, above=0.0)] = 1.0
    """Output per volt of drive [V/V, or A/V in current mode]."""
    limit: Annotated[float, Quantity(VOLTAGE, CURRENT, above=0.0, infinite=True)] = float("inf")
    """Largest output [V or A]; infinite: no clipping."""

    @classmethod
    def kind_by_neighbours(cls, given: Mapping[str, Any]) -> Mapping[Place, Kind]:
        """Volts or amperes, as the mode says."""
        if given.get("mode") == "current":
            return {("gain",): TRANSCONDUCTANCE, ("limit",): CURRENT}
        return {("gain",): RATIO, ("limit",): VOLTAGE}


class ElectrodynamicShaker(Settings):
    """A moving-coil shaker that pulls body `body` through the coil spring and feels what it pulls."""

    kind: Literal["electrodynamic"] = "electrodynamic"
    body: Body
    """The body it pulls, by its number from 1."""
    spring: CoilSpring
    """Stiffness of the coil spring between the table and the body [N/m]."""
    coil: Coil = Coil()
    armature: Armature = Armature()
    amplifier: Amplifier = Amplifier()

    @property
    def bodies(self) -> tuple[int, ...]:
        """The driven body, from 1."""
        return (self.body,)


Shaker = Annotated[ForceShaker | TableShaker | ElectrodynamicShaker, Alternatives(by_kind)]
