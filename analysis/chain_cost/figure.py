"""Output of the chain cost study: figure and table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.chain_cost.study import ChainStudy, Measurement
from analysis.chain_cost.variants import GROUPS, own_setting
from rig.escaping import escape_figure
from rig.figure_style import COLORS, new_figure, save_with_table
from rig.output_files import file_stem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rig.scene.scene import Scene

OWN, REST, FAINT = COLORS[1], COLORS[0], "#a0a0a0"


def table(study: ChainStudy) -> str:
    """Format a study as a text table."""
    frequencies = ", ".join(f"{frequency:g}" for frequency in study.frequency)
    lines = [
        f"{study.scene.name}: compliance measured at {frequencies} Hz",
        "",
        f"{'changed':20}{'to':26}{'ms a second':>12}{'error':>9}{'corrected for':>15}",
        _line(study.own),
        _line(study.quiet),
    ]
    lines += [_line(point) for group in GROUPS for point in study.points if point.group == group]
    lines += [
        "",
        "ms a second: CPU time to record and analyse a second of the test. error: of the compliance, corrected by the",
        "data sheets, relative. corrected for: the error of a displacement without that. One thing is changed at a",
        "time in the scene without what no data sheet can correct: noise, counts, sensors' tolerances and bias.",
        f"reference: {study.reference}",
    ]
    return "\n".join(line.rstrip() for line in lines)


def _line(point: Measurement) -> str:
    start = f"{point.group or 'the scene':20}{point.setting:26}"
    if np.isnan(point.error):
        return f"{start}  failed: {point.note}"
    return f"{start}{1e3 * point.cpu / point.duration:12.4g}{point.error:9.0e}{point.corrected:15.0e}  {point.note}"


def write(study: ChainStudy, folder: Path) -> list[Path]:
    """Write chain-cost-<scene>.png, .svg and .csv into a folder.

    `folder`: created if it does not exist. Raises `SceneError`, `RunError` if a file cannot be written.
    """
    name = folder / file_stem("chain-cost", study.scene.name)
    rows = [["changed", "to", "cpu_s", "test_s", "error", "corrected_for", "note"]]
    for p in (study.own, study.quiet, *study.points):
        numbers = [f"{value:.6g}" for value in (p.cpu, p.duration, p.error, p.corrected)]
        rows.append([p.group or "the scene", p.setting, *numbers, p.note])
    return save_with_table(_draw(study), name, rows)


def output_files(scene: Scene, folder: Path) -> list[Path]:
    """Return the paths of the files of a study."""
    name = file_stem("chain-cost", scene.name)
    return [folder / f"{name}.{ending}" for ending in ("png", "svg", "csv")]


def _draw(study: ChainStudy) -> Figure:
    """Draw a row for each changed part of the chain: measurement error and computing time."""
    groups = [(group, [p for p in study.points if p.group == group]) for group in GROUPS]
    rows = [
        ("the scene as it is", study.own, OWN),
        ("without noise, counts, tolerances, bias", study.quiet, OWN),
    ]
    for group, points in groups:
        own = own_setting(study.scene, group)
        rows += [(f"{group}: {p.setting}{' (the scene)' * (p.setting == own)}", p, REST) for p in points]
    place = np.arange(len(rows), dtype=float)
    place[2:] += np.repeat(0.7 * np.arange(1, len(groups) + 1), [len(points) for _, points in groups])
    with new_figure(0.9 + 0.19 * place[-1], 9.0) as figure:
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=(2.2, 1.0))
        for y, (_, point, shade) in zip(place, rows, strict=True):
            if np.isfinite(point.error):
                error, raw = max(point.error, 1e-17), max(point.corrected, 1e-17)
                left.plot([error, raw], [y, y], color=FAINT, lw=0.8, zorder=1)
                left.plot(raw, y, "o", color=FAINT, mfc="white", ms=4.5)
                left.plot(error, y, "o", color=shade, ms=6)
                right.barh(y, 1e3 * point.cpu / point.duration, 0.6, color=shade)
            else:
                left.annotate("cannot be measured", (0.02, y), xycoords=("axes fraction", "data"), va="center",
                              fontsize=7.5, color="#666666")  # fmt: skip
        left.axvline(study.own.error, color=OWN, lw=0.8, ls="--", zorder=0)
        left.set(xscale="log", xlabel="error, relative")
        left.set_yticks(place, [escape_figure(text) for text, *_ in rows])
        left.set_ylim(place[-1] + 0.8, -0.8)
        right.set_xlabel("CPU time / (ms per s of test)")
        for axes in (left, right):
            axes.grid(False, axis="y")
            axes.tick_params(axis="y", length=0)
        left.plot([], [], "o", color=REST, ms=6, label="compliance, corrected by the data sheets")
        left.plot([], [], "o", color=FAINT, mfc="white", ms=4.5, label="displacement, not corrected")
        left.plot([], [], "--", color=OWN, lw=0.8, label="the scene as it is")
        figure.legend(loc="outside lower center", ncols=3)
        figure.suptitle(escape_figure(study.scene.name))
        return figure
