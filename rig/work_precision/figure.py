"""The work-precision study as a figure, a table and a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rig.escaping import escape_figure
from rig.figure_style import new_figure, save_with_table
from rig.output_files import file_stem
from rig.results.text import format_number, table_lines
from rig.scene.scene import Scene
from rig.work_precision.motion_study import MotionStudy, Point
from rig.work_precision.steady_study import OTHER_PACKING, SteadyStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Color and marker of each method: one hue per kind of method, distinguishable in print and with color blindness.
LOOK = {
    "engine, tone": ("#c1272d", "*"),
    "engine, sampled drive": ("#e8853d", "o"),
    "penalty, LSODA": ("#4f87bd", "^"),
    "Moreau-Jean": ("#1f4e79", "s"),
    "compiled DP5": ("#1d4d1c", "X"),
    "scipy DOP853": ("#3b7d3a", "D"),
    "scipy LSODA": ("#8bbf6a", "d"),
    "CVODE": ("#6b4fa0", "P"),
    "shooting": ("#c1272d", "*"),
    "waiting": ("#e8853d", "o"),
    "approximate": ("#6b4fa0", "P"),
    "linear": ("#808080", "x"),
    "one mass": ("#c1272d", "*"),
    "finite-duration contact": ("#e8853d", "o"),
    "grains": ("#1f4e79", "s"),
    "grains, softer": ("#4f87bd", "D"),
    OTHER_PACKING: ("#8fb4d9", "v"),
}
_HEADER = ("quantity", "method", "setting", "cpu_s", "error", "event_time_error_s", "right", "note")


def table(study: MotionStudy, steady: SteadyStudy) -> str:
    """Write both studies as text: the engine's cost next to that of the best solver, then a row for each method."""
    rows = [("method", "setting", "ms a period", "relative error", "event times / s", "events", "note")]
    rows += [
        (
            *_cells(point),
            f"{point.event_error:.0e}" if np.isfinite(point.event_error) else "",
            _events(point),
            point.note,
        )
        for point in study.points
    ]
    lines = [
        f"{study.scene.name}: first {study.periods} periods at {study.frequency:.6g} Hz, {study.events} events",
        *_answer(study.points),
        "",
        *table_lines(rows, "<<>>><<"),
        "",
        f"Reference: {study.reference}",
        "",
        _steady_table(steady),
    ]
    return "\n".join(lines)


def _answer(points: Sequence[Point]) -> list[str]:
    """Compare the engine with the fastest other method within ten times the smallest error of the others."""
    solved = [point for point in points if np.isfinite(point.error) and point.right]
    engine = [point for point in solved if point.method == "engine, tone"]
    others = [point for point in solved if not point.method.startswith("engine")]
    if not engine:
        return []
    exact = min(engine, key=lambda point: point.cpu)
    out = [f"The engine: relative error {exact.error:.0e} in {1e3 * exact.cpu:.2g} ms a period."]
    if others:
        least = min(point.error for point in others)
        best = min((point for point in others if point.error <= 10.0 * least), key=lambda point: point.cpu)
        out.append(
            f"Best of the other methods, {best.method} ({best.setting}): {best.error:.0e} in {1e3 * best.cpu:.2g} ms, "
            f"{format_number(float(f'{best.cpu / exact.cpu:.2g}'))} times as long."
        )
    wrong = sum(np.isfinite(point.error) and not point.right for point in points)
    if wrong:
        out.append(f"Wrong events: {wrong} of {len(points)} settings.")
    return out


def models_table(scene: Scene, models: SteadyStudy) -> str:
    """Write the study of models of a scene's beds of grains as text."""
    return f"{scene.name}: models of its beds of grains\n\n{_steady_table(models)}"


def _steady_table(steady: SteadyStudy) -> str:
    rows = [("method", "setting", "ms in all", "relative error", "note")]
    rows += [(*_cells(point), point.note) for point in steady.points]
    table = [*table_lines(rows, "<<>><"), ""] if steady.points else []
    return "\n".join([_steady_title(steady), *table, f"Reference: {steady.reference}"])


def _steady_title(steady: SteadyStudy) -> str:
    kinds = steady.motion_type.split("/")
    word = "type " if set(kinds) <= {"I", "II", "III"} else ""
    motion = f": {word}{steady.motion_type}" if steady.motion_type else ""
    return f"Steady state at {steady.frequency:.4g} Hz{motion}"


def _cells(point: Point) -> tuple[str, str, str, str]:
    """Return method, setting, CPU time in ms and relative error of a point; "-" without a result."""
    known = np.isfinite(point.error)
    cost = (f"{1e3 * point.cpu:.4g}", f"{point.error:.0e}") if known else ("-", "-")
    return point.method, point.setting, *cost


def _events(point: Point) -> str:
    return ("right" if point.right else "wrong") if np.isfinite(point.error) else "-"


def write(study: MotionStudy, steady: SteadyStudy, folder: Path) -> list[Path]:
    """Write cost-<scene>.png, .svg and .csv into a folder, which is created if it does not exist.

    Raises `SceneError` if a file cannot be written.
    """
    name = folder / file_stem("cost", study.scene.name)
    rows = [*_rows("motion, a period", study.points), *_rows("steady state", steady.points)]
    return save_with_table(_draw(study, steady), name, [_HEADER, *rows])


def write_models(scene: Scene, models: SteadyStudy, folder: Path) -> list[Path]:
    """Write figure and table for models of a scene's beds of grains, as `write`."""
    rows = [_HEADER, *_rows("steady state", models.points)]
    return save_with_table(_draw_models(scene, models), folder / file_stem("cost", scene.name), rows)


def _rows(quantity: str, points: Iterable[Point]) -> list[list[str]]:
    return [
        [
            quantity, p.method, p.setting, *(f"{value:.6g}" for value in (p.cpu, p.error, p.event_error)),
            str(p.right).lower(), p.note,
        ]
        for p in points
    ]  # fmt: skip


def _draw(study: MotionStudy, steady: SteadyStudy) -> Figure:
    count = 1 + bool(steady.points)
    with new_figure(5.2, 10.0 if steady.points else 6.8) as figure:
        panels = figure.subplots(1, count, squeeze=False, width_ratios=(1.5, 1.0)[:count])[0]
        draw_points(panels[0], study.points, "CPU time for a period of the drive / s")
        panels[0].set_ylabel("error of the displacement, relative")
        panels[0].set_title(
            f"Motion: {study.periods} periods at {study.frequency:.4g} Hz, {study.events} events"
        )
        if steady.points:
            draw_points(panels[1], steady.points, "CPU time in all / s")
            panels[1].set_ylabel("error of the compliance, relative")
            panels[1].set_title(_steady_title(steady))
        figure.suptitle(escape_figure(study.scene.name))
        return figure


def _draw_models(scene: Scene, models: SteadyStudy) -> Figure:
    with new_figure(5.2, 6.8) as figure:
        axes = figure.subplots()
        draw_points(axes, models.points, "CPU time in all / s")
        axes.set_ylabel("compliance off that with grains, relative")
        axes.set_title(_steady_title(models))
        for point in (each for each in models.points if np.isfinite(each.error)):
            if point.method == OTHER_PACKING:
                axes.axhline(_shown(point), color=LOOK[point.method][0], ls="--", lw=1.0)
            axes.annotate(
                point.setting,
                (point.cpu, _shown(point)),
                xytext=(8, -3),
                textcoords="offset points",
                fontsize=7,
            )
        # Leave space for the labels at the right end.
        axes.margins(x=0.25)
        figure.suptitle(f"{escape_figure(scene.name)}: models of its beds of grains")
        return figure


def _shown(point: Point) -> float:
    """Return the error as drawn on the logarithmic axis."""
    return max(point.error, 1e-17)


def draw_points(axes: Axes, points: tuple[Point, ...], label: str) -> None:
    """Draw error against CPU time, both logarithmic, with a color and marker for each method."""
    methods = list(dict.fromkeys(point.method for point in points))
    for method in methods:
        own = [p for p in points if p.method == method and np.isfinite(p.error)]
        if not own:
            continue
        colour, marker = LOOK[method]
        # A line connects settings of one kind; solvers with an error tolerance are a separate kind.
        series = [p for p in own if "blind" not in p.setting]
        axes.plot([p.cpu for p in series], [_shown(p) for p in series], "-", color=colour, lw=1.0, alpha=0.6)
        for p in own:
            size = 12 if marker == "*" else 6
            face = colour if p.right else "white"
            axes.plot(p.cpu, _shown(p), marker, color=colour, ms=size, zorder=3, mfc=face, mew=1.3)
            if "blind" in p.setting or p.setting in ("as called", "warm"):
                word = "careful" if "blind" in p.setting else p.setting
                axes.annotate(
                    word, (p.cpu, _shown(p)), xytext=(0, -14), textcoords="offset points", fontsize=7,
                    color=colour, ha="center",
                )  # fmt: skip
        axes.plot([], [], marker + "-", color=colour, ms=7, lw=1.0, label=method)
    if any(not p.right and np.isfinite(p.error) and p.method != "linear" for p in points):
        axes.plot([], [], "o", color="#555555", mfc="white", mew=1.3, ms=6, label="wrong events")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(label)
    axes.margins(y=0.1)
    if methods:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3)
