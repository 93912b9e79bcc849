"""Quantity and SI scale of a unit, in the notations of measurement programs."""

import re
import unicodedata
from collections.abc import Mapping
from itertools import product
from typing import Any, TypeVar

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
Name = TypeVar("Name", bound=str)
# Names of units that are not in the table of units, in lower case.
_SPELLINGS = {
    "volts": "V", "volt": "V", "v": "V", "millivolts": "mV", "mv": "mV",
    "newtons": "N", "newton": "N", "n": "N", "kn": "kN", "pounds": "lbf", "lbf": "lbf", "lb": "lbf",
    "g's": "g", "gs": "g", "gn": "g", "g_n": "g", "gee": "g", "sec": "s", "second": "s",
    "meters": "m", "inches": "inch", "in": "inch", "ips": "(inch/s)",
}  # fmt: skip
# A number before a unit; the unit ``1/N`` contains no such number.
_VALUE = re.compile(r"((?!1\s*/)[+-]?\.?\d[\d.]*(?:e[+-]?\d+)?)?\s*(\S.*)", re.IGNORECASE)


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
    if found := quantity_of(unit, KINDS):
        return found
    if other := _OTHER_QUANTITIES.get(unit.strip().lower()):
        raise ValueError(f"{other} ({unit}) is not a quantity of this program. Omit this channel in the table.")
    raise ValueError(
        f"unknown unit {unit!r}; expected a unit of acceleration, velocity, displacement, force or voltage, such as "
        "m/s^2, g, mm, N or mV; for scaled numbers, the value that the number 1 represents, such as 5 V"
    )


def quantity_of(unit: str, kinds: Mapping[Name, Kind]) -> tuple[Name, float] | None:
    """Return the name of the kind of a unit, or of a value with a unit, and its size in SI; None for other kinds.

    >>> quantity_of("[in/s2]/[lbf]", {"accelerance": Kind("an accelerance", "m/s^2/N", "1 g/N")})
    ('accelerance', 0.0057101471547326465)
    """
    if (match := _VALUE.fullmatch(unit.strip())) is None:
        return None
    # Compatibility forms of Unicode: ``²`` is 2, and ``⁻¹`` is -1.
    text = unicodedata.normalize("NFKC", match[2]).replace("−", "-").translate(str.maketrans("[]", "()"))
    # A number after a name is its power, a hyphen between names a product, and so are two brackets.
    text = re.sub(r"(?<=[A-Za-z])\s*(?:\*\*|\^)?\s*(?:\((-?\d)\)|(-?\d))", r"^\1\2", text)
    text = re.sub(r"(?<=[\w)])-(?=[A-Za-z(])|(?<=\))\s*(?=\()", "*", re.sub(r"\s*/\s*1$", "", text))
    # Upper and lower case of a prefix differ: MV is not mV, GN is not gn. Other spellings are tried only for text that
    # is not a unit itself.
    spelled = re.sub(r"(?!Mv\b)[A-Za-z][A-Za-z_']*", lambda name: _SPELLINGS.get(name[0].lower(), name[0]), text)
    for notation, (name, kind) in product((text, spelled), kinds.items()):
        try:
            scale = parse(f"{match[1] or 1} {notation}", kind)
        except ValueError:
            continue
        if scale > 0 and kind.supports(scale):
            return name, scale
    return None
