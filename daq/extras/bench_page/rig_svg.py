"""Drawing of the rig for browsers (SVG), and the translations of its parts from the motion."""

from html import escape
from typing import Any

import numpy as np

from daq.core.drawing.palette import DAMPER, DRIVE, GROUND, LABEL, STEEL, Color, body_color, hex_color
from daq.core.drawing.rig_view import Extremes, RigMotion, RigView
from daq.core.drawing.stack import COIL_LENGTH, PLATE, WALL, WIDTH, Block
from rig.core.scene.scene import Scene

# SVG units per meter of the drawing.
_UNITS_PER_M = 1000.0
# Number of turns of a drawn spring.
_COIL_TURNS = 7
# Half the width of a drawn spring [m of the drawing].
_COIL_HALF_WIDTH = 0.018
# Left end of the labels of bodies, m of the drawing.
_LABEL_X = WIDTH / 2 + 0.015


class RigDrawing:
    """The drawing of a scene's rig in front view; `svg` is empty until the first call of `frames`.

    The exaggeration is the factor on displacements and gaps in the drawing.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._shaker_bodies = [shaker.first_body for _, shaker in scene.tables]
        self._exaggeration = 0.0
        self.svg = ""

    def frames(self, motion: RigMotion) -> dict[str, Any]:
        """Return [heights, scales] of each moving part by its SVG identifier; redraw `svg` if the exaggeration changes.

        Heights are in SVG units. Scales stretch springs vertically; they are None for other parts.
        """
        extremes = Extremes().extended_by(motion, self._shaker_bodies)
        view = RigView(self._scene, extremes, gaps_known=motion.gap is not None)
        # The exaggeration decreases immediately with growing motion, and increases only by more than a factor of 4.
        if view.exaggeration < self._exaggeration or view.exaggeration > 4 * self._exaggeration:
            self._exaggeration = view.exaggeration
            self.svg = self._draw(view)
        elif view.exaggeration != self._exaggeration:
            view.exaggeration = self._exaggeration
        parts = {}
        for entity, translation, scale in view.moving_parts(motion):
            heights = np.round(-_UNITS_PER_M * translation[:, 2], 2).tolist()
            scales = None if scale is None else np.round(scale[:, 2], 4).tolist()
            parts[svg_identifier(entity)] = [heights, scales]
        return parts

    def _draw(self, view: RigView) -> str:
        scene, parts = self._scene, [_box(0.0, -0.01, 0.44, 0.02, GROUND)]
        for table in view.shaker_tables:
            parts.append(_box(table.x, (table.top - PLATE) / 2, 0.07, table.top - PLATE - 0.012, (96, 104, 116)))
            # The springs of a body above the table must not cross its label.
            label_x = max(table.x + 0.05, _LABEL_X)
            plate = _box(table.x, -PLATE / 2, 0.085, PLATE, DRIVE) + _text(label_x, -0.02, table.point)
            parts.append(_group(table.entity("table"), plate))
            if table.has_coil_spring:
                parts.append(_group(table.entity("coil_spring"), _coil(table.x, COIL_LENGTH, DRIVE)))
        masses = scene.structure.masses
        for body in range(1, scene.structure.bodies + 1):
            height, color = view.stack.heights[body - 1], body_color(body)
            if view.has_spring[body - 1]:
                springs = "".join(_coil(x, view.stack.lengths[body - 1], STEEL) for x in (-0.3 * WIDTH, 0.3 * WIDTH))
                parts.append(_group(f"rig/spring_{body}", springs))
            cavities = view.stack.cavities[body - 1]
            frame = _box(0.0, height / 2, WIDTH, height, color, filled=not cavities)
            for cavity in cavities:
                frame += _box(cavity.x, WALL / 2, cavity.width + WALL, WALL, color)
                if cavity.ceiling is not None:
                    frame += _box(cavity.x, cavity.ceiling + WALL / 2, cavity.width + WALL, WALL, color)
                (_, _, z), (width, _, damper_height) = cavity.damper
                frame += _group(
                    view.damper_entity(cavity.damper_index), _box(cavity.x, z, width, damper_height, DAMPER)
                )
            texts = [scene.structure.label(body), *([] if masses is None else [f"{masses[body - 1]:g} kg"])]
            for row, text in enumerate(texts):
                frame += _text(_LABEL_X, height / 2 + 0.008 - 0.037 * row, text)
            frame += "".join(_block(block) for block in view.stack.blocks if block.body == body)
            parts.append(_group(f"rig/body_{body}", frame))
        parts += [_block(block) for block in view.stack.blocks if block.body is None]
        parts.append(_text(-0.14, -0.045, f"motion × {view.exaggeration:g}"))
        top = _UNITS_PER_M * (view.stack.top + 0.07)
        return f'<svg id="rig" viewBox="-150 {-top:.0f} 350 {top + 60:.0f}" role="img">' + "".join(parts) + "</svg>"


def svg_identifier(entity: str) -> str:
    """Return the SVG identifier of a part of the rig.

    >>> svg_identifier("rig/body_2/damper")
    'rig-body_2-damper'
    """
    return entity.replace("/", "-")


def _group(entity: str, content: str) -> str:
    return f'<g id="{svg_identifier(entity)}">{content}</g>'


def _box(x: float, z: float, width: float, height: float, color: Color, filled: bool = True) -> str:
    corner = _UNITS_PER_M * (x - width / 2), -_UNITS_PER_M * (z + height / 2)
    fill = hex_color(color) if filled else "none"
    return (
        f'<rect x="{corner[0]:.1f}" y="{corner[1]:.1f}" '
        f'width="{_UNITS_PER_M * width:.1f}" height="{_UNITS_PER_M * height:.1f}" '
        f'fill="{fill}" stroke="{hex_color(color)}" stroke-width="4"/>'
    )


def _block(block: Block) -> str:
    (x, _, z), (width, _, height) = block.box
    return _group(block.entity, _box(x, z, width, height, STEEL))


def _text(x: float, z: float, text: str) -> str:
    # The colors of bodies are too dark for text on the dark page.
    style = f'font-size="33" fill="{hex_color(LABEL)}"'
    return f'<text x="{_UNITS_PER_M * x:.0f}" y="{-_UNITS_PER_M * z:.0f}" {style}>{escape(text)}</text>'


def _coil(x: float, length: float, color: Color) -> str:
    height_fractions = np.linspace(0.0, 1.0, 4 * _COIL_TURNS + 1)
    points = " ".join(
        f"{_UNITS_PER_M * (x + _COIL_HALF_WIDTH * sine):.1f},{-_UNITS_PER_M * length * fraction:.1f}"
        for fraction, sine in zip(height_fractions, np.sin(2 * np.pi * _COIL_TURNS * height_fractions), strict=True)
    )
    return f'<polyline points="{points}" fill="none" stroke="{hex_color(color)}" stroke-width="2.5"/>'
