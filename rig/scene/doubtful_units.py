"""Warnings for bare numbers that are valid but improbable in SI, because their unit was probably forgotten."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import inf
from typing import Any

from rig.scene.scene import Scene
from rig.scene.settings import Mistake, Place, at

# Limits from which a bare number causes a warning.
#: Clearance, m: real cavities have less.
_CLEARANCE = 0.1
#: Damping ratio: real structures have less.
_DAMPING = 0.1
#: Mass ratio: real beds have less than twice the modal mass.
_MASS_RATIO = 2.0


def doubts(scene: Scene, content: Mapping[str, Any]) -> Iterator[Mistake]:
    """Yield a warning for each improbable bare number in the content of a valid scene."""
    for k, damper in enumerate(scene.dampers):
        if damper.clearance < inf:
            yield from _doubt(
                content, ("dampers", k, "clearance"), damper.clearance, _CLEARANCE, "metres", 1e3, "mm"
            )
        if damper.mass_ratio is not None:
            place: Place = ("dampers", k, "mass_ratio")
            yield from _doubt(content, place, damper.mass_ratio, _MASS_RATIO, "a share", 1e2, "%")
    modal = at(scene.structure.damping, ("modal",))
    several = isinstance(modal, tuple)
    for k, ratio in enumerate(modal if several else (modal or 0.0,)):
        place = ("structure", "damping", "modal", *((k,) if several else ()))
        yield from _doubt(content, place, ratio, _DAMPING, "a share of critical", 1e2, "%")


def _doubt(
    content: Mapping[str, Any], place: Place, value: float, least: float, means: str, factor: float, unit: str
) -> Iterator[Mistake]:
    if value < least:
        return
    written: Any = content
    for key in place:
        written = written[key]
    if str(written)[-1] in ".0123456789":
        yield Mistake(
            place,
            f"got {written} without a unit, which is {means}: {factor * value:g} {unit}; expected a unit, such as "
            f"{written} {unit}",
        )
