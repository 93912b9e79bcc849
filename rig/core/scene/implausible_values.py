"""Warnings for quantities that are valid but implausible: the unit was probably forgotten, or has the wrong prefix."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import inf, pi, sqrt
from typing import Any

from rig.core.scene.scene import Scene
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.quantities import (
    ACCELERATION_NOISE,
    ACCELERATION_SENSITIVITY,
    FORCE_SENSITIVITY,
    FREQUENCY,
    LENGTH,
    RATIO,
    TIME,
    Kind,
    parse,
)

# Largest plausible mass ratio (damper to body) of a bed whose mass is given without a unit.
_MAX_MASS_RATIO = 2.0
# Largest plausible mass ratio of a bed whose mass is given with a unit: it fills a cavity of its body. The second value
# is that of a mass on a spring, and of a damper at one of the points of a structure given by matrices.
_MAX_MASS_RATIO_WITH_UNIT, _MAX_MASS_RATIO_ON_SPRING = 1.0, 50.0
# Below this mass ratio, the unit mg is probably a mistake.
_MIN_MASS_RATIO = 1e-4
# Lowest resonance [Hz] of a body on its spring in real rigs; a lower one indicates a wrong unit.
_MIN_RESONANCE_HZ = 0.1
# Lowest plausible natural frequency [Hz] if the mass or the stiffness has no unit and is read in SI.
_MIN_BARE_RESONANCE_HZ = 1.0


@dataclass(frozen=True)
class _Range:
    """Range of the values of a key in real rigs, in SI units: from `low` to below `high`.

    `path`: key path, with None for each item of a list; `unit`: the usual unit; `meaning`: meaning of a number without
    a unit; `only_bare`: whether a value with a unit is accepted.
    """

    path: tuple[str | None, ...]
    kind: Kind
    high: float
    unit: str
    meaning: str
    low: float = 0.0
    only_bare: bool = False


_RATIO_TO_CRITICAL = "a ratio to critical damping"
_CONTACT = ("dampers", None, "contact")
_RANGES = (
    _Range(("dampers", None, "clearance"), LENGTH, 0.1, "mm", "meters", only_bare=True),
    _Range(("dampers", None, "mass_ratio"), RATIO, _MAX_MASS_RATIO, "%", "a ratio", only_bare=True),
    _Range(("structure", "damping", "modal"), RATIO, 0.1, "%", _RATIO_TO_CRITICAL, only_bare=True),
    _Range(("structure", "damping", "modal", None), RATIO, 0.1, "%", _RATIO_TO_CRITICAL, only_bare=True),
    _Range(("test", "settle", "tolerance"), RATIO, 0.5, "%", "a ratio to the amplitude"),
    # Hammer impacts and wall contacts last some milliseconds.
    _Range(("test", "width"), TIME, 0.1, "ms", "seconds"),
    *(_Range((*_CONTACT, *wall, "duration"), TIME, 0.1, "ms", "seconds") for wall in ((), ("floor",), ("ceiling",))),
    # The most sensitive accelerometers and force sensors have 10 V/g and 0.1 V/N, the slowest resonate at 100 Hz.
    _Range(
        ("channels", None, "accelerometer", "sensitivity"), ACCELERATION_SENSITIVITY, 5.0, "mV/g", "volts per m/s^2"
    ),
    _Range(("channels", None, "accelerometer", "resonance"), FREQUENCY, inf, "kHz", "hertz", low=100.0),
    _Range(
        ("channels", None, "accelerometer", "noise"), ACCELERATION_NOISE, 0.1, "ug/sqrt(Hz)", "m/s^2 per root hertz"
    ),
    _Range(("channels", None, "hammer", "sensitivity"), FORCE_SENSITIVITY, 2.0, "mV/N", "volts per newton"),
)


def implausible_values(scene: Scene, content: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield a warning for each implausible quantity in the content of a valid scene."""
    for limits in _RANGES:
        for key_path, written in _values_at(content, limits.path):
            value = parse(written, limits.kind)
            is_bare = not _unit(written)
            if limits.low <= value < limits.high or value in (0.0, inf) or (limits.only_bare and not is_bare):
                continue
            converted = f"{value / parse(f'1 {limits.unit}', limits.kind):g} {limits.unit}"
            meaning = f"read as {limits.meaning} ({converted})" if is_bare else "an unusual value"
            yield _warning(key_path, written, limits.unit, meaning)
    yield from _dampers(scene, content)
    yield from _springs(scene, content)


def _dampers(scene: Scene, content: Mapping[str, Any]) -> Iterator[Problem]:
    """Compare the masses of the dampers with the masses of their bodies."""
    for key_path, written in _values_at(content, ("dampers", None, "mass")):
        damper = scene.dampers[int(key_path[1])]
        body_mass = _mass(scene, damper.body)
        if damper.mass is None:
            continue
        ratio, unit = damper.mass / body_mass, _unit(written)
        is_light = ratio < _MIN_MASS_RATIO and unit in ("mg", "ug")
        is_in_body = damper.spring is None and scene.structure.masses is not None
        largest_with_unit = _MAX_MASS_RATIO_WITH_UNIT if is_in_body else _MAX_MASS_RATIO_ON_SPRING
        if is_light or ratio > (largest_with_unit if unit else _MAX_MASS_RATIO):
            ratio_text = f"{ratio:.3g} times the mass of its body ({body_mass:.3g} kg)"
            yield _warning(key_path, written, "g", f"read as {damper.mass:g} kg, {ratio_text}")


def _springs(scene: Scene, content: Mapping[str, Any]) -> Iterator[Problem]:
    """Check the natural frequency of each body of a chain on its spring."""
    springs, masses = scene.structure.springs or (), scene.structure.masses or ()
    written_springs = _values_at(content, ("structure", "springs", None))
    written_masses = _values_at(content, ("structure", "masses", None))
    rows = [
        (sqrt(stiffness / mass) / (2.0 * pi), spring_path, spring, mass_path, body)
        for stiffness, mass, (spring_path, spring), (mass_path, body) in zip(
            springs, masses, written_springs, written_masses, strict=True
        )
    ]
    # If one spring without a unit is plausible in SI, then soft springs without a unit are meant in SI, too.
    is_si = any(resonance >= _MIN_BARE_RESONANCE_HZ and not _unit(spring) for resonance, _, spring, _, _ in rows)
    for (resonance, spring_path, spring, mass_path, body), stiffness, mass in zip(rows, springs, masses, strict=True):
        effect = f"a body of {mass:.3g} kg on a spring of {stiffness:.3g} N/m resonates at {resonance:.3g} Hz"
        if resonance == 0.0 or resonance >= _MIN_BARE_RESONANCE_HZ:
            continue
        # A mass in grams must explain the resonance: a spring in mN/m instead of MN/m is softer.
        if not _unit(body) and _unit(spring) and resonance >= _MIN_BARE_RESONANCE_HZ / sqrt(1e3):
            yield _warning(mass_path, body, "g", f"read as {mass:g} kg: {effect}")
        elif resonance < _MIN_RESONANCE_HZ or (_unit(body) and not _unit(spring) and not is_si):
            unit = "MN/m" if _unit(spring) == "mN/m" else "kN/m"
            yield _warning(spring_path, spring, unit, f"read as {stiffness:g} N/m: {effect}")


def _mass(scene: Scene, body: int) -> float:
    structure = scene.structure
    if structure.masses is not None:
        return structure.masses[body - 1]
    assert structure.matrices is not None
    return float(structure.matrices.mass[body - 1][body - 1])


def _values_at(content: Any, path: tuple[str | None, ...], parents: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    """Yield the key path and the value, a number or text, of each key that matches a path."""
    if not path:
        if content is not None and not isinstance(content, bool | list | tuple | dict):
            yield parents, content
        return
    key, inner = path[0], path[1:]
    items: Iterator[tuple[int | str, Any]]
    if key is None:
        # Masses may be given by names of bodies.
        is_list = isinstance(content, list | tuple)
        items = iter(enumerate(content) if is_list else content.items() if isinstance(content, dict) else ())
    else:
        items = iter([(key, content[key])] if isinstance(content, Mapping) and key in content else ())
    for step, value in items:
        yield from _values_at(value, inner, (*parents, step))


def _unit(written: Any) -> str:
    """Return the unit of a quantity; empty for a number without a unit."""
    text = str(written).strip()
    number = next((k for k in range(len(text), 0, -1) if text[k - 1] in ".0123456789"), 0)
    return text[number:].strip() if any(c.isalpha() or c == "%" for c in text[number:]) else ""


def _warning(key_path: KeyPath, written: Any, unit: str, meaning: str) -> Problem:
    """Return the warning for a value; `unit` is the intended unit."""
    given = _unit(written)
    intended = f"{str(written).strip().removesuffix(given).strip()} {unit}"
    if given == unit:
        return Problem(key_path, f"got {written}, {meaning}. Check this value.")
    if given:
        return Problem(key_path, f"got {written}, {meaning}. Did you mean {intended}?")
    return Problem(key_path, f"got {written} without a unit, {meaning}. Add the intended unit, such as {intended}.")
