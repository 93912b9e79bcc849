"""Bare numbers that are improbable in SI: valid, but their unit was probably forgotten, which a warning says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import inf
from typing import Any

from rig.scene.scene import Scene
from rig.scene.settings import Mistake, Place, at

# Limits from which a bare number is questioned, because its unit was probably forgotten.
#: Clearance, m: cavities are lower.
_CLEARANCE = 0.1
#: Damping ratio: structures are less damped.
_DAMPING = 0.1
#: Mass ratio: beds are lighter than twice their mode.
_MASS_RATIO = 2.0


def doubts(scene: Scene, content: Mapping[str, Any]) -> Iterator[Mistake]:
    """Yield a warning for each such number in the content of a valid scene."""
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
