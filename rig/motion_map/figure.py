"""Output of a motion map: figure, table and summary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rig.escaping import escape_figure
from rig.figure_style import new_figure, save_with_table, set_log_scale
from rig.motion_map.motion_map import COLOURS, KINDS, LEGEND, TOLERANCE, MotionMap
from rig.output_files import file_stem
from rig.scene.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def summary(map_: MotionMap) -> str:
    """Summarize the share of each motion type in the map, and the computing time."""
    rows, points = map_.kind.shape
    lines = [
        f"{map_.scene.name}: {rows} x {points} steady motions, {map_.over} {map_.value[0]:.3g} to "
        f"{map_.value[-1]:.3g} {map_.unit}, {map_.frequency[0]:.4g} to {map_.frequency[-1]:.4g} Hz",
        "",
        f"{'most active damper':20}{'share':>7}{'impacts a period':>18}{'CPU us a period':>17}{'CPU ms a motion':>17}",
    ]
    for number, kind in enumerate(KINDS):
        own = map_.kind == number
        if own.any():
            lines.append(
                f"{kind:20}{own.mean():7.1%}{map_.impacts[own].mean():18.3g}"
                f"{1e6 * map_.cpu[own].sum() / map_.periods[own].sum():17.3g}{1e3 * np.median(map_.cpu[own]):17.3g}"
            )
    lines += [
        "",
        (
            "CPU us, ms: time to compute one period, and all periods until the motion is steady within "
            f"{TOLERANCE:.0e} or irregular,\nstarting from the previous frequency; not a time on a bench"
        ),
        f"CPU time in all: {map_.cpu.sum():.3g} s",
    ]
    return "\n".join(lines)


def write(map_: MotionMap, folder: Path) -> list[Path]:
    """Write map-<scene> or map-clearance-<scene>, as .png, .svg and .csv, into a folder.

    `folder`: created if it does not exist. Raises `SceneError` if a file cannot be written.
    """
    table = map_.columns()
    rows: list[list[object]] = [[name.lower() for name in table]]
    for row in zip(*table.values(), strict=True):
        rows.append([f"{cell:.9g}" if isinstance(cell, float) else cell for cell in row])
    return save_with_table(_draw(map_), place(map_.scene, map_.over, folder), rows)


def place(scene: Scene, over: str, folder: Path) -> Path:
    """Return the path of a map's files without their suffix."""
    return folder / file_stem("map-clearance" if over == "clearance" else "map", scene.name)


def _draw(map_: MotionMap) -> Figure:
    from matplotlib.colors import LogNorm
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    with new_figure(4.6, 10.0) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        map_.draw(left)
        low, high = map_.periods.min(), max(map_.periods.max(), map_.periods.min() + 1)
        mesh = right.pcolormesh(
            *map_.borders, map_.periods, cmap="viridis", norm=LogNorm(low, high), rasterized=True
        )
        bar = figure.colorbar(mesh, ax=right, label="periods computed until steady or irregular", pad=0.02)
        set_log_scale(bar.ax.yaxis)
        map_.dress(right)
        right.set_ylabel("")
        left.set_title("What the damper does that moves most wildly")
        right.set_title("Computing time of the motion, not of a test")
        present = sorted(set(map_.kind.ravel()))
        handles: list[Patch | Line2D] = [Patch(color=COLOURS[k], label=LEGEND[k]) for k in present]
        if map_.over != "clearance":
            handles.append(Line2D([], [], color="black", lw=1.2, label="riding at 1 g: above, dampers fly"))
        if map_.own_value is not None:
            handles.append(Line2D([], [], color="black", lw=1.0, ls="--", label=f"{map_.over} of the scene"))
        figure.legend(handles=handles, loc="outside lower center", ncols=5)
        figure.suptitle(escape_figure(map_.scene.name))
        return figure
