"""A scene written as a scene file that loads back as an equal scene."""

from __future__ import annotations

from typing import Any

import yaml

from rig.scene.matrices import Matrices
from rig.scene.quantities import text
from rig.scene.quantity_field import Quantity, quantity_of
from rig.scene.settings import Settings


def write(settings: Settings) -> str:
    """Write every value that is set, in SI, as the shortest decimal that gives back the very same double."""
    return yaml.dump(
        _plain(settings),
        Dumper=_Dumper,
        sort_keys=False,
        allow_unicode=True,
        width=100_000,
        default_flow_style=None,
    )


# In C where PyYAML was built with it: a large structure's matrices take ten times as long otherwise.
_BASE: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class _Text(str):
    """Free text, quoted so that no reader can take it for anything else."""


class _Dumper(_BASE):
    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    _Text, lambda dumper, value: dumper.represent_scalar("tag:yaml.org,2002:str", str(value), style='"')
)
# A quantity stands as it is, without quotes, as a person would write it.
_Dumper.add_representer(str, lambda dumper, value: dumper.represent_scalar("tag:yaml.org,2002:str", value))


def _plain(settings: Settings) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if value is None or value == ():
            continue
        quantity = next(
            filter(None, (quantity_of(part) for part in (*field.metadata, field.annotation))), None
        )
        if isinstance(settings, Matrices):
            written: Any = [list(row) for row in value]
        elif name == "name":
            written = _Text(value)
        else:
            written = _value(value, quantity)
        result[field.alias or name] = written
    return result


def _value(value: Any, quantity: Quantity | None) -> Any:
    if isinstance(value, Settings):
        return _plain(value)
    if isinstance(value, tuple):
        return [_value(item, quantity) for item in value]
    if isinstance(value, float) and quantity is not None:
        # With several kinds the neighbours decide; a bare number is SI of whichever it is.
        return text(value, quantity.kinds[0]) if len(quantity.kinds) == 1 and quantity.kinds[0].si else value
    return value
