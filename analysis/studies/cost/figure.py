"""Output of `analysis cost`: figure and table of measurement error and computing time for each variant of the chain."""

from pathlib import Path

import numpy as np

from analysis.studies.cost.study import ChainStudy, Measurement
from analysis.studies.cost.variants import GROUPS, scene_setting
from rig.core.base.escaping import escape_figure
from rig.core.base.figure_style import COLORS, add_page_title, new_figure, save_with_table
from rig.core.base.figure_types import Figure
from rig.core.base.output_files import file_stem
from rig.core.results.text import table_lines
from rig.core.scene.scene import Scene

SCENE_COLOR = COLORS[1]
CHANGED_COLOR = COLORS[0]
UNCORRECTED_COLOR = "#a0a0a0"


def table(study: ChainStudy) -> str:
    """Return a study as text: error of the unchanged scene, largest error of the variants, all measurements."""
    frequencies = ", ".join(f"{frequency:g}" for frequency in study.frequency)
    variants = [point for group in GROUPS for point in study.points if point.group == group]
    scene = study.unchanged
    summary = (
        f"The unchanged scene: relative error of the compliance {scene.error:.0e}, {_milliseconds(scene)} ms of CPU "
        "time per second of test."
    )
    measured = [point for point in variants if np.isfinite(point.error)]
    if measured:
        worst = max(measured, key=lambda point: point.error)
        summary += f" Largest error with one part changed: {worst.error:.0e} ({worst.group}: {worst.setting})."
    rows: list[tuple[str, ...]] = [("part", "setting", "CPU ms per s", "error", "uncorrected error", "note")]
    rows += [_row(point) for point in (study.unchanged, study.without_noise, *variants)]
    return "\n".join(
        [
            f"{study.scene.name}: compliance measured at {frequencies} Hz",
            summary,
            "",
            *table_lines(rows, "<<>>><"),
            "",
            "CPU ms per s: CPU time to record and analyze a second of test. Error: relative error of the compliance",
            "after correction with the data sheets. Uncorrected error: of the displacement, without this correction.",
            "Parts are changed without noise, quantization, tolerances and bias, because no data sheet corrects these.",
            f"Reference: {study.reference}.",
        ]
    )


def _milliseconds(point: Measurement) -> str:
    """Format the CPU time per second of test [ms]."""
    return f"{1e3 * point.cpu / point.duration:.3g}"


def _row(point: Measurement) -> tuple[str, ...]:
    variant = point.group or "the scene", point.setting
    if np.isnan(point.error):
        return *variant, "-", "-", "-", f"failed: {point.note}"
    return *variant, _milliseconds(point), f"{point.error:.0e}", f"{point.correction:.0e}", point.note


def write(study: ChainStudy, folder: Path) -> list[Path]:
    """Write chain-cost-<scene>.png, .svg and .csv into a folder, which is created if it does not exist."""
    name = folder / file_stem("chain-cost", study.scene.name)
    rows = [["changed", "to", "cpu_s", "test_s", "error", "corrected_for", "note"]]
    for point in (study.unchanged, study.without_noise, *study.points):
        numbers = [f"{value:.6g}" for value in (point.cpu, point.duration, point.error, point.correction)]
        rows.append([point.group or "the scene", point.setting, *numbers, point.note])
    return save_with_table(_draw(study), name, rows)


def output_files(scene: Scene, folder: Path) -> list[Path]:
    """Return the paths of the files of a study."""
    name = file_stem("chain-cost", scene.name)
    return [folder / f"{name}.{ending}" for ending in ("png", "svg", "csv")]


def _draw(study: ChainStudy) -> Figure:
    """Draw a row for each variant of the chain: measurement error and computing time."""
    groups = [(group, [p for p in study.points if p.group == group]) for group in GROUPS]
    rows = [
        ("the scene as it is", study.unchanged, SCENE_COLOR),
        ("without noise, quantization, tolerances, bias", study.without_noise, SCENE_COLOR),
    ]
    for group, points in groups:
        unchanged_setting = scene_setting(study.scene, group)
        rows += [
            (f"{group}: {p.setting}{' (the scene)' * (p.setting == unchanged_setting)}", p, CHANGED_COLOR)
            for p in points
        ]
    position = np.arange(len(rows), dtype=float)
    position[2:] += np.repeat(0.7 * np.arange(1, len(groups) + 1), [len(points) for _, points in groups])
    with new_figure(0.9 + 0.19 * position[-1], 9.0) as figure:
        error_axes, cost_axes = figure.subplots(1, 2, sharey=True, width_ratios=(2.2, 1.0))
        for y, (_, point, shade) in zip(position, rows, strict=True):
            if np.isfinite(point.error):
                error, uncorrected = max(point.error, 1e-17), max(point.correction, 1e-17)
                error_axes.plot([error, uncorrected], [y, y], color=UNCORRECTED_COLOR, lw=0.8, zorder=1)
                error_axes.plot(uncorrected, y, "o", color=UNCORRECTED_COLOR, mfc="white", ms=4.5)
                error_axes.plot(error, y, "o", color=shade, ms=6)
                cost_axes.barh(y, 1e3 * point.cpu / point.duration, 0.6, color=shade)
            else:
                error_axes.annotate("cannot be measured", (0.02, y), xycoords=("axes fraction", "data"), va="center",
                              fontsize=7.5, color="#666666")  # fmt: skip
        error_axes.axvline(study.unchanged.error, color=SCENE_COLOR, lw=0.8, ls="--", zorder=0)
        error_axes.set(xscale="log", xlabel="error, relative")
        error_axes.set_yticks(position, [escape_figure(text) for text, *_ in rows])
        error_axes.set_ylim(position[-1] + 0.8, -0.8)
        cost_axes.set_xlabel("CPU time / (ms per s of test)")
        for axes in (error_axes, cost_axes):
            axes.grid(False, axis="y")
            axes.tick_params(axis="y", length=0)
        error_axes.plot([], [], "o", color=CHANGED_COLOR, ms=6, label="compliance, corrected by the data sheets")
        error_axes.plot([], [], "o", color=UNCORRECTED_COLOR, mfc="white", ms=4.5, label="displacement, not corrected")
        error_axes.plot([], [], "--", color=SCENE_COLOR, lw=0.8, label="the scene as it is")
        figure.legend(loc="outside lower center", ncols=3)
        add_page_title(figure, study.scene.name)
        return figure
