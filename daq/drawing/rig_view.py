"""The rig as a drawing in space: its parts, and their motion.

Every displacement and gap is multiplied by one exaggeration. z points up, x to the right, y away.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daq.drawing.palette import DARK_STEEL, DRIVE, GLUED, GROUND, HAMMER, LEAD, MARK, STEEL, Color, body_color
from daq.drawing.shapes import Point, arrow, boxes, coils, cylinder, label, lines
from daq.drawing.stack import (
    COIL_LENGTH,
    DEPTH,
    HEADROOM,
    LUG,
    PLATE,
    SPRING_LENGTH,
    WALL,
    WIDTH,
    Cavity,
    Stack,
    Table,
    round_factor,
    walls,
)
from rig.arrays import Array

if TYPE_CHECKING:
    import rerun as rr

    from rig.scene.scene import Scene

# Ratio of the largest motion across a spring to its drawn length.
_MAX_STRETCH_RATIO = 0.6
# A larger exaggeration would show the noise of a rig at rest.
_MAX_EXAGGERATION = 1e4


@dataclass(frozen=True)
class RigPose:
    """The motion at some instants."""

    displacement: Array  # of each body, m, up positive; shape (bodies, instants)
    tables: Array  # of each shaker's table, m; shape (tables, instants)
    gap: Array | None = None  # height of each damper over its floor, m; shape (dampers, instants); None: not known


@dataclass(frozen=True)
class Extremes:
    """The largest motions of bodies, and across springs, coil spring and gaps, metres."""

    body: float = 0.0
    spring: float = 0.0
    coil: float = 0.0
    gap: float = 0.0

    def widened(self, motion: RigPose, shaker_bodies: Sequence[int]) -> Extremes:
        """Return the extremes of this and another segment; `shaker_bodies`: bodies (from 1) on coil springs."""
        ends = np.vstack([np.zeros((1, motion.displacement.shape[1])), motion.displacement])
        coil = (
            _max_magnitude(motion.displacement[[body - 1 for body in shaker_bodies]] - motion.tables)
            if shaker_bodies
            else 0.0
        )
        return Extremes(
            body=max(self.body, _max_magnitude(motion.displacement)),
            spring=max(self.spring, _max_magnitude(np.diff(ends, axis=0))),
            coil=max(self.coil, coil),
            gap=max(self.gap, 0.0 if motion.gap is None else _max_magnitude(motion.gap)),
        )


def _max_magnitude(values: Array) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if finite.size else 0.0


def exaggeration(extremes: Extremes) -> float:
    """Return the factor that makes the motion visible without collisions of drawn parts.

    It is the largest 1-2-5 number for which springs stretch by less than 60 % of their length and dampers stay
    inside the drawn headroom.

    >>> exaggeration(Extremes(spring=0.8e-3))
    50.0
    >>> exaggeration(Extremes())
    1.0
    """
    room = (
        (extremes.spring, _MAX_STRETCH_RATIO * SPRING_LENGTH),
        (extremes.coil, _MAX_STRETCH_RATIO * COIL_LENGTH),
        (extremes.gap, HEADROOM),
    )
    limits = [space / motion for motion, space in room if motion > 0]
    if not limits:
        return 1.0
    return round_factor(min(*limits, _MAX_EXAGGERATION))


def _label_place(text: str, height: float) -> Point:
    """Return the position of a centered text next to a body."""
    return (WIDTH / 2 + 0.06 + 0.0045 * len(text), -DEPTH / 2, height)


class RigView:
    """The drawing of one scene's rig.

    `extremes` set the exaggeration. Dampers with unknown gaps, and points in `unknown` (``body 1``, ...), are
    drawn pale and at rest, with a note.
    """

    def __init__(self, scene: Scene, extremes: Extremes, gaps_known: bool, unknown: Collection[str] = ()) -> None:
        from rig.system.structural_model import structural_model

        self.scene = scene
        self.magnification = exaggeration(extremes)
        self.damper_masses = structural_model(scene).bed_mass
        self.gaps_known = gaps_known
        self._unknown = unknown
        self._excursion = extremes.body * self.magnification
        self.bodies = scene.structure.bodies
        self.stack = Stack(scene, self.magnification)
        self.shaker_tables = self.stack.tables
        # Matrices do not state which bodies are connected; a spring of no stiffness is not drawn.
        self.sprung = [stiffness > 0 for stiffness in scene.structure.springs or [0.0] * self.bodies]

    def still_parts(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Yield entity paths and archetypes that are logged once."""
        import rerun as rr

        yield "rig", rr.ViewCoordinates.RIGHT_HAND_Z_UP
        yield "rig/ground", boxes([((0, 0, -0.01), (0.44, 0.24, 0.02))], GROUND)
        for body in range(1, self.bodies + 1):
            yield from self._body(body)
        for body, (length, sprung) in enumerate(zip(self.stack.lengths, self.sprung, strict=True), start=1):
            if sprung:
                yield f"rig/spring_{body}", coils((-0.3 * WIDTH, 0.3 * WIDTH), length, STEEL)
        for table in self.shaker_tables:
            yield from self._shaker(table)
        # Arrows on the bodies on which a force acts directly: kind force, and the hammer.
        forced_bodies = [body for shaker in self.scene.shakers if shaker.kind == "force" for body in shaker.bodies]
        for body in dict.fromkeys(forced_bodies):
            yield from self._force_arrow(f"rig/body_{body}/drive", 0.045, "force", DRIVE)
        test = self.scene.test
        if test is not None and test.kind == "impulse":
            yield from self._force_arrow(f"rig/body_{test.body}/hammer", -0.045, "hammer", HAMMER)
        yield from self._rest_marks()

    def _body(self, body: int) -> Iterator[tuple[str, rr.AsComponents]]:
        color, height = self._color(f"body {body}", body_color(body)), self.stack.heights[body - 1]
        name = f"rig/body_{body}"
        masses = self.scene.structure.masses
        text = self.scene.structure.label(body) + (f"  {masses[body - 1]:g} kg" if masses is not None else "")
        text += self._note(f"body {body}")
        cavities = self.stack.cavities[body - 1]
        if cavities:
            yield f"{name}/frame", boxes(walls(cavities), color)
            for number in range(len(cavities)):
                yield from self._damper(body, number)
        else:
            yield f"{name}/frame", boxes([((0, 0, height / 2), (WIDTH, DEPTH, height))], color)
        lug_end = max(
            (table.x + LUG / 2 for table in self.shaker_tables if table.body == body and table.x), default=0.0
        )
        if lug_end:
            middle, length = (lug_end + WIDTH / 2) / 2, lug_end - WIDTH / 2
            yield f"{name}/lug", boxes([((middle, 0, WALL / 2), (length, DEPTH / 2, WALL))], color)
        yield f"{name}/name", label(_label_place(text, 0.75 * height), text, color)
        pointer: list[Point] = [(-WIDTH / 2 - out, -DEPTH / 2, height / 2) for out in (0.0, 0.028)]
        yield f"{name}/pointer", lines([pointer], color, 0.0012)

    def _color(self, point: str, color: Color) -> Color:
        return GLUED if point in self._unknown else color

    def _note(self, point: str) -> str:
        return ", not measured" if point in self._unknown else ""

    def damper_entity(self, place: int) -> str:
        """Return the path of a damper, with a number if its body has several."""
        body = self.scene.dampers[place].body
        places = [cavity.place for cavity in self.stack.cavities[body - 1]]
        return f"rig/body_{body}/damper" + (f"_{places.index(place) + 1}" if len(places) > 1 else "")

    def _damper(self, body: int, number: int) -> Iterator[tuple[str, rr.AsComponents]]:
        cavity: Cavity = self.stack.cavities[body - 1][number]
        damper = self.scene.dampers[cavity.place]
        text = f"damper {self.damper_masses[cavity.place] * 1e3:.3g} g"
        if damper.locked:
            text += ", locked"
        elif not self.gaps_known:
            text += ", not recorded"
        elif math.isfinite(damper.clearance) and cavity.ceiling is None:
            text += ", ceiling out of sight"
        moves = self.gaps_known and not damper.locked
        name = self.damper_entity(cavity.place)
        yield name, boxes([cavity.damper], LEAD if moves else GLUED)
        # Names of several dampers are below each other, next to their body.
        text_at = _label_place(text, (0.45 - 0.2 * number) * self.stack.heights[body - 1])
        yield f"{name}_name", label(text_at, text, LEAD if moves else MARK)

    def _shaker(self, table: Table) -> Iterator[tuple[str, rr.AsComponents]]:
        height = table.top - PLATE - 0.012
        middle = (table.x, 0.0, height / 2)
        if table.kind == "electrodynamic":
            yield table.entity("shaker"), cylinder(middle, height, 0.036, DARK_STEEL)
        else:
            yield table.entity("shaker"), boxes([(middle, (0.07, 0.07, height))], DARK_STEEL)
        plate = ((table.x, 0, -PLATE / 2), (0.085, 0.085, PLATE))
        stem = ((table.x, 0, -PLATE - 0.02), (0.022, 0.022, 0.04))
        color = self._color(table.point, DRIVE)
        yield f"{table.entity('table')}/plate", boxes([plate, stem], color)
        text_at = (table.x + 0.055, -0.09, -PLATE)
        text = table.point if table.kind == "table" else table.point.replace("table", "armature")
        yield f"{table.entity('table')}/name", label(text_at, text + self._note(table.point), color)
        yield table.entity("coil_spring"), coils([table.x], COIL_LENGTH, DRIVE)

    @staticmethod
    def _force_arrow(entity: str, x: float, text: str, color: Color) -> Iterator[tuple[str, rr.AsComponents]]:
        """Draw an upward arrow at the front of a body's underside, with its name."""
        foot = (x, -DEPTH / 2 - 0.02, -0.055)
        yield entity, arrow(foot, 0.055, color)
        yield f"{entity}/name", label(foot, text, color)

    def _rest_marks(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Draw the scale at the left: rest positions of the bodies, a drawn length, and the exaggeration."""
        x, y = -WIDTH / 2 - 0.032, -DEPTH / 2
        middles = [bottom + height / 2 for bottom, height in zip(self.stack.bottoms, self.stack.heights, strict=True)]
        yield "rig/rest", lines([[(x - 0.030, y, z), (x, y, z)] for z in middles], MARK, 0.0008)
        length = _scale_bar(self.magnification)
        height, x, z = length * self.magnification, x - 0.07, middles[0]
        ends: list[list[Point]] = [[(x - 0.008, y, z + end), (x + 0.008, y, z + end)] for end in (0.0, height)]
        yield "rig/scale", lines([[(x, y, z), (x, y, z + height)], *ends], MARK, 0.0010)
        text = f"{length * 1e3:g} mm, drawn × {self.magnification:g}"
        yield "rig/scale/text", label((x, y, z - 0.006), text, MARK)

    def moving_parts(self, motion: RigPose) -> Iterator[tuple[str, Array, Array | None]]:
        """Yield (entity, translation, scale), each (instants, 3), in drawing metres; no scale for bodies.

        Springs are drawn once at their rest length; a stretched spring is scaled along z.
        """
        shift = motion.displacement * self.magnification
        below = np.zeros(shift.shape[1])
        top = 0.0
        for place in range(self.bodies):
            yield f"rig/body_{place + 1}", _along_z(self.stack.bottoms[place] + shift[place]), None
            if self.sprung[place]:
                length = self.stack.lengths[place]
                stretch = (length + shift[place] - below) / length
                yield f"rig/spring_{place + 1}", _along_z(top + below), _along_z(stretch, 1.0)
            below, top = shift[place], self.stack.bottoms[place] + self.stack.heights[place]
        for table, rows in zip(self.shaker_tables, motion.tables * self.magnification, strict=True):
            yield table.entity("table"), _along_z(table.top + rows), None
            stretch = (COIL_LENGTH + shift[table.body - 1] - rows) / COIL_LENGTH
            yield table.entity("coil_spring"), _along_z(table.top + rows), _along_z(stretch, 1.0)
        if motion.gap is not None:
            for place in range(len(self.scene.dampers)):
                yield self.damper_entity(place), _along_z(motion.gap[place] * self.magnification), None

    @property
    def eye(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Position and target of the camera: the whole stack, from the front, a little above."""
        top = self.stack.top + self._excursion
        distance = 0.25 + 0.85 * top
        return (0.14 * distance, -distance, 0.5 * top - 0.02 + 0.14 * distance), (0.02, 0.0, 0.5 * top - 0.02)


def _along_z(values: Array, others: float = 0.0) -> Array:
    points = np.full((values.size, 3), others)
    points[:, 2] = values
    return points


def _scale_bar(magnification: float) -> float:
    """Return the length of the scale, m: a power of ten that is drawn 8 mm to 80 mm long.

    >>> _scale_bar(50.0), _scale_bar(500.0)
    (0.001, 0.0001)
    """
    return float(f"{10.0 ** math.floor(math.log10(0.08 / magnification)):.0e}")
