"""Work-precision study of a scene, of methods or of models of its granular beds: result, table and figure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.figure_style import add_caption, add_page_title, new_figure, power_label, save_with_table
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.output_files import file_stem
from rig.core.results import Result
from rig.core.results.text import format_number, table_lines
from rig.core.scene.scene import Scene
from rig.core.system.assembly import assemble
from rig.core.system.spheres import spheres_of
from rig.studies.cost.high_precision import DIGITS
from rig.studies.cost.motion_study import SHORT_STEP_SETTING, MotionStudy, Point, default_frequency, motion_study
from rig.studies.cost.steady_study import OTHER_PACKING, SteadyStudy, steady_study

#: Color and marker of each method: one hue per kind of method, distinguishable in print and with color blindness.
STYLE_OF_METHOD = {
    "engine, tone": ("#c1272d", "*"),
    "engine, sampled drive": ("#e8853d", "o"),
    "penalty, LSODA": ("#4f87bd", "^"),
    "Moreau-Jean": ("#1f4e79", "s"),
    "compiled DP5": ("#1d4d1c", "X"),
    "scipy DOP853": ("#3b7d3a", "D"),
    "scipy LSODA": ("#c9a227", "d"),
    "CVODE": ("#6b4fa0", "P"),
    "shooting": ("#c1272d", "*"),
    "time integration": ("#e8853d", "o"),  # to steady state
    "approximate": ("#6b4fa0", "P"),
    "linear": ("#808080", "x"),
    "one mass": ("#c1272d", "*"),
    "finite-duration contact": ("#e8853d", "o"),
    "grains": ("#1f4e79", "s"),
    "grains, softer": ("#4f87bd", "D"),
    OTHER_PACKING: ("#8fb4d9", "v"),
}


@dataclass(frozen=True, repr=False)
class Cost(Result):
    """Error and computing time of methods, or of models of granular beds.

    Attributes
    ----------
    scene : Scene
    motion : MotionStudy or None
        Methods for the motion; None for models of beds of grains, which are compared in steady state only.
    steady : SteadyStudy
        Methods for the steady state, or models of the beds.
    """

    scene: Scene
    motion: MotionStudy | None
    steady: SteadyStudy

    @property
    def points(self) -> tuple[tuple[str, Point], ...]:
        """Results of all methods and settings, each with the name of the computed quantity."""
        motion_points = () if self.motion is None else self.motion.points
        studies = (("motion, a period", motion_points), ("steady state", self.steady.points))
        return tuple((quantity, point) for quantity, points in studies for point in points)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return quantity, method, setting, CPU time, errors and event correctness of each point."""
        points = [point for _, point in self.points]
        return {
            "quantity": np.array([quantity for quantity, _ in self.points], dtype=str),
            "method": np.array([point.method for point in points], dtype=str),
            "setting": np.array([point.setting for point in points], dtype=str),
            "cpu_s": np.array([point.cpu for point in points]),
            "error": np.array([point.error for point in points]),
            "event_time_error_s": np.array([point.event_error for point in points]),
            "right": np.array([point.is_correct for point in points], dtype=bool),
        }

    def summary(self) -> str:
        """Summarize scene, frequency and number of methods."""
        methods = len({point.method for _, point in self.points})
        return f"{self.scene.name}: cost of {methods} methods at {self.steady.frequency:.6g} Hz"

    def __str__(self) -> str:
        """Return the tables that `rig cost` prints."""
        study = self.motion
        if study is None:
            return f"{self.scene.name}: models of its beds of grains\n\n{_steady_table(self.steady)}"
        rows = [("method", "setting", "ms per period", "relative error", "event time error / s", "events", "note")]
        for point in study.points:
            times = f"{point.event_error:.0e}" if np.isfinite(point.event_error) else ""
            events = ("right" if point.is_correct else "wrong") if np.isfinite(point.error) else "-"
            rows.append((*_cells(point), times, events, point.note))
        lines = [
            f"{study.scene.name}: first {study.periods} periods at {study.frequency:.6g} Hz, {study.events} events",
            *_compare_methods(study.points),
            "",
            *table_lines(rows, "<<>>><<"),
            "",
            f"Reference: {study.reference}",
            "",
            _steady_table(self.steady),
        ]
        return "\n".join(lines)

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw error against CPU time, for the motion or for models of beds."""
        draw_points(ax, (self.motion or self.steady).points, "CPU time / s")
        ax.set(ylabel="relative error")

    def write(self, folder: Path) -> list[Path]:
        """Write figure and table, cost-<scene>.png, .svg and .csv, into a folder; return the files.

        Raises
        ------
        SceneError
            If a file cannot be written.
        """
        rows: list[Sequence[str]] = [
            ("quantity", "method", "setting", "cpu_s", "error", "event_time_error_s", "right", "note")
        ]
        for quantity, p in self.points:
            numbers = (f"{value:.6g}" for value in (p.cpu, p.error, p.event_error))
            rows.append((quantity, p.method, p.setting, *numbers, str(p.is_correct).lower(), p.note))
        figure = _draw_models(self) if self.motion is None else _draw(self.motion, self.steady)
        return save_with_table(figure, folder / file_stem("cost", self.scene.name), rows)


def cost(scene: Scene, frequency: float | None, periods: int, report: Callable[[str], None] | None = None) -> Cost:
    """Measure error and CPU time of every method for a scene; with moving grains, of every model of the beds.

    The arguments are those of `rig.cost`, the frequency in Hz. Grains are simulated until their motion is steady.
    """
    report = report or (lambda text: None)
    if spheres_of(scene):
        # Imported here because LAMMPS is optional; scenes with single masses do not need it.
        from rig.studies.cost.bed_models import bed_models

        tone = default_frequency(scene, assemble(scene)) if frequency is None else frequency
        return Cost(scene, None, bed_models(scene, tone, report))
    motion = motion_study(scene, frequency, periods, report)
    return Cost(scene, motion, steady_study(scene, motion.frequency, report))


def _compare_methods(points: Sequence[Point]) -> list[str]:
    """Compare the engine with the fastest other method whose error is at most ten times the smallest error."""
    correct = [point for point in points if np.isfinite(point.error) and point.is_correct]
    engine = [point for point in correct if point.method == "engine, tone"]
    others = [point for point in correct if not point.method.startswith("engine")]
    if not engine:
        return []
    engine_point = min(engine, key=lambda point: point.cpu)
    lines = [
        f"The engine computes a period in {1e3 * engine_point.cpu:.2g} ms (relative error {engine_point.error:.0e})."
    ]
    if others:
        smallest_error = min(point.error for point in others)
        fastest = min((point for point in others if point.error <= 10.0 * smallest_error), key=lambda point: point.cpu)
        ratio = format_number(float(f"{fastest.cpu / engine_point.cpu:.2g}"))
        lines.append(
            f"The fastest of the most accurate other methods, {fastest.method} ({fastest.setting}), takes "
            f"{1e3 * fastest.cpu:.2g} ms, {ratio} times as long as the engine (relative error {fastest.error:.0e})."
        )
    wrong = sum(np.isfinite(point.error) and not point.is_correct for point in points)
    if wrong:
        lines.append(f"The order of events is wrong in {wrong} of {len(points)} results.")
    return lines


def _steady_table(steady: SteadyStudy) -> str:
    rows = [("method", "setting", "total ms", "relative error", "note")]
    rows += [(*_cells(point), point.note) for point in steady.points]
    table = [*table_lines(rows, "<<>><"), ""] if steady.points else []
    return "\n".join([_steady_title(steady), *table, f"Reference: {steady.reference}"])


def _steady_title(steady: SteadyStudy) -> str:
    kinds = steady.motion_type.split("/")
    prefix = "type " if set(kinds) <= {"I", "II", "III"} else ""
    motion = f": {prefix}{steady.motion_type}" if steady.motion_type else ""
    return f"Steady state at {steady.frequency:.4g} Hz{motion}"


def _cells(point: Point) -> tuple[str, str, str, str]:
    """Return method, setting, CPU time in ms and relative error of a point; "-" without a result."""
    has_result = np.isfinite(point.error)
    cost_and_error = (f"{1e3 * point.cpu:.4g}", f"{point.error:.0e}") if has_result else ("-", "-")
    return point.method, point.setting, *cost_and_error


def _draw(study: MotionStudy, steady: SteadyStudy) -> Figure:
    import llvmlite.binding

    count = 1 + bool(steady.points)
    with new_figure(5.2, 10.0 if steady.points else 6.8) as figure:
        panels = figure.subplots(1, count, squeeze=False, width_ratios=(1.5, 1.0)[:count])[0]
        draw_points(panels[0], study.points, "CPU time for a period of the drive / s")
        title = f"Motion: {study.periods} periods at {study.frequency:.4g} Hz, {study.events} events"
        panels[0].set(ylabel="error of the displacement, relative", title=title)
        if steady.points:
            draw_points(panels[1], steady.points, "total CPU time / s")
            panels[1].set(ylabel="error of the compliance, relative", title=_steady_title(steady))
        level = "" if study.scene.test is None else study.scene.test.level_text(study.scene.driven_shaker)
        processor = f"CPU times on one core (processor {llvmlite.binding.get_host_cpu_name()})"
        add_page_title(figure, f"Cost of accuracy: {study.scene.name}", ", ".join(filter(None, [level, processor])))
        add_caption(
            figure, "Errors relative to the largest displacement or compliance; 1 is 100 %. Reference: a motion with "
            f"{DIGITS} decimal digits. As called: with setup; warm: without. Guard pause: no event detection after "
            "separations. Penalty: stiff springs as walls. Linear: without dampers, or with dampers at rest. "
            "Approximate: theory of Inoue et al.",
        )  # fmt: skip
        return figure


def _draw_models(cost: Cost) -> Figure:
    with new_figure(5.2, 6.8) as figure:
        axes = figure.subplots()
        draw_points(axes, cost.steady.points, "total CPU time / s")
        label = "relative deviation of the compliance from the grain simulation"
        axes.set(ylabel=label, title=_steady_title(cost.steady))
        for point in cost.steady.points:
            if not np.isfinite(point.error):
                continue
            if point.method == OTHER_PACKING:
                axes.axhline(_drawn_error(point), color=STYLE_OF_METHOD[point.method][0], ls="--", lw=1.0)
            axes.annotate(
                point.setting, (point.cpu, _drawn_error(point)), xytext=(8, -3), textcoords="offset points", fontsize=7
            )
        # Leave space for the labels at the right end.
        axes.margins(x=0.25)
        add_page_title(figure, f"{cost.scene.name}: models of its beds of grains")
        return figure


def _drawn_error(point: Point) -> float:
    """Return the error as drawn on the logarithmic axis."""
    return max(point.error, 1e-17)


def draw_points(axes: Axes, points: tuple[Point, ...], label: str) -> None:
    """Draw error against CPU time, both logarithmic, with a color and marker for each method."""
    methods = list(dict.fromkeys(point.method for point in points))
    for method in methods:
        method_points = [point for point in points if point.method == method and np.isfinite(point.error)]
        if not method_points:
            continue
        color, marker = STYLE_OF_METHOD[method]
        # A line connects the settings that differ in one parameter only. "as called" includes setup, "warm" does not;
        # see `motion_study`.
        labeled = (SHORT_STEP_SETTING, "as called", "warm")
        connected = [point for point in method_points if point.setting not in labeled]
        errors = [_drawn_error(point) for point in connected]
        axes.plot([point.cpu for point in connected], errors, "-", color=color, lw=1.0, alpha=0.6)
        for point in method_points:
            marker_size, order = (12, 4) if marker == "*" else (6, 3)
            face = color if point.is_correct else "white"
            axes.plot(
                point.cpu, _drawn_error(point), marker, color=color, ms=marker_size, zorder=order, mfc=face, mew=1.3
            )
            if point.setting in labeled:
                text = "guard pause" if point.setting == SHORT_STEP_SETTING else point.setting
                axes.annotate(
                    text, (point.cpu, _drawn_error(point)), xytext=(0, -14), textcoords="offset points", fontsize=7,
                    color=color, ha="center",
                )  # fmt: skip
        axes.plot([], [], marker + "-", color=color, ms=7, lw=1.0, label=method)
    if any(not point.is_correct and np.isfinite(point.error) and point.method != "linear" for point in points):
        axes.plot([], [], "o", color="#555555", mfc="white", mew=1.3, ms=6, label="wrong events")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(label)
    axes.margins(y=0.1)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(power_label)
    if methods:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3)
