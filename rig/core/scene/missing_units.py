"""Warnings for bare numbers that are valid but implausible in SI, because their unit was probably forgotten."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import inf
from typing import Any

from rig.core.scene.scene import Scene
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.settings import value_at

# A bare number at or above one of these limits causes a warning.
#: Clearance of real cavities [m].
_MAX_CLEARANCE_M = 0.1
#: Damping ratio of real structures.
_MAX_DAMPING_RATIO = 0.1
#: Mass ratio of real beds (damper to modal mass).
_MAX_MASS_RATIO = 2.0


def implausible_values(scene: Scene, content: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield a warning for each implausible bare number in the content of a valid scene."""
    for k, damper in enumerate(scene.dampers):
        if damper.clearance < inf:
            yield from _check_number(
                content, ("dampers", k, "clearance"), damper.clearance, _MAX_CLEARANCE_M, "meters", 1e3, "mm"
            )
        if damper.mass_ratio is not None:
            key_path: KeyPath = ("dampers", k, "mass_ratio")
            yield from _check_number(content, key_path, damper.mass_ratio, _MAX_MASS_RATIO, "a ratio", 1e2, "%")
    modal = value_at(scene.structure.damping, ("modal",))
    is_list = isinstance(modal, tuple)
    for k, ratio in enumerate(modal if is_list else (modal or 0.0,)):
        key_path = ("structure", "damping", "modal", *((k,) if is_list else ()))
        yield from _check_number(content, key_path, ratio, _MAX_DAMPING_RATIO, "a ratio to critical damping", 1e2, "%")


def _check_number(
    content: Mapping[str, Any],
    key_path: KeyPath,
    value: float,
    threshold: float,
    meaning: str,
    factor: float,
    unit: str,
) -> Iterator[Problem]:
    if value < threshold:
        return
    number: Any = content
    for key in key_path:
        number = number[key]
    if str(number)[-1] in ".0123456789":  # no unit
        yield Problem(
            key_path,
            f"got {number} without a unit, read as {meaning} ({factor * value:g} {unit}). Add the intended unit, "
            f"such as {number} {unit}.",
        )
