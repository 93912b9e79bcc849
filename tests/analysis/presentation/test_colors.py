"""One color for one body in figures, report, bench page and replay."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import rig
from analysis.commands.figures.frf_figure import frf_figure
from analysis.commands.report_page.drawing import rig_drawing
from analysis.commands.report_page.responses import response_chart
from daq.core.drawing.palette import channel_color, hex_color
from daq.core.drawing.rig_view import RigMotion
from daq.extras.bench_page.rig_svg import RigDrawing
from rig.core.base.palette import BODIES, DAMPER, motion_color, on_dark
from rig.core.orbits.orbit_curve import OrbitCurve
from rig.core.results.response import Response
from rig.studies.single_mode.approximate_response import Approximation

PLACES = ("body 3", "body 1", "body 2")


def curves() -> list[Response]:
    f = np.linspace(10.0, 20.0, 21)
    return [
        Response.curve(f, np.full(f.size, 1e-6 + 0j), place.replace(" ", ""), output_at=place, label=place)
        for place in PLACES
    ]


def test_bodies_have_equal_colors_everywhere() -> None:
    axes = frf_figure(curves(), "Compliance").axes[0]
    figure = {line.get_label(): line.get_color() for line in axes.lines if line.get_label() in PLACES}
    report = {curve.label: curve.style.color for curve in response_chart(curves(), PLACES).panels[0].curves}
    replay = {place: hex_color(channel_color(place)).upper() for place in PLACES}
    assert figure == report == {place: BODIES[int(place[-1]) - 1] for place in PLACES}
    # Replay and bench are dark.
    assert replay == {place: on_dark(color).upper() for place, color in figure.items()}


def test_drawings_have_colors_of_bodies_and_dampers() -> None:
    scene = rig.load("fig8-three-dampers")
    page = RigDrawing(scene)
    page.frames(RigMotion(np.zeros((3, 1)), np.zeros((1, 1)), np.zeros((3, 1))))
    for color in (*BODIES[:3], DAMPER):
        assert color.lower() in rig_drawing(scene).lower() and on_dark(color).lower() in page.svg.lower()


def test_named_body_has_the_color_of_its_number() -> None:
    axes = Figure().subplots()
    curves()[0].placed("tip", "", 5).draw(axes)
    assert axes.lines[0].get_color() == BODIES[4]


def draw_point(axes: Axes, **style: Any) -> None:
    axes.plot(1, 1, **style)


def test_types_of_motion_have_equal_colors() -> None:
    points = {"frequency": np.ones(1), "compliance": np.ones(1)} | dict.fromkeys(("stable", "valid"), np.ones(1, bool))
    axes, orbits = Figure().subplots(2)
    types = [SimpleNamespace(**points, motion_type=name) for name in ("II", "I")]
    Approximation.draw(SimpleNamespace(branches=types), axes)  # type: ignore[arg-type]
    followed = [SimpleNamespace(motion_type=name, draw=draw_point) for name in ("I", "II")]
    OrbitCurve.draw(SimpleNamespace(branches=followed), orbits)  # type: ignore[arg-type]
    colors, others = ({line.get_color() for line in each.lines} for each in (axes, orbits))
    assert colors == others == {motion_color("I"), motion_color("II")}
