"""Shapes of which the three-dimensional drawing of the rig consists, as rerun archetypes; lengths in meters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from daq.core.drawing.palette import Color

if TYPE_CHECKING:
    import rerun as rr

Point = tuple[float, float, float]

COIL_TURNS = 7
COIL_RADIUS = 0.020


def boxes(parts: Sequence[tuple[Point, Point]], color: Color) -> rr.Boxes3D:
    """Draw solid boxes, each by its center and its size."""
    import rerun as rr

    centers, sizes = zip(*parts, strict=True)
    return rr.Boxes3D(centers=centers, sizes=sizes, colors=[color], fill_mode="solid")


def cylinder(middle: Point, height: float, radius: float, color: Color) -> rr.Cylinders3D:
    """Draw an upright solid cylinder."""
    import rerun as rr

    return rr.Cylinders3D(centers=[middle], lengths=[height], radii=[radius], colors=[color], fill_mode="solid")


def label(position: Point, text: str, color: Color) -> rr.Points3D:
    """Write a text, centered below a point."""
    import rerun as rr

    return rr.Points3D([position], labels=[text], colors=[color], radii=[0.0001], show_labels=True)


def arrow(foot: Point, height: float, color: Color) -> rr.Arrows3D:
    """Draw an upright arrow."""
    import rerun as rr

    return rr.Arrows3D(origins=[foot], vectors=[(0, 0, height)], colors=[color], radii=[0.003])


def lines(strips: Sequence[Sequence[Point]], color: Color, radius: float) -> rr.LineStrips3D:
    """Draw thin lines."""
    import rerun as rr

    return rr.LineStrips3D(strips, colors=[color], radii=[radius])


def coils(x_positions: Sequence[float], length: float, color: Color) -> rr.LineStrips3D:
    """Draw coil springs from z = 0 to z = `length` at given positions x: each is a helix with straight ends."""
    import rerun as rr

    fraction_of_length = np.linspace(0.0, 1.0, 24 * COIL_TURNS + 1)
    angle = 2 * np.pi * COIL_TURNS * fraction_of_length
    helix = np.column_stack(
        [COIL_RADIUS * np.cos(angle), COIL_RADIUS * np.sin(angle), length * (0.08 + 0.84 * fraction_of_length)]
    )
    ends = np.array([[0.0, 0.0, fraction * length] for fraction in (0.0, 0.08, 0.92, 1.0)])
    strip = np.vstack([ends[:2], helix, ends[2:]])
    return rr.LineStrips3D([strip + np.array([x, 0.0, 0.0]) for x in x_positions], colors=[color], radii=[0.0028])
