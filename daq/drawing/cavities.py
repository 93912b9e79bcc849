"""Cavities of a drawn body, side by side, one for each of its dampers: walls, ceilings, and where the dampers lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq.drawing.shapes import Point

if TYPE_CHECKING:
    from rig.scene.damper import Damper

    Box = tuple[Point, Point]

WIDTH = 0.16
DEPTH = 0.10
WALL = 0.012
DAMPER_HEIGHT = 0.030
HEADROOM = 0.100
# Height of a body with cavities.
HOLLOW_HEIGHT = WALL + DAMPER_HEIGHT + HEADROOM + WALL
# Between a damper and the sides and the back of its cavity.
_PLAY = 0.003


@dataclass(frozen=True)
class Cavity:
    """One cavity, in metres of the drawing, seen from the underside of its body."""

    place: int
    """Of its damper in the scene, from 0."""
    x: float
    """Of its middle."""
    width: float
    ceiling: float | None
    """Height of the ceiling; None where it is beyond the drawing."""

    @property
    def damper(self) -> Box:
        """Centre and size of the damper on its floor."""
        size = (self.width - 2 * _PLAY, DEPTH - WALL - _PLAY - 0.001, DAMPER_HEIGHT)
        return (self.x, -WALL / 2, WALL + DAMPER_HEIGHT / 2), size


def cavities(dampers: Sequence[Damper], body: int, magnification: float) -> list[Cavity]:
    """Give the cavities of a body (from 1), from left to right in the scene's order."""
    inside = [place for place, damper in enumerate(dampers) if damper.body == body]
    pitch = (WIDTH - WALL) / max(len(inside), 1)
    found = []
    for k, place in enumerate(inside):
        clearance = dampers[place].clearance * magnification
        ceiling = None if clearance > HEADROOM else WALL + DAMPER_HEIGHT + clearance
        found.append(Cavity(place, (k + 0.5) * pitch - (WIDTH - WALL) / 2, pitch - WALL, ceiling))
    return found


def walls(inside: Sequence[Cavity]) -> list[Box]:
    """Boxes (centre, size) of a body with cavities, open to the front; ceilings where in sight."""
    height = HOLLOW_HEIGHT
    parts: list[Box] = [
        ((0, 0, WALL / 2), (WIDTH, DEPTH, WALL)),
        ((0, (DEPTH - WALL) / 2, height / 2), (WIDTH - 2 * WALL, WALL, height)),
        (((WIDTH - WALL) / 2, 0, height / 2), (WALL, DEPTH, height)),
    ]
    for cavity in inside:
        left = cavity.x - (cavity.width + WALL) / 2
        parts.append(((left, 0, height / 2), (WALL, DEPTH, height)))
        if cavity.ceiling is not None:
            middle, size = (cavity.ceiling + height) / 2, height - cavity.ceiling
            parts.append(((cavity.x, 0, middle), (cavity.width, DEPTH, size)))
    return parts
