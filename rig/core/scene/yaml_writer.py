"""Writing of a scene as a scene file that loads as an equal scene: in the user's notation, or in SI."""

from collections.abc import Mapping
from typing import Any

import yaml

from rig.core.scene.body_names import GROUND
from rig.core.scene.matrices import Matrices
from rig.core.scene.measurement_chain import Channel
from rig.core.scene.structure import Structure
from rig.core.settings.problems import KeyPath
from rig.core.settings.quantities import Kind, shortest_notation, si_text
from rig.core.settings.quantity_field import Quantity
from rig.core.settings.settings import Settings, quantity_at


def write(settings: Settings, structure: Structure | None = None) -> str:
    """Write the given values in the units in which they were given, with the structure's names of bodies.

    A computed quantity is written in the unit of the value that it replaces, or else in the unit with the fewest
    digits. Every written value loads as the identical double.
    """
    return _dump(_given_values(settings, structure, {}))


def write_in_si(settings: Settings) -> str:
    """Write every value (defaults too) in SI, as the shortest decimal that loads as the identical double.

    Equal scenes have equal text, regardless of the user's notation; recordings and the identity of stored results
    require this.
    """
    return _dump(_si_values(settings))


def _dump(content: Any) -> str:
    return yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100_000, default_flow_style=None
    )


# The C implementation, if available, writes large matrices ten times as fast.
_BASE: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class _QuotedString(str):
    """Free text, quoted so that no reader converts it to another type."""


class _PlainScalar(str):
    """A quantity, written without quotes even if it is only a number."""


class _Dumper(_BASE):
    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    _QuotedString, lambda dumper, value: dumper.represent_scalar("tag:yaml.org,2002:str", str(value), style='"')
)
_Dumper.add_representer(
    _PlainScalar,
    lambda dumper, value: dumper.represent_scalar(
        dumper.resolve(yaml.ScalarNode, str(value), (True, False)), str(value)
    ),
)
# Quantities are written without quotes, as users write them.
_Dumper.add_representer(str, lambda dumper, value: dumper.represent_scalar("tag:yaml.org,2002:str", value))


def _given_values(settings: Settings, structure: Structure | None, kinds: Mapping[KeyPath, Kind]) -> dict[str, Any]:
    """Return the explicitly set values by key; `kinds`: kinds of the quantities whose kind depends on another key."""
    values = {name: getattr(settings, name) for name in type(settings).model_fields}
    kinds = {**kinds, **type(settings).kinds_from_other_keys(values)}
    result: dict[str, Any] = {}
    for name, field in type(settings).model_fields.items():
        value, quantity = values[name], quantity_at(field)
        if value is None or value == () or (name not in settings.model_fields_set and name != "kind"):
            continue
        inner_kinds = {path[1:]: kind for path, kind in kinds.items() if path[0] == name and path[1:]}
        if quantity is not None:
            kind = kinds.get((name,), quantity.kinds[0])
            content: Any = _format(value, kind, settings.written.get(name))
        elif isinstance(settings, Matrices):
            content = [list(row) for row in value]
        elif name in ("body", "between") or (name == "at" and isinstance(settings, Channel)):
            content = _body_name(value, structure)
        elif isinstance(value, tuple):
            content = [_given_values(item, structure, {}) if isinstance(item, Settings) else item for item in value]
        else:
            content = _given_values(value, structure, inner_kinds) if isinstance(value, Settings) else value
        result[field.alias or name] = content
    if isinstance(settings, Structure) and settings.masses is not None and settings.names is not None:
        result["masses"] = dict(zip(result.pop("names"), result["masses"], strict=True))
    return result


def _format(value: Any, kind: Kind, previous: Any) -> Any:
    if isinstance(value, tuple):
        notations = (
            previous if isinstance(previous, list | tuple) and len(previous) == len(value) else (None,) * len(value)
        )
        return [_format(number, kind, notation) for number, notation in zip(value, notations, strict=True)]
    return _PlainScalar(shortest_notation(value, kind, previous if isinstance(previous, str) else None))


def _body_name(body: Any, structure: Structure | None) -> Any:
    if structure is None or structure.names is None:
        return list(body) if isinstance(body, tuple) else body
    if isinstance(body, tuple):
        return [item if item == GROUND else structure.label(item) for item in body]
    return structure.label(body)


def _si_values(settings: Settings) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if value is None or value == ():
            continue
        quantity = quantity_at(field)
        if isinstance(settings, Matrices):
            content: Any = [list(row) for row in value]
        elif name == "name":
            content = _QuotedString(value)
        else:
            content = _si_value(value, quantity)
        result[field.alias or name] = content
    return result


def _si_value(value: Any, quantity: Quantity | None) -> Any:
    if isinstance(value, Settings):
        return _si_values(value)
    if isinstance(value, tuple):
        return [_si_value(item, quantity) for item in value]
    if isinstance(value, float) and quantity is not None:
        # If another key determines the kind of the quantity, a number without a unit is in SI.
        return si_text(value, quantity.kinds[0]) if len(quantity.kinds) == 1 and quantity.kinds[0].si else value
    return value
