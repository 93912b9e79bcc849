"""Units as measurement programs spell them."""

from __future__ import annotations

import re

from daq.signal_chain.channel import Quantity
from rig.scene.quantities import ACCELERATION, FORCE, LENGTH, VELOCITY, VOLTAGE, Kind, parse

KINDS: dict[Quantity, Kind] = {
    "acceleration": ACCELERATION,
    "velocity": VELOCITY,
    "displacement": LENGTH,
    "force": FORCE,
    "voltage": VOLTAGE,
}
_SPELLED = {
    "volts": "V", "volt": "V", "v": "V", "millivolts": "mV", "mv": "mV",
    "newtons": "N", "newton": "N", "n": "N", "kn": "kN",
    "pounds": "4.4482216152605 N", "lbf": "4.4482216152605 N", "lb": "4.4482216152605 N",
    "g's": "g", "gs": "g", "gn": "g", "g_n": "g", "gee": "g",
    "meters/second^2": "m/s^2", "m/s/s": "m/s^2", "meters": "m", "inches": "inch", "in": "inch",
    "meters/second": "m/s", "inches/second": "inch/s", "in/s": "inch/s", "in/s^2": "inch/s^2",
}  # fmt: skip


def meaning(unit: str) -> tuple[Quantity, float]:
    """Return the quantity and the SI size of a unit, or of a number of units; raise `ValueError` for other quantities.

    >>> meaning("g"), meaning("m/s2"), meaning("Volts"), meaning("2.5 mm")
    (('acceleration', 9.80665), ('acceleration', 1.0), ('voltage', 1.0), ('displacement', 0.0025))
    """
    normalized = re.sub(r"\bsec\b|\bsecond\b", "s", unit.strip())
    normalized = re.sub(r"(?<=[a-z])\s*(?:\*\*|\^)?\s*\(?2\)?$", "^2", normalized)
    unit_name = _SPELLED.get(normalized.lower(), normalized)
    written = unit_name if re.match(r"[+-]?\.?\d", unit_name) else f"1 {unit_name}"
    for quantity, kind in KINDS.items():
        try:
            size = parse(written, kind)
        except ValueError:
            continue
        if size > 0 and unit_name and kind.supports(size) and not re.fullmatch(r"[\d.eE+-]*", unit_name):
            return quantity, size
    raise ValueError(
        f"unknown unit {unit!r}; expected a unit of acceleration, velocity, displacement, force or voltage, such as "
        "m/s^2, g, mm, N, mV, or the meaning of 1 in the file, such as 5 V"
    )
