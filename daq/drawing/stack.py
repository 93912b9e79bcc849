"""The positions at rest of the drawn parts: bodies one above the other on their springs, and the shakers' tables.

Lengths are metres of the drawing, chosen to be legible; all bodies are alike.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from daq.drawing.cavities import HOLLOW_HEIGHT, WIDTH, Cavity, cavities

if TYPE_CHECKING:
    from rig.scene.scene import Scene

SOLID_HEIGHT = 0.060
SPRING_LENGTH = 0.080
COIL_LENGTH = 0.110
PLATE = 0.018
PLINTH = 0.050
LUG = 0.050
# Distance between shakers next to the rig.
SHAKER_PITCH = 0.120


class Table(NamedTuple):
    """A shaker's table: its name, kind of shaker, the body (from 1) on its coil spring, and its place, metres."""

    point: str
    kind: str
    body: int
    x: float
    top: float

    def entity(self, part: str) -> str:
        """Path of a part of the shaker: with its number, where the table has one."""
        return "_".join([f"rig/{part}", *self.point.split()[1:]])


class Stack:
    """The parts of a scene's rig at rest, body 1 first: cavities, heights, spring lengths and undersides."""

    def __init__(self, scene: Scene, magnification: float) -> None:
        bodies = range(1, scene.structure.bodies + 1)
        self.cavities: list[list[Cavity]] = [cavities(scene.dampers, body, magnification) for body in bodies]
        self.heights = [HOLLOW_HEIGHT if inside else SOLID_HEIGHT for inside in self.cavities]
        hung = [shaker.body for _, shaker in scene.tables]
        # A table under body 1 needs room for itself and its coil spring.
        first = PLINTH + PLATE + COIL_LENGTH if 1 in hung else SPRING_LENGTH
        self.lengths = [first] + [SPRING_LENGTH] * (len(bodies) - 1)
        self.bottoms: list[float] = []
        self.top = 0.0
        for length, height in zip(self.lengths, self.heights, strict=True):
            self.bottoms.append(self.top + length)
            self.top += length + height
        # One table fits under body 1; all others are at the right, each under a lug of its body.
        aside = iter(range(len(hung)))
        self.tables: list[Table] = []
        for (point, shaker), body in zip(scene.tables, hung, strict=True):
            under = body == 1 and hung.index(1) == len(self.tables)
            x = 0.0 if under else WIDTH / 2 + LUG / 2 + SHAKER_PITCH * next(aside)
            self.tables.append(Table(point, shaker.kind, body, x, self.bottoms[body - 1] - COIL_LENGTH))


def round_factor(limit: float) -> float:
    """Round a factor down to 1, 2 or 5 times a power of ten.

    >>> round_factor(75.0), round_factor(0.3)
    (50.0, 0.2)
    """
    decade = 10.0 ** math.floor(math.log10(limit))
    # A limit that is a round number itself must not fall below it by rounding.
    return next(step * decade for step in (5.0, 2.0, 1.0, 0.5) if step * decade <= limit * (1 + 1e-9))
