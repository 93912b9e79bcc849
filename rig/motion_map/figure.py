"""The map of the motion as a figure, a file and a summary."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rig.engine.trajectory import Array
from rig.escaping import drawn
from rig.motion_map.motion_map import KINDS, MotionMap
from rig.output_files import write_study
from rig.system.open_loop_drive import level_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: From tame to wild: grey, three blues to green for the paper's types, warm colours for the rest.
COLOURS = ("#e4e4e4", "#a6cee3", "#3f8fc4", "#1b4f7e", "#f2c14e", "#e07b39", "#8c1c3a")
LEGEND = ("riding", "Type I", "Type II", "Type III", *KINDS[4:])


def summary(map_: MotionMap) -> str:
    """Say how much of the map each kind of motion takes, and what it costs."""
    rows, points = map_.kind.shape
    lines = [
        f"{map_.scene.name}: {rows} x {points} steady motions, {map_.over} {map_.value[0]:.3g} to "
        f"{map_.value[-1]:.3g} {map_.unit}, {map_.frequency[0]:.4g} to {map_.frequency[-1]:.4g} Hz",
        "",
        f"{'wildest damper':20}{'share':>7}{'impacts a period':>18}{'us a period':>13}{'ms to steady state':>20}",
    ]
    for number, kind in enumerate(KINDS):
        own = map_.kind == number
        if own.any():
            lines.append(
                f"{kind:20}{own.mean():7.1%}{map_.impacts[own].mean():18.3g}"
                f"{1e6 * map_.cpu[own].sum() / map_.periods[own].sum():13.3g}{1e3 * np.median(map_.cpu[own]):20.3g}"
            )
    lines += ["", f"CPU time in all: {map_.cpu.sum():.3g} s"]
    return "\n".join(lines)


def write(map_: MotionMap, folder: Path) -> list[Path]:
    """Write map-<scene> or map-clearance-<scene>, as .png, .svg and .csv, into a folder.

    Parameters
    ----------
    folder : Path
        Made if it does not exist.

    Raises
    ------
    SceneError
        If a file cannot be written.
    """
    study = "map-clearance" if map_.over == "clearance" else "map"
    return write_study(study, map_.scene.name, folder, _draw(map_), lambda path: _write_csv(map_, path))


def _write_csv(map_: MotionMap, path: Path) -> None:
    dampers = range(1, map_.motion[0, 0].count("/") + 2)
    header = [
        f"{map_.over}_{map_.unit.lower()}", "frequency_hz", "kind", *(f"damper{k}_motion" for k in dampers),
        "impacts_per_period", "repetition_periods", "periods_followed", "cpu_s", "cpu_us_per_period",
    ]  # fmt: skip
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for i, value in enumerate(map_.value):
            for k, frequency in enumerate(map_.frequency):
                cpu, periods = map_.cpu[i, k], map_.periods[i, k]
                numbers = (value, frequency), (cpu, 1e6 * cpu / periods)
                writer.writerow(
                    [f"{number:.9g}" for number in numbers[0]]
                    + [KINDS[map_.kind[i, k]], *map_.motion[i, k].split("/")]
                    + [f"{map_.impacts[i, k]:.6g}", map_.repetition[i, k], periods]
                    + [f"{number:.4g}" for number in numbers[1]]
                )


def _draw(map_: MotionMap) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap, LogNorm
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    figure = Figure(figsize=(11.0, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharey=True)
    borders = edges(map_.frequency, False), edges(map_.value, True)
    left.pcolormesh(
        *borders, map_.kind, cmap=ListedColormap(COLOURS), vmin=-0.5, vmax=len(KINDS) - 0.5, rasterized=True
    )
    milliseconds = 1e3 * map_.cpu
    mesh = right.pcolormesh(
        *borders, milliseconds, cmap="viridis", norm=LogNorm(*np.percentile(milliseconds, [1, 99.5])), rasterized=True
    )  # fmt: skip
    bar = figure.colorbar(mesh, ax=right, label="CPU time to the steady state, ms", extend="both", pad=0.02)
    bar.locator = LogLocator(subs=(1.0, 2.0, 5.0))
    bar.formatter = StrMethodFormatter("{x:g}")
    bar.minorlocator = NullLocator()
    own = _own(map_)
    for axes in (left, right):
        _dress(axes, map_, own, borders)
    label = "clearance, mm" if map_.over == "clearance" else f"{map_.over}, {map_.unit}"
    left.set_ylabel(label)
    left.set_title("steady motion of the damper that moves most wildly", fontsize=10)
    right.set_title("where it gets hard", fontsize=10)
    present = sorted(set(map_.kind.ravel()))
    handles: list[Patch | Line2D] = [Patch(color=COLOURS[k], label=LEGEND[k]) for k in present]
    if map_.over != "clearance":
        handles.append(Line2D([], [], color="black", lw=1.2, label="acceleration of 1 g, all dampers riding"))
    if own is not None:
        handles.append(Line2D([], [], color="black", lw=1.0, ls="--", label="the scene's own"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    figure.suptitle(drawn(map_.scene.name))
    return figure


def _own(map_: MotionMap) -> float | None:
    """Give the scene's own value, if it lies on the map and there is only one."""
    if map_.over == "clearance":
        found = {d.clearance for d in map_.scene.dampers if not d.locked and d.clearance > 0.0}
        value = found.pop() if len(found) == 1 else np.inf
    else:
        value = level_of(map_.scene)
    return value if map_.value[0] <= value <= map_.value[-1] else None


def edges(centres: Array, logarithmic: bool) -> Array:
    """Borders of cells around their centres."""
    at = np.log(centres) if logarithmic else centres
    if len(at) == 1:
        borders = np.array([at[0] - 0.05 * abs(at[0]) - 1e-9, at[0] + 0.05 * abs(at[0]) + 1e-9])
    else:
        middle = 0.5 * (at[1:] + at[:-1])
        borders = np.concatenate([[2 * at[0] - middle[0]], middle, [2 * at[-1] - middle[-1]]])
    return np.exp(borders) if logarithmic else borders


def _dress(axes: Axes, map_: MotionMap, own: float | None, borders: tuple[Array, Array]) -> None:
    axes.set_yscale("log")
    axes.set_ylim(borders[1][0], borders[1][-1])
    axes.set_xlim(borders[0][0], borders[0][-1])
    axes.set_xlabel("frequency, Hz")
    if map_.over == "clearance":
        axes.yaxis.set_major_formatter(lambda value, _: f"{1e3 * value:g}")
    else:
        axes.yaxis.set_major_formatter("{x:g}")
        axes.plot(map_.frequency, map_.take_off, color="black", lw=1.2)
    if own is not None:
        axes.axhline(own, color="black", lw=1.0, ls="--")
