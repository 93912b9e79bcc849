"""Positions and sizes of the drawn parts at rest: bodies with cavities, springs between them, and shaker tables.

Lengths are in meters at the scale of the drawing and chosen for legibility. All bodies have the same width and depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from daq.core.drawing.shapes import Point

if TYPE_CHECKING:
    from rig.core.scene.damper import Damper
    from rig.core.scene.joint import Joint
    from rig.core.scene.scene import Scene
    from rig.core.scene.shaker.kind import Glyph

    Box = tuple[Point, Point]

WIDTH = 0.16  # width of a body
DEPTH = 0.10  # depth of a body
WALL = 0.012  # thickness of the walls of a body with cavities
DAMPER_HEIGHT = 0.030  # height of a damper
HEADROOM = 0.100  # height of the space above a damper
HOLLOW_HEIGHT = WALL + DAMPER_HEIGHT + HEADROOM + WALL  # height of a body with cavities
SOLID_HEIGHT = 0.060  # height of a body without cavities
_DAMPER_MARGIN = 0.003  # distance of a damper from the sides and the back of its cavity
SPRING_LENGTH = 0.080  # length of a spring at rest
COIL_LENGTH = 0.110  # length of a coil spring at rest
PLATE = 0.018  # thickness of the plate of a shaker's table
PLINTH = 0.050  # height of a shaker below its table
LUG = 0.050  # width of a lug: a bracket at a body, to which a coil spring next to the rig is attached
BLOCK_WIDTH = 0.014  # width of the block of a stop
BLOCK_HEIGHT = 0.010  # minimum height of a block
SHAKER_PITCH = 0.120  # distance between shakers next to the rig


@dataclass(frozen=True)
class Cavity:
    """A cavity of a body for one damper, in meters of the drawing from the underside of the body."""

    damper_index: int  # index of its damper in the scene
    x: float  # position of its middle
    width: float
    ceiling: float | None  # height of the ceiling; None if it is above the drawing
    rest: float = 0.0  # height of the damper at rest above the floor

    @property
    def damper(self) -> Box:
        """Center and size of the damper at rest."""
        size = (self.width - 2 * _DAMPER_MARGIN, DEPTH - WALL - _DAMPER_MARGIN - 0.001, DAMPER_HEIGHT)
        return (self.x, -WALL / 2, WALL + self.rest + DAMPER_HEIGHT / 2), size


def cavities(dampers: Sequence[Damper], body: int, exaggeration: float) -> list[Cavity]:
    """Return the cavities of a body (from 1), from left to right in the scene's order."""
    dampers_of_body = [index for index, damper in enumerate(dampers) if damper.body == body]
    cavity_pitch = (WIDTH - WALL) / max(len(dampers_of_body), 1)
    result = []
    for number, index in enumerate(dampers_of_body):
        # A mass on a spring and a sliding mass move in both directions.
        below, above = (distance * exaggeration for distance in dampers[index].distances)
        rest = min(below, HEADROOM / 2)
        clearance = rest + above
        ceiling = None if clearance > HEADROOM else WALL + DAMPER_HEIGHT + clearance
        x = (number + 0.5) * cavity_pitch - (WIDTH - WALL) / 2
        result.append(Cavity(index, x, cavity_pitch - WALL, ceiling, rest))
    return result


def walls(cavities: Sequence[Cavity]) -> list[Box]:
    """Return the boxes (center, size) of a body with cavities, open to the front, with the visible ceilings."""
    height = HOLLOW_HEIGHT
    parts: list[Box] = [
        ((0, 0, WALL / 2), (WIDTH, DEPTH, WALL)),
        ((0, (DEPTH - WALL) / 2, height / 2), (WIDTH - 2 * WALL, WALL, height)),
        (((WIDTH - WALL) / 2, 0, height / 2), (WALL, DEPTH, height)),
    ]
    for cavity in cavities:
        left_wall_x = cavity.x - (cavity.width + WALL) / 2
        parts.append(((left_wall_x, 0, height / 2), (WALL, DEPTH, height)))
        if cavity.ceiling is not None:
            middle, size = (cavity.ceiling + height) / 2, height - cavity.ceiling
            parts.append(((cavity.x, 0, middle), (cavity.width, DEPTH, size)))
    return parts


class Block(NamedTuple):
    """The block of a joint, fixed to the upper of two parts.

    Its distance from the lower part is the gap of the stop.
    """

    number: int  # number of the joint, from 1
    body: int | None  # number of its body, from 1; None if it is fixed to the ground
    box: Box  # position relative to the underside of its body, or to the ground

    @property
    def entity(self) -> str:
        """Path of the joint's entity in the viewer."""
        return f"rig/joint_{self.number}" if self.body is None else f"rig/body_{self.body}/joint_{self.number}"


class Table(NamedTuple):
    """The table of a shaker; lengths in m."""

    point: str  # name, such as ``table``
    glyph: Glyph  # symbol of the shaker
    body: int  # number of the body above it, from 1
    x: float  # horizontal position
    top: float  # height of its top
    has_coil_spring: bool  # whether it drives through a coil spring; otherwise the structure stands on it

    def entity(self, part: str) -> str:
        """Return the path of a part of the shaker, with the number of the table if there are several."""
        return "_".join([f"rig/{part}", *self.point.split()[1:]])


class Stack:
    """The parts of a scene's rig at rest: for each body, its cavities, height, spring length and underside."""

    def __init__(self, scene: Scene, exaggeration: float) -> None:
        bodies = range(1, scene.structure.bodies + 1)
        self.cavities: list[list[Cavity]] = [cavities(scene.dampers, body, exaggeration) for body in bodies]
        self.heights = [HOLLOW_HEIGHT if body_cavities else SOLID_HEIGHT for body_cavities in self.cavities]
        shaker_bodies = [shaker.first_body for _, shaker in scene.tables]
        # A table below the whole structure replaces the ground, at its height.
        self.ground = PLINTH + PLATE if any(shaker.carries_structure for shaker in scene.shakers) else 0.0
        # A table of body 1 with a coil spring requires space below the body.
        first_length = PLINTH + PLATE + COIL_LENGTH if 1 in shaker_bodies and not self.ground else SPRING_LENGTH
        self.lengths = [first_length] + [SPRING_LENGTH] * (len(bodies) - 1)
        self.bottoms: list[float] = []
        self.top = self.ground
        for length, height in zip(self.lengths, self.heights, strict=True):
            self.bottoms.append(self.top + length)
            self.top += length + height
        # The table of body 1 is under the body; other tables are at the right, each under a lug of its body.
        right_positions = iter(range(len(shaker_bodies)))
        self.tables: list[Table] = []
        for (point, shaker), body in zip(scene.tables, shaker_bodies, strict=True):
            is_under_body = body == 1 and shaker_bodies.index(1) == len(self.tables)
            x = 0.0 if is_under_body else WIDTH / 2 + LUG / 2 + SHAKER_PITCH * next(right_positions)
            top = self.ground or self.bottoms[body - 1] - COIL_LENGTH
            self.tables.append(Table(point, shaker.glyph, body, x, top, shaker.coil_spring is not None))
        self.blocks = [self._block(number, joint, exaggeration) for number, joint in enumerate(scene.joints, 1)]

    def _block(self, number: int, joint: Joint, exaggeration: float) -> Block:
        """Return the block of a joint: between the bodies if they are neighbors, otherwise at the right of both."""
        # A gap that exceeds the space below a body is drawn smaller.
        lower, upper = joint.ends
        top = self.ground if lower is None else self.bottoms[lower] + self.heights[lower]
        bottom = 0.0 if upper is None else self.bottoms[upper]
        is_next = upper is not None and upper == (0 if lower is None else lower + 1)
        space = bottom - top if is_next else SPRING_LENGTH
        end = top + min(joint.gap * exaggeration, space - BLOCK_HEIGHT)
        height = bottom - end if is_next else BLOCK_HEIGHT
        x = (0.42 if is_next else 0.56) * WIDTH
        body = None if upper is None else upper + 1
        return Block(number, body, ((x, 0.0, end + height / 2 - bottom), (BLOCK_WIDTH, DEPTH / 2, height)))


def round_factor(limit: float) -> float:
    """Round a factor down to 1, 2 or 5 times a power of ten.

    >>> round_factor(75.0), round_factor(0.3)
    (50.0, 0.2)
    """
    decade = 10.0 ** math.floor(math.log10(limit))
    # The tolerance prevents that rounding errors reduce a limit that is already round.
    return next(step * decade for step in (5.0, 2.0, 1.0, 0.5) if step * decade <= limit * (1 + 1e-9))
