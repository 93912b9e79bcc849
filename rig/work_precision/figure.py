"""The work-precision study as a figure, a table and a file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rig.escaping import drawn
from rig.figure_style import drawing, save_with_table
from rig.output_files import stem
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
    """Write both studies as text."""
    lines = [
        f"{study.scene.name}: first {study.periods} periods at {study.frequency:.6g} Hz, {study.events} events",
        "",
        f"{'method':24}{'setting':30}{'ms a period':>12}{'error':>9}{'of times':>11}  events",
    ]
    lines += [_line(point, 1e3 * point.cpu, "right" if point.right else "wrong") for point in study.points]
    lines += [
        "", f"reference: {study.reference};",
        f"           the best method's error is {study.margin:.0e} times that.", "",
    ]  # fmt: skip
    return "\n".join([*(line.rstrip() for line in lines), _steady_table(steady)])


def models_table(scene: Scene, models: SteadyStudy) -> str:
    """Write the study of models of a scene's beds of grains as text."""
    return f"{scene.name}: models of its beds of grains\n\n{_steady_table(models)}"


def _steady_table(steady: SteadyStudy) -> str:
    lines = [_steady_title(steady), f"{'method':24}{'setting':30}{'ms in all':>12}{'error':>9}"]
    lines += [_line(point, 1e3 * point.cpu, "") for point in steady.points]
    lines += ["", f"reference: {steady.reference}"]
    return "\n".join(line.rstrip() for line in lines)


def _steady_title(steady: SteadyStudy) -> str:
    kinds = steady.motion_type.split("/")
    word = "type " if set(kinds) <= {"I", "II", "III"} else ""
    motion = f": {word}{steady.motion_type}" if steady.motion_type else ""
    return f"Steady state at {steady.frequency:.4g} Hz{motion}"


def _line(point: Point, milliseconds: float, events: str) -> str:
    start = f"{point.method:24}{point.setting:30}"
    if np.isnan(point.error):
        return f"{start}  {point.note}"
    times = f"{point.event_error:9.0e} s" if np.isfinite(point.event_error) else f"{'':11}"
    return f"{start}{milliseconds:12.4g}{point.error:9.0e}{times}  {events}  {point.note}"


def write(study: MotionStudy, steady: SteadyStudy, folder: Path) -> list[Path]:
    """Write cost-<scene>.png, .svg and .csv into a folder, which is created if it does not exist.

    Raises `SceneError` if a file cannot be written.
    """
    name = folder / stem("cost", study.scene.name)
    rows = [*_rows("motion, a period", study.points), *_rows("steady state", steady.points)]
    return save_with_table(_draw(study, steady), name, [_HEADER, *rows])


def write_models(scene: Scene, models: SteadyStudy, folder: Path) -> list[Path]:
    """Write figure and table for models of a scene's beds of grains, as `write`."""
    rows = [_HEADER, *_rows("steady state", models.points)]
    return save_with_table(_draw_models(scene, models), folder / stem("cost", scene.name), rows)


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
    with drawing(5.2, 10.0 if steady.points else 6.8) as figure:
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
        figure.suptitle(drawn(study.scene.name))
        return figure


def _draw_models(scene: Scene, models: SteadyStudy) -> Figure:
    with drawing(5.2, 6.8) as figure:
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
        figure.suptitle(f"{drawn(scene.name)}: models of its beds of grains")
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
