"""The cost of the measurement chain as a figure, a table and a file."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.chain_cost.study import ChainStudy, Measurement
from analysis.chain_cost.variants import GROUPS, own_setting
from analysis.figures.style import drawing, save
from rig.errors import RunError
from rig.escaping import drawn
from rig.output_files import stem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: From the first setting of a group to the last: light to dark, of one hue.
SHADES = ("#9ecae1", "#6baed6", "#4292c6", "#2171b5", "#08519c", "#08306b")
MARKERS = ("o", "s", "^", "v", "D", "P")
OWN, QUIET = "#c1272d", "#e8853d"


def table(study: ChainStudy) -> str:
    """Write a study as text."""
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

    Parameters
    ----------
    folder : Path
        Made if it does not exist.

    Raises
    ------
    RunError
        If a file cannot be written.
    """
    name = folder / stem("chain-cost", study.scene.name)
    with drawing(6.4, 10.5) as figure:
        panels = figure.subplots(2, 3, sharex=True, sharey=True)
        for axes, group in zip(panels.flat, GROUPS, strict=True):
            _panel(axes, study, group)
        for axes in panels[-1]:
            axes.set_xlabel("CPU time for a second of the test, ms")
        for axes in panels[:, 0]:
            axes.set_ylabel("error, relative")
        figure.suptitle(drawn(study.scene.name))
        handles, labels = panels[0, 0].get_legend_handles_labels()
        common = [(h, t) for h, t in zip(handles, labels, strict=True) if t in _COMMON]
        figure.legend(*zip(*common, strict=True), loc="outside lower center", ncols=len(common), fontsize=8.5)
        files = save(figure, name)
    path = name.with_name(name.name + ".csv")
    try:
        _write_csv(study, path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror})") from None
    return [*files, path]


_COMMON = (
    "the scene as it is",
    "without noise, counts, tolerances, bias",
    "compliance, corrected by the data sheets",
    "displacement, not corrected",
)


def _panel(axes: Axes, study: ChainStudy, group: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.margins(y=0.12)
    points = [p for p in study.points if p.group == group and np.isfinite(p.error)]
    for marker, colour, point, label in (
        ("*", OWN, study.own, _COMMON[0]),
        ("*", QUIET, study.quiet, _COMMON[1]),
    ):
        axes.plot(*_place(point), marker, color=colour, ms=11, zorder=4, mec="white", mew=0.6)
        axes.plot([], [], marker, color=colour, ms=10, label=label)
    axes.plot([], [], "o", color="#555555", ms=5.5, label=_COMMON[2])
    axes.plot([], [], "o", color="#555555", mfc="white", ms=5.5, label=_COMMON[3])
    axes.axhline(study.own.error, color=OWN, lw=0.8, ls="--", zorder=1)
    own_handles = []
    for k, point in enumerate(points):
        colour = SHADES[k + len(SHADES) - max(len(points), 1)] if len(points) <= len(SHADES) else SHADES[-1]
        marker = MARKERS[k % len(MARKERS)]
        x, y = _place(point)
        axes.plot([x, x], [y, point.corrected], "-", color=colour, lw=0.7, alpha=0.6)
        axes.plot(x, point.corrected, marker, color=colour, mfc="white", ms=5)
        own_handles += axes.plot(x, y, marker, color=colour, ms=6, zorder=3, label=point.setting)
    own = own_setting(study.scene, group)
    axes.set_title(f"{group} (the scene: {own})" if own else group)
    failed = [p.setting for p in study.points if p.group == group and not np.isfinite(p.error)]
    if failed:
        axes.annotate(
            f"cannot be measured: {', '.join(failed)}", (0.03, 0.02), xycoords="axes fraction", fontsize=7
        )
    if own_handles:
        axes.legend(
            handles=own_handles, fontsize=7.5, loc="upper right", labelspacing=0.3, handletextpad=0.2,
            frameon=True, framealpha=0.85, edgecolor="none",
        )  # fmt: skip
    _time_axis(axes, [_place(p)[0] for p in (study.own, study.quiet, *study.points) if np.isfinite(p.error)])


def _time_axis(axes: Axes, times: list[float]) -> None:
    """Logarithmic axis, wide enough for differences to look as large as they are, with room for the legend."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    axes.set_xlim(min(times) / 1.6, max(max(times) * 1.3, min(times) * 3.0) * 1.8)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))


def _place(point: Measurement) -> tuple[float, float]:
    return 1e3 * point.cpu / point.duration, max(point.error, 1e-17)


def _write_csv(study: ChainStudy, path: Path) -> None:
    header = ["changed", "to", "cpu_s", "test_s", "error", "corrected_for", "note"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for p in (study.own, study.quiet, *study.points):
            numbers = [f"{value:.6g}" for value in (p.cpu, p.duration, p.error, p.corrected)]
            writer.writerow([p.group or "the scene", p.setting, *numbers, p.note])
