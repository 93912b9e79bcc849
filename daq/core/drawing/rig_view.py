"""The three-dimensional drawing of the rig: its parts, and their motion.

Every displacement and gap is multiplied by the same factor, the exaggeration. z points up, x to the right, y away from
the viewer. Each part has an entity path in the viewer, such as ``rig/body_1/damper``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daq.core.drawing.palette import (
    DAMPER,
    DARK_STEEL,
    DRIVE,
    GROUND,
    HAMMER,
    INACTIVE,
    LABEL,
    MARK,
    STEEL,
    Color,
    body_color,
)  # fmt: skip
from daq.core.drawing.shapes import Point, arrow, boxes, coils, cylinder, label, lines
from daq.core.drawing.stack import (
    COIL_LENGTH,
    DEPTH,
    HEADROOM,
    LUG,
    PLATE,
    PLINTH,
    SPRING_LENGTH,
    WALL,
    WIDTH,
    Cavity,
    Stack,
    Table,
    round_factor,
    walls,
)
from rig.core.base.arrays import Array

if TYPE_CHECKING:
    import rerun as rr

    from rig.core.scene.scene import Scene

# The drawn length of a spring changes by at most this fraction: its turns must not touch.
_MAX_STRETCH_RATIO = 0.6
# Largest exaggeration; a larger factor would show the noise of a rig at rest.
_MAX_EXAGGERATION = 1e4


@dataclass(frozen=True)
class RigMotion:
    """The motion of the rig at some instants."""

    displacement: Array  # displacement of each body [m], positive up; shape (bodies, instants)
    tables: Array  # displacement of the table of each shaker [m]; shape (tables, instants)
    gap: Array | None = None  # height of each damper above its floor [m]; shape (dampers, instants); None if unknown


@dataclass(frozen=True)
class Extremes:
    """Largest magnitudes of a motion [m]."""

    body: float = 0.0  # displacement of a body
    spring: float = 0.0  # change of length of a spring between bodies
    coil: float = 0.0  # change of length of a spring on a table
    table: float = 0.0  # displacement of a table
    gap: float = 0.0  # height of a damper above its floor

    def extended_by(self, motion: RigMotion, shaker_bodies: Sequence[int]) -> Extremes:
        """Return the extremes of this and another motion; `shaker_bodies`: bodies (from 1) above shaker tables."""
        positions = np.vstack([np.zeros((1, motion.displacement.shape[1])), motion.displacement])
        coil = (
            _max_magnitude(motion.displacement[[body - 1 for body in shaker_bodies]] - motion.tables)
            if shaker_bodies
            else 0.0
        )
        return Extremes(
            body=max(self.body, _max_magnitude(motion.displacement)),
            spring=max(self.spring, _max_magnitude(np.diff(positions, axis=0))),
            coil=max(self.coil, coil),
            table=max(self.table, _max_magnitude(motion.tables)),
            gap=max(self.gap, 0.0 if motion.gap is None else _max_magnitude(motion.gap)),
        )


def _max_magnitude(values: Array) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if finite.size else 0.0


def exaggeration(extremes: Extremes) -> float:
    """Return the factor by which the motion is enlarged in the drawing: it is visible, and drawn parts do not collide.

    It is the largest number of the series 1, 2, 5, 10, ... at which springs stretch by less than 60 % of their length,
    tables stay above the ground, and dampers within the drawn headroom.

    >>> exaggeration(Extremes(spring=0.8e-3))
    50.0
    >>> exaggeration(Extremes())
    1.0
    """
    ranges = (
        (extremes.spring, _MAX_STRETCH_RATIO * SPRING_LENGTH),
        (extremes.coil, _MAX_STRETCH_RATIO * COIL_LENGTH),
        (extremes.table, PLINTH),
        (extremes.gap, HEADROOM),
    )
    limits = [length / motion for motion, length in ranges if motion > 0]
    if not limits:
        return 1.0
    return round_factor(min(*limits, _MAX_EXAGGERATION))


def _label_position(text: str, height: float) -> Point:
    """Return the position of a centered text next to a body."""
    return (WIDTH / 2 + 0.06 + 0.0045 * len(text), -DEPTH / 2, height)


class RigView:
    """The drawing of a scene's rig.

    `extremes` determine the exaggeration. Dampers with unknown gaps, and the bodies and tables in `unmeasured`
    (``body 1``, ...), are drawn pale and at rest, with a note.
    """

    def __init__(self, scene: Scene, extremes: Extremes, gaps_known: bool, unmeasured: Collection[str] = ()) -> None:
        from rig.core.system.structural_model import structural_model

        self.scene = scene
        self.exaggeration = exaggeration(extremes)
        self.damper_masses = structural_model(scene).damper_mass
        self.gaps_known = gaps_known
        self._unmeasured = unmeasured
        self._drawn_excursion = extremes.body * self.exaggeration
        self.bodies = scene.structure.bodies
        self.stack = Stack(scene, self.exaggeration)
        self.shaker_tables = self.stack.tables
        # If the structure is given by matrices, it is unknown which bodies are connected, and no springs are drawn.
        self.has_spring = [stiffness > 0 for stiffness in scene.structure.springs or [0.0] * self.bodies]

    def static_parts(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Yield the entity and the shape of each part; the shapes are sent to the viewer once."""
        import rerun as rr

        yield "rig", rr.ViewCoordinates.RIGHT_HAND_Z_UP
        yield "rig/ground", boxes([((0, 0, -0.01), (0.44, 0.24, 0.02))], GROUND)
        for body in range(1, self.bodies + 1):
            yield from self._body(body)
        for body, (length, has_spring) in enumerate(zip(self.stack.lengths, self.has_spring, strict=True), start=1):
            if has_spring:
                yield f"rig/spring_{body}", coils((-0.3 * WIDTH, 0.3 * WIDTH), length, STEEL)
        for table in self.shaker_tables:
            yield from self._shaker(table)
        for block in self.stack.blocks:
            yield block.entity, boxes([block.box], STEEL)
        # Arrows show forces that act directly on a body: a shaker of kind force, and the hammer.
        forced_bodies = [
            body for shaker in self.scene.shakers if shaker.glyph.shape == "arrow" for body in shaker.bodies
        ]
        for body in dict.fromkeys(forced_bodies):
            yield from self._force_arrow(body, "drive", 0.045, "force", DRIVE)
        if self.scene.hammer is not None:
            yield from self._force_arrow(self.scene.hammer, "hammer", -0.045, "hammer", HAMMER)
        yield from self._scale_marks()

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
        yield f"{name}/name", label(_label_position(text, 0.75 * height), text, LABEL)
        pointer: list[Point] = [(-WIDTH / 2 - distance_x, -DEPTH / 2, height / 2) for distance_x in (0.0, 0.028)]
        yield f"{name}/pointer", lines([pointer], color, 0.0012)

    def _color(self, point: str, color: Color) -> Color:
        return INACTIVE if point in self._unmeasured else color

    def _note(self, point: str) -> str:
        return ", not measured" if point in self._unmeasured else ""

    def damper_entity(self, index: int) -> str:
        """Return the entity of a damper (index in the scene), with a number if its body has several dampers."""
        body = self.scene.dampers[index].body
        damper_indices = [cavity.damper_index for cavity in self.stack.cavities[body - 1]]
        return f"rig/body_{body}/damper" + (f"_{damper_indices.index(index) + 1}" if len(damper_indices) > 1 else "")

    def _damper(self, body: int, number: int) -> Iterator[tuple[str, rr.AsComponents]]:
        cavity: Cavity = self.stack.cavities[body - 1][number]
        damper = self.scene.dampers[cavity.damper_index]
        text = f"damper {self.damper_masses[cavity.damper_index] * 1e3:.3g} g"
        if damper.locked:
            text += ", locked"
        elif not self.gaps_known:
            text += ", not recorded"
        elif math.isfinite(damper.clearance) and cavity.ceiling is None:
            text += ", ceiling out of sight"
        moves = self.gaps_known and not damper.locked
        name = self.damper_entity(cavity.damper_index)
        yield name, boxes([cavity.damper], DAMPER if moves else INACTIVE)
        # The names of several dampers are written below each other, next to their body.
        label_position = _label_position(text, (0.45 - 0.2 * number) * self.stack.heights[body - 1])
        yield f"{name}_name", label(label_position, text, DAMPER if moves else MARK)

    def _shaker(self, table: Table) -> Iterator[tuple[str, rr.AsComponents]]:
        height = table.top - PLATE - 0.012
        middle = (table.x, 0.0, height / 2)
        if table.glyph.shape == "cylinder":
            yield table.entity("shaker"), cylinder(middle, height, 0.036, DARK_STEEL)
        else:
            yield table.entity("shaker"), boxes([(middle, (0.07, 0.07, height))], DARK_STEEL)
        plate = ((table.x, 0, -PLATE / 2), (0.085, 0.085, PLATE))
        stem = ((table.x, 0, -PLATE - 0.02), (0.022, 0.022, 0.04))
        color = self._color(table.point, DRIVE)
        yield f"{table.entity('table')}/plate", boxes([plate, stem], color)
        label_position = (table.x + 0.055, -0.09, -PLATE)
        yield f"{table.entity('table')}/name", label(label_position, table.point + self._note(table.point), color)
        if table.has_coil_spring:
            yield table.entity("coil_spring"), coils([table.x], COIL_LENGTH, DRIVE)

    def _force_arrow(
        self, body: int, name: str, x: float, text: str, color: Color
    ) -> Iterator[tuple[str, rr.AsComponents]]:
        """Draw an upward arrow at the front of the underside of a body, with a text at the left."""
        foot, entity = (x, -DEPTH / 2 - 0.02, -0.055), f"rig/body_{body}/{name}"
        yield entity, arrow(foot, 0.055, color)
        text = f"{text} on {self.scene.structure.label(body)}"
        left = -_label_position(text, 0.0)[0]
        yield f"{entity}/name", label((left, foot[1], foot[2]), text, LABEL)

    def _scale_marks(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Draw the rest positions of the bodies and, at the left, a scale bar with its length and the exaggeration."""
        x, y = -WIDTH / 2 - 0.032, -DEPTH / 2
        middles = [bottom + height / 2 for bottom, height in zip(self.stack.bottoms, self.stack.heights, strict=True)]
        yield "rig/rest", lines([[(x - 0.030, y, z), (x, y, z)] for z in middles], MARK, 0.0008)
        length = _scale_bar(self.exaggeration)
        height, x, z = length * self.exaggeration, x - 0.12, middles[0]
        end_marks: list[list[Point]] = [[(x - 0.008, y, z + end), (x + 0.008, y, z + end)] for end in (0.0, height)]
        yield "rig/scale", lines([[(x, y, z), (x, y, z + height)], *end_marks], MARK, 0.0010)
        text = f"{length * 1e3:g} mm, drawn × {self.exaggeration:g}"
        yield "rig/scale/text", label((x, y, z - 0.006), text, MARK)

    def moving_parts(self, motion: RigMotion) -> Iterator[tuple[str, Array, Array | None]]:
        """Yield entity and translation [m of the drawing] of moving parts, and scale of springs; (instants, 3)."""
        drawn_displacement = motion.displacement * self.exaggeration
        drawn_tables = motion.tables * self.exaggeration
        lower_end = drawn_tables[0] if self.stack.ground else np.zeros(drawn_displacement.shape[1])
        lower_end_at_rest = self.stack.ground
        for index in range(self.bodies):
            yield f"rig/body_{index + 1}", _along_z(self.stack.bottoms[index] + drawn_displacement[index]), None
            if self.has_spring[index]:
                length = self.stack.lengths[index]
                stretch = (length + drawn_displacement[index] - lower_end) / length
                yield f"rig/spring_{index + 1}", _along_z(lower_end_at_rest + lower_end), _along_z(stretch, 1.0)
            lower_end = drawn_displacement[index]
            lower_end_at_rest = self.stack.bottoms[index] + self.stack.heights[index]
        for table, table_motion in zip(self.shaker_tables, drawn_tables, strict=True):
            yield table.entity("table"), _along_z(table.top + table_motion), None
            if table.has_coil_spring:
                stretch = (COIL_LENGTH + drawn_displacement[table.body - 1] - table_motion) / COIL_LENGTH
                yield table.entity("coil_spring"), _along_z(table.top + table_motion), _along_z(stretch, 1.0)
        if motion.gap is not None:
            for index in range(len(self.scene.dampers)):
                yield self.damper_entity(index), _along_z(motion.gap[index] * self.exaggeration), None

    @property
    def camera(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Position of the camera, and the point it looks at: the whole rig from the front, from slightly above."""
        top = self.stack.top + self._drawn_excursion
        distance = 0.25 + 0.85 * top
        return (0.14 * distance, -distance, 0.5 * top - 0.02 + 0.14 * distance), (0.02, 0.0, 0.5 * top - 0.02)


def _along_z(values: Array, transverse: float = 0.0) -> Array:
    points = np.full((values.size, 3), transverse)
    points[:, 2] = values
    return points


def _scale_bar(exaggeration: float) -> float:
    """Return the length of the scale bar [m]: a power of ten that is drawn 8 mm to 80 mm long.

    >>> _scale_bar(50.0), _scale_bar(500.0)
    (0.001, 0.0001)
    """
    return float(f"{10.0 ** math.floor(math.log10(0.08 / exaggeration)):.0e}")
