"""Quantity and SI scale of a unit, in the notations of measurement programs."""

import re
from collections.abc import Mapping
from itertools import product
from typing import Any

from daq.core.signal_chain.channel import Quantity
from daq.extras.importing.clock import warn
from rig.core.settings.quantities import ACCELERATION, FORCE, LENGTH, VELOCITY, VOLTAGE, Kind, parse

KINDS: dict[Quantity, Kind] = {
    "acceleration": ACCELERATION,
    "velocity": VELOCITY,
    "displacement": LENGTH,
    "force": FORCE,
    "voltage": VOLTAGE,
}
# Quantities that other sensors measure, by their units.
_OTHER_QUANTITIES = {
    "pa": "sound pressure", "mpa": "sound pressure", "µm/m": "strain", "um/m": "strain", "mm/m": "strain",
    "°c": "temperature", "degc": "temperature", "rpm": "speed of rotation", "a": "current", "ma": "current",
}  # fmt: skip
# Names of settings that state the value of one count of a converter.
_SCALE_NAMES = re.compile(r"(.*[._@])?((scal(e|ing)|cal(ibration)?)(_?factor)?|gain|factor|lsb|slope)", re.IGNORECASE)
#: Remedy for integers that are counts of a converter.
GIVE_VALUE_OF_COUNT = "Give the value of one count as the unit, such as unit: 0.0005 g, in the channel table."
_SPELLINGS = {
    "volts": "V", "volt": "V", "v": "V", "millivolts": "mV", "mv": "mV",
    "newtons": "N", "newton": "N", "n": "N", "kn": "kN",
    "pounds": "4.4482216152605 N", "lbf": "4.4482216152605 N", "lb": "4.4482216152605 N",
    "g's": "g", "gs": "g", "gn": "g", "g_n": "g", "gee": "g",
    "meters/s^2": "m/s^2", "m/s/s": "m/s^2", "meters": "m", "inches": "inch", "in": "inch",
    "meters/s": "m/s", "inches/s": "inch/s", "in/s": "inch/s", "in/s^2": "inch/s^2",
}  # fmt: skip


def warn_of_scale(where: str, settings: Mapping[str, Any]) -> None:
    """Warn about each setting that states a scale factor: the integers at `where` are not multiplied by it."""
    for name, value in settings.items():
        if _SCALE_NAMES.fullmatch(name) and value not in (1, 1.0):
            scale = f"{name.replace('@', '.')} = {value}"
            warn(f"{where} contains integers. They are not multiplied by {scale} of the file. {GIVE_VALUE_OF_COUNT}")


def quantity_and_scale(unit: str) -> tuple[Quantity, float]:
    """Return the quantity of a unit, or of a value with a unit, and its size in SI; raise `ValueError` if unknown.

    >>> quantity_and_scale("g"), quantity_and_scale("m/s2"), quantity_and_scale("2.5 mm")
    (('acceleration', 9.80665), ('acceleration', 1.0), ('displacement', 0.0025))
    """
    normalized = re.sub(r"\bsec(ond)?\b", "s", unit.strip(), flags=re.IGNORECASE)
    normalized = re.sub(r"(?<=[a-z])\s*(?:\*\*|\^)?\s*\(?[2²]\)?$", "^2", normalized)
    # Upper and lower case of a prefix differ: MV is not mV, GN is not gn. Other spellings are tried only for text that
    # is not a unit itself.
    spelling = "" if normalized == "Mv" else _SPELLINGS.get(normalized.lower(), "")
    for unit_name, (quantity, kind) in product((normalized, spelling), KINDS.items()):
        quantity_text = unit_name if re.match(r"[+-]?\.?\d", unit_name) else f"1 {unit_name}"
        try:
            scale = parse(quantity_text, kind)
        except ValueError:
            continue
        if scale > 0 and unit_name and kind.supports(scale) and not re.fullmatch(r"[\d.eE+-]*", unit_name):
            return quantity, scale
    if other := _OTHER_QUANTITIES.get(normalized.lower()):
        raise ValueError(f"{other} ({unit}) is not a quantity of this program. Omit this channel in the table.")
    raise ValueError(
        f"unknown unit {unit!r}; expected a unit of acceleration, velocity, displacement, force or voltage, such as "
        "m/s^2, g, mm, N or mV; for scaled numbers, the value that the number 1 represents, such as 5 V"
    )
