"""Numbers with a unit as fields of settings."""

from typing import Any, get_args

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from rig.core.base.escaping import is_single_line
from rig.core.settings.quantities import Kind, alternatives, describe_kinds, expected_quantity, parse


class Quantity:
    """Annotation `Annotated[float, Quantity(...)]`: a number with a unit, within bounds in SI.

    Of several `kinds`, another key determines which one applies (`Settings.kinds_from_other_keys`). `infinite`:
    whether `.inf` is allowed; `listed`: whether a list of numbers is allowed.
    """

    def __init__(
        self,
        *kinds: Kind,
        above: float | None = None,
        at_least: float | None = None,
        below: float | None = None,
        infinite: bool = False,
        listed: bool = False,
    ) -> None:
        self.kinds = kinds
        self.above, self.at_least, self.below = above, at_least, below
        self.infinite, self.listed = infinite, listed
        self.description = describe_kinds(kinds)
        sides = (("above", above), ("at least", at_least), ("below", below))
        limits = [f"{side} {limit:g}" for side, limit in sides if limit is not None]
        # Limits on both sides exclude infinity.
        limits += ["finite"] * (not infinite and (below is None or len(limits) == 1))
        self.bounded_description = f"{self.description}, {' and '.join(limits)}".rstrip(", ")
        units = alternatives([kind.si for kind in kinds if kind.si])
        self.help_text = (
            f"{self.bounded_description}; a bare number is in {units}" if units else self.bounded_description
        )

    def read(self, value: Any) -> float | tuple[float, ...]:
        """Read and check a value; raise `PydanticCustomError` with the expected value if it is invalid."""
        if self.listed and isinstance(value, list | tuple):
            if not value:
                raise unexpected_value_error(value, f"at least one: {self.description}")
            return tuple(self._read_number(item) for item in value)
        listed = in_brackets(value) if self.listed else None
        if listed is not None:
            expected = expected_quantity(value, self.kinds)
            raise unexpected_value_error(value, f"{expected}, or a list in brackets: {shorten(listed)}")
        return self._read_number(value)

    def _read_number(self, value: Any) -> float:
        for kind in self.kinds:
            try:
                number = parse(value, kind)
            except ValueError:
                continue
            if not kind.supports(number):
                raise unexpected_value_error(value, f"{kind.noun} {kind.range}")
            if self._is_within_bounds(number):
                # Convert minus zero to zero: both are equal, but have different notations.
                return number + 0.0
            raise unexpected_value_error(value, self.bounded_description)
        raise unexpected_value_error(value, expected_quantity(value, self.kinds))

    def _is_within_bounds(self, number: float) -> bool:
        return (
            (self.infinite or abs(number) != float("inf"))
            and (self.above is None or number > self.above)
            and (self.at_least is None or number >= self.at_least)
            and (self.below is None or number < self.below)
        )

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        limits = {"exclusiveMinimum": self.above, "minimum": self.at_least, "exclusiveMaximum": self.below}
        number: dict[str, Any] = {"type": "number"}
        number |= {key: limit for key, limit in limits.items() if limit is not None}
        alternatives = [number, {"type": "string"}]
        list_schema = [{"type": "array", "items": {"anyOf": alternatives}, "minItems": 1}] if self.listed else []
        return {"description": self.bounded_description, "anyOf": [*alternatives, *list_schema]}


def quantity_of(annotation: Any) -> Quantity | None:
    """Return the `Quantity` in a field's type, or None."""
    if isinstance(annotation, Quantity):
        return annotation
    for part in (*getattr(annotation, "__metadata__", ()), *get_args(annotation)):
        quantity = quantity_of(part)
        if quantity is not None:
            return quantity
    return None


def in_brackets(value: Any) -> str | None:
    """Write text with commas as a list in brackets; return None for other values.

    >>> in_brackets("10N,20N"), in_brackets("10 N")
    ('[10N, 20N]', None)
    """
    items = [item.strip() for item in value.split(",")] if isinstance(value, str) else []
    return f"[{', '.join(items)}]" if len(items) > 1 else None


def format_value(value: Any) -> str:
    """Return a value as given in a scene for a message, shortened if long."""
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        value = "keys " + ", ".join(map(str, value)) if value else "no keys"
    elif isinstance(value, str):
        value = f'"{value}"'
    return shorten(value)


def shorten(value: Any) -> str:
    """Return a value for a message, shortened if long."""
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def unexpected_value_message(value: Any, expected: str) -> str:
    """Return the message for an unexpected value.

    >>> unexpected_value_message("0.98 kg", "a length such as 0.98 mm")
    'got "0.98 kg"; expected a length such as 0.98 mm'
    """
    return f"got {format_value(value)}; expected {expected}"


def validation_error(message: str, absent: str = "") -> PydanticCustomError:
    """Return a pydantic error with a message, and with the absent key that caused the problem."""
    return PydanticCustomError("problem", "{message}", {"message": message, "absent": absent})


def printable(text: str) -> str:
    """Reject text with control characters or invisible characters."""
    if not is_single_line(text):
        raise unexpected_value_error(ascii(text)[1:-1], "one line of text without control characters")
    return text


def unexpected_value_error(value: Any, expected: str) -> PydanticCustomError:
    """Return the pydantic error for a value that is not as expected."""
    return validation_error(unexpected_value_message(value, expected))
