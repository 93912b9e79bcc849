"""Parts of the settings of shakers: driven bodies, output, coil, armature and amplifier."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler, WithJsonSchema
from pydantic_core import CoreSchema, core_schema

from rig.core.data_sheets.data_sheets import Preset, check_preset
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.quantities import (
    CURRENT,
    DASHPOT,
    FORCE,
    FORCE_FACTOR,
    INDUCTANCE,
    LENGTH,
    MASS,
    RATIO,
    RESISTANCE,
    STIFFNESS,
    TRANSCONDUCTANCE,
    VELOCITY,
    VOLTAGE,
    Kind,
)
from rig.core.settings.quantity_field import Quantity, unexpected_value_error
from rig.core.settings.settings import Settings

# The schema also allows names of bodies, which `Scene` replaces by their numbers.
_BODY_SCHEMA: dict[str, Any] = {"anyOf": [{"type": "integer", "minimum": 1}, {"type": "string"}]}
Body = Annotated[int, Field(ge=1), WithJsonSchema(_BODY_SCHEMA)]
CoilSpring = Annotated[float, Quantity(STIFFNESS, above=0.0)]

#: Drive per volt of the output upstream of a shaker, by the unit of the drive: a volt at the amplifier, a newton, a
#: millimeter of table displacement, or 10 m/s² of table acceleration.
DRIVE_PER_VOLT = {"V": 1.0, "N": 1.0, "m": 1e-3, "m/s^2": 10.0}


def at_shaker(name: str, number: int, shakers: int) -> str:
    """Name an input or a location at a shaker, with the shaker's number if there are several.

    >>> at_shaker("table", 1, shakers=1), at_shaker("table", 2, shakers=3)
    ('table', 'table 2')
    """
    return name if shakers == 1 else f"{name} {number}"


class Output(Settings):
    """The output that generates a shaker's drive; ideal by default."""

    preset: Preset | None = None
    """Name of a module whose data sheet supplies the values not given here."""
    range: Annotated[float, Quantity(VOLTAGE, above=0.0)] | None = None
    """Largest output voltage [V]."""
    bits: Annotated[int, Field(ge=2, le=32)] | None = None
    """Number of bits of the output converter, such as 16; its steps divide -`range` to +`range`. Needs `range`."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the product `preset` is known, and that a resolution has a range."""
        yield from check_preset(self.preset, "output")
        if self.bits is not None and self.range is None and self.preset is None:
            yield Problem(("bits",), "given without range. Add range, the largest voltage, such as 10 V.")


class BodyOrBodies:
    """One body or a list of bodies, counted from 1."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        list_schema = {"type": "array", "items": _BODY_SCHEMA, "minItems": 1, "uniqueItems": True}
        return {"anyOf": [*_BODY_SCHEMA["anyOf"], list_schema]}

    def _read(self, value: Any) -> int | tuple[int, ...]:
        is_list = isinstance(value, list | tuple)
        try:
            bodies = tuple(int(item) if isinstance(item, str) else item for item in (value if is_list else [value]))
        except ValueError:
            bodies = ()
        if not bodies or any(type(body) is not int or body < 1 for body in bodies):
            raise unexpected_value_error(value, "the number of a body, from 1, or a list of numbers")
        if len(set(bodies)) != len(bodies):
            raise unexpected_value_error(value, "a list that names each body once")
        return bodies if is_list else bodies[0]


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
    """Mass of the armature with the table [kg]."""
    stiffness: Annotated[float, Quantity(STIFFNESS, at_least=0.0)] = 8000.0
    """Stiffness of the suspension [N/m]."""
    damping: Annotated[float, Quantity(DASHPOT, at_least=0.0)] = 8.0
    """Damping of the suspension [N s/m]."""


class ShakerLimits(Settings):
    """Limits from the data sheet of a shaker. They do not change the motion; predictions are compared with them."""

    current: Annotated[float, Quantity(CURRENT, above=0.0)] | None = None
    """Largest current of the coil [A], peak."""
    force: Annotated[float, Quantity(FORCE, above=0.0)] | None = None
    """Largest force of the coil [N], peak."""
    travel: Annotated[float, Quantity(LENGTH, above=0.0)] | None = None
    """Largest displacement of the table from rest [m]; half of the travel from peak to peak."""
    velocity: Annotated[float, Quantity(VELOCITY, above=0.0)] | None = None
    """Largest velocity of the table [m/s], peak."""


class Amplifier(Settings):
    """Power amplifier: a voltage or a current source."""

    mode: Literal["voltage", "current"] = "voltage"
    """Whether the drive sets the voltage at the coil or the current through it."""
    gain: Annotated[float, Quantity(RATIO, TRANSCONDUCTANCE, above=0.0)] = 1.0
    """Output per volt of drive [V/V, or A/V in current mode]."""
    limit: Annotated[float, Quantity(VOLTAGE, CURRENT, above=0.0, infinite=True)] = float("inf")
    """Largest output [V or A]; infinite: no clipping."""

    @classmethod
    def kinds_from_other_keys(cls, content: Mapping[str, Any]) -> Mapping[KeyPath, Kind]:
        """Return the unit of the output, V or A, according to the mode."""
        if content.get("mode") == "current":
            return {("gain",): TRANSCONDUCTANCE, ("limit",): CURRENT}
        return {("gain",): RATIO, ("limit",): VOLTAGE}
