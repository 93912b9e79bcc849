"""Map of type of motion and settling time against level or clearance, and frequency."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array
from rig.core.base.figure_style import add_page_title, cell_edges, new_figure, save_with_table, set_log_scale
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.output_files import file_stem
from rig.core.base.palette import MOTIONS, contrast
from rig.core.base.progress import CountProgress
from rig.core.base.study import Study, digest
from rig.core.results import Result, format_percent
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import FREQUENCY, positive_values
from rig.core.steady_response.frequency_response import SteadyContinuation
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import level_of, separation_levels, with_ideal_force
from rig.core.system.structural_model import structural_model
from rig.studies.motion_map.grid import select_frequencies, select_row_values, vertical_axis

if TYPE_CHECKING:
    import xarray

#: Types of motion in order of complexity; a point of the map has the most complex type of its dampers.
KINDS = ("riding", "I", "II", "III", "other, every period", "longer period", "irregular")
#: The type of motion is determined when the motion deviates from the steady state by at most this fraction.
STEADY_TOLERANCE = 1e-6
#: Longest wait, in decay times of the slowest mode to the tolerance; a motion without a cycle is irregular.
MAX_WAIT_DECAY_TIMES = 3.0
#: The limit of the wait is at least this number of periods; a smaller limit would save little time.
MIN_WAIT_LIMIT_PERIODS = 2000
#: The limit of the wait is at most this number of periods.
MAX_WAIT_LIMIT_PERIODS = 20_000
LEGEND = ("at rest", "Type I: lower wall", "Type II: both walls", "Type III: stays at the upper wall", *KINDS[4:])
#: Height and width of the name of a type of motion, relative to the map.
NAME_SIZE = 1 / 12, 1 / 5


@dataclass(frozen=True, repr=False)
class MotionMap(Result):
    """Steady-state motion over a grid of levels or clearances (rows), and frequencies.

    Attributes
    ----------
    scene : Scene
        Scene of the computation; a controlled force of its test acts directly on the body.
    over : {"force", "drive", "clearance"}
        Quantity of the rows.
    unit : str
        N, V or m.
    value : ndarray, shape (rows,)
        Level, or clearance of every damper.
    frequency : ndarray, shape (frequencies,)
        Hz, ascending; each motion is continued from the previous frequency of its row.
    kind : ndarray of int, shape (rows, frequencies)
        Index in `KINDS` of the most complex type of motion of the dampers and joints.
    motion : ndarray of str, shape (rows, frequencies)
        Type of motion of each damper, in order, then of each joint, joined by "/".
    impacts : ndarray, shape (rows, frequencies)
        Impacts of all dampers and joints per period.
    repetition : ndarray of int, shape (rows, frequencies)
        Periods of the drive in a cycle of the motion; 0 without a cycle.
    periods : ndarray of int, shape (rows, frequencies)
        Periods computed to reach steady state from the previous frequency; a test on the rig waits differently.
    cpu : ndarray, shape (rows, frequencies)
        CPU time [s]; excluded from tables and figures, so these do not depend on the machine.
    take_off : ndarray, shape (frequencies,)
        Level below which the motion is linear: all dampers rest. At this level the first damper starts to move
        in its body (1 g for a bed) or hits a wall, or the first joint closes or slips.
    """

    scene: Scene
    over: str
    unit: str
    value: Array
    frequency: Array
    kind: NDArray[np.int64]
    motion: NDArray[np.str_]
    impacts: Array
    repetition: NDArray[np.int64]
    periods: NDArray[np.int64]
    cpu: Array
    take_off: Array

    def summary(self) -> str:
        """Summarize the map, and the share of each type of motion."""
        shares = [(kind, (self.kind == index).mean()) for index, kind in enumerate(KINDS)]
        return (
            f"{self.scene.name}: {self.over} {self.value[0]:.3g} to {self.value[-1]:.3g} {self.unit}, "
            f"{self.frequency[0]:.4g} to {self.frequency[-1]:.4g} Hz; "
            f"{', '.join(f'{kind} {format_percent(share)}' for kind, share in shares if share)}"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return all points of the grid: location, type of motion, impacts, periods of a cycle, computed periods."""
        motions = np.array([each.split("/") for each in self.motion.ravel()]).T
        names = [f"damper{k}" for k in range(1, len(motions) - len(self.scene.joints) + 1)]
        names += [f"joint{k}" for k in range(1, len(self.scene.joints) + 1)]
        return {
            f"{self.over}_{self.unit}": np.repeat(self.value, self.frequency.size),
            "frequency_Hz": np.tile(self.frequency, self.value.size),
            "kind": np.array(KINDS)[self.kind.ravel()],
            **{f"{name}_motion": row for name, row in zip(names, motions, strict=True)},
            "impacts_per_period": self.impacts.ravel(),
            "repetition_periods": self.repetition.ravel(),
            "periods_followed": self.periods.ravel(),
        }

    def to_xarray(self) -> xarray.Dataset:
        """Return the columns as an xarray data set over both axes."""
        return self.to_dataframe().set_index("frequency_Hz", append=True).to_xarray()

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the type of motion against level or clearance, and frequency."""
        from matplotlib.colors import ListedColormap

        mesh_style: dict[str, Any] = {
            "cmap": ListedColormap(MOTIONS),
            "vmin": -0.5,
            "vmax": len(KINDS) - 0.5,
            "rasterized": True,
        }
        ax.pcolormesh(*self.borders, self.kind, **mesh_style | style)
        for kind in sorted(set(self.kind.ravel())):
            ax.plot([], [], "s", color=MOTIONS[kind], label=LEGEND[kind])
            self._write_name(ax, int(kind))
        self.draw_axes(ax)

    def _write_name(self, ax: Axes, kind: int) -> None:
        """Write the name of a type of motion into the widest part of its region, if it fits."""
        region = self.kind == kind
        name_cells = [max(1, round(part * cells)) for part, cells in zip(NAME_SIZE, region.shape, strict=True)]
        depth = scipy.ndimage.distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1]
        depth = depth * scipy.ndimage.binary_erosion(region, np.ones(name_cells))
        row, column = np.unravel_index(depth.argmax(), depth.shape)
        if depth[row, column] > 0.0:
            color = max(("#ffffff", "#000000"), key=lambda text: contrast(text, MOTIONS[kind]))
            name = LEGEND[kind].partition(":")[0]
            position = float(self.frequency[column]), float(self.value[row])
            ax.text(*position, name, color=color, ha="center", va="center", fontsize=9)

    @property
    def borders(self) -> tuple[Array, Array]:
        """Compute the edges of the cells along frequency and along level or clearance."""
        return cell_edges(self.frequency, False), cell_edges(self.value, True)

    @property
    def own_value(self) -> float | None:
        """Return the level or clearance of the scene, if it is unique and within the map."""
        if self.over == "clearance":
            clearances = {d.clearance for d in self.scene.dampers if d.impacts}
            value = clearances.pop() if len(clearances) == 1 else np.inf
        else:
            value = level_of(self.scene)
        return value if self.value[0] <= value <= self.value[-1] else None

    @property
    def settling_time(self) -> Array:
        """Return the time to reach steady state from the motion at the previous frequency [s]; NaN without a cycle.

        The time is a multiple of the interval between checks of the computation. On the rig, the wait begins at a
        different motion.
        """
        return np.where(self.repetition > 0, self.periods / self.frequency, np.nan)

    def draw_axes(self, ax: Axes) -> None:
        """Label the axes; draw the separation level, and the level or clearance of the scene."""
        from matplotlib.patheffects import withStroke

        (lowest_hz, *_, highest_hz), (lowest_value, *_, highest_value) = self.borders
        ax.grid(False)
        ax.set(xlim=(lowest_hz, highest_hz), xlabel="frequency / Hz")
        in_millimeters = self.unit == "m"
        set_log_scale(ax.yaxis, factor=1e3 if in_millimeters else 1.0)
        ax.set(
            ylim=(lowest_value, highest_value),
            ylabel=f"{self.over} / {'mm' if in_millimeters else self.unit.replace('^2', '²')}",
        )
        # A white border makes a line visible on dark cells.
        border: Any = {"path_effects": [withStroke(linewidth=2.8, foreground="white")]}
        if self.over != "clearance":
            ax.plot(self.frequency, self.take_off, color="black", lw=1.2, **border)
        scene_value = self.own_value
        if scene_value is not None:
            ax.axhline(scene_value, color="black", lw=1.0, ls="--", **border)


def map_motion(
    scene: SceneLike,
    over: str | None = None,
    values: ArrayLike | None = None,
    frequencies: ArrayLike | None = None,
    progress: CountProgress | None = None,
    cluster: str | None = None,
    table_path: Path | None = None,
) -> MotionMap:
    """Compute the steady-state motion over a grid of levels or clearances, and frequencies.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`. If its test controls the amplitude of the spring force, that force acts
        on the body as a pure sinusoid; a drive level is applied through the shaker.
    over : {"force", "drive", "clearance"}, optional
        Second parameter in addition to the frequency; None: the level of the test. A clearance applies to every
        damper that is not locked, at the level of the test.
    values : array_like, shape (rows,), optional
        Levels [N, or the drive's unit] or clearances [m], or strings with units; None: a range that includes
        take-off or ceiling contact, and the scene's own value.
    frequencies : array_like, shape (frequencies,), optional
        Hz, or strings with units; None: the test's range, with a finer spacing near the natural frequencies.
    progress : callable, optional
        Called with the number of points done and the total.
    cluster : str, optional
        As for `rig.design`.
    table_path : Path, optional
        CSV file to which each finished row is added; rows of the same map in this file are not recomputed.

    Returns
    -------
    MotionMap
        Type of motion, response and settling time of each point.

    Raises
    ------
    RunError
        If that file cannot be read or written.
    SceneError
        If the scene is linear, has no shaker or no level, a bed of grains, or a value that is not positive.
    """
    scene = scene_of(scene)
    over, kind = vertical_axis(scene, over)
    # Checked here, because worker processes take seconds to start.
    assemble(scene).reject_grains()
    scene = with_ideal_force(scene)
    requested = frequencies if frequencies is not None else select_frequencies(scene)
    frequency = np.unique(positive_values(requested, FREQUENCY, "frequencies"))
    levels = values if values is not None else select_row_values(scene, over, frequency)
    value = np.unique(positive_values(levels, kind, "values"))
    max_wait, row_points = _max_wait_periods(scene, frequency), frequency.size
    rows = [_Row(_scene_at(scene, over, float(each)), frequency, max_wait) for each in value]
    report_points = (
        None if progress is None else lambda n_completed, total: progress(n_completed * row_points, total * row_points)
    )
    points = STUDY.run(rows, table_path, cluster, report_points)
    return MotionMap(
        scene=scene,
        over=over,
        unit=kind.si,
        value=value,
        frequency=frequency,
        kind=np.array([[max(map(_kind_index, point.types)) for point in row] for row in points]),
        motion=np.array([["/".join(point.types) for point in row] for row in points]),
        impacts=np.array([[point.impacts for point in row] for row in points]),
        repetition=np.array([[point.repetition for point in row] for row in points]),
        periods=np.array([[point.periods for point in row] for row in points]),
        cpu=np.array([[point.cpu for point in row] for row in points]),
        take_off=separation_levels(scene, frequency),
    )


def _scene_at(scene: Scene, over: str, value: float) -> Scene:
    if over == "clearance":
        dampers = [d.replace(clearance=value) if d.impacts else d for d in scene.dampers]
        return scene.replace(dampers=dampers)
    assert scene.test is not None
    return scene.replace(test=scene.test.replace(**{over: value}))


def _max_wait_periods(scene: Scene, frequency: Array) -> int:
    """Compute the longest wait in periods of the highest frequency, from the decay of the slowest mode."""
    rate = structural_model(scene).modes.decay_rate
    with np.errstate(divide="ignore"):
        periods = MAX_WAIT_DECAY_TIMES * np.log(1.0 / STEADY_TOLERANCE) * frequency[-1] / max(float(rate.min()), 0.0)
    return int(np.clip(periods, MIN_WAIT_LIMIT_PERIODS, MAX_WAIT_LIMIT_PERIODS))


class _Row(NamedTuple):
    """A row of the map, computed in ascending order of frequency."""

    scene: Scene
    frequency: Array
    max_wait: int  # periods


class _Point(NamedTuple):
    """A point of the map: properties of a steady-state motion."""

    types: list[str]  # type of motion of each damper, then of each joint
    impacts: float
    repetition: int
    periods: int
    cpu: float


def _compute(row: _Row) -> list[_Point]:
    """Compute all points of a row, with the CPU time of each."""
    # Run once without measurement, so compilation and loading are not included in the CPU time.
    next(SteadyContinuation(row.scene, STEADY_TOLERANCE, 1).motions(row.frequency))
    computed, motions = [], SteadyContinuation(row.scene, STEADY_TOLERANCE, row.max_wait).motions(row.frequency)
    for _ in row.frequency:
        cpu_start = time.thread_time()
        motion = next(motions)
        cpu = time.thread_time() - cpu_start
        steady, impacts = motion.steady, float(motion.impacts.sum())
        computed.append(_Point(motion.types, impacts, steady.repetition, steady.periods, cpu))
    return computed


#: The rows of a map.
STUDY: Study[_Row, list[_Point]] = Study(
    "rows of a map",
    ("row", "points"),
    _compute,
    lambda row: digest((row.scene.to_yaml(), row.frequency.tolist(), row.max_wait)),
    lambda key, points: [key, json.dumps(points)],
    lambda row: (row[0], [_Point(*point) for point in json.loads(row[1])]),
)


def _kind_index(motion: str) -> int:
    """Return the position in `KINDS` of the type of motion of a damper or joint.

    >>> [KINDS[_kind_index(name)] for name in ("riding", "III", "3 per 1", "2 slips per 1", "3 per 2")]
    ['riding', 'III', 'other, every period', 'other, every period', 'longer period']
    """
    if motion == "linear":
        return 0  # nothing hits a wall, slides or closes
    if motion in KINDS:
        return KINDS.index(motion)
    return KINDS.index("other, every period" if motion.endswith(" per 1") else "longer period")


def summarize_map(map_: MotionMap) -> str:
    """Summarize the share of each type of motion in the map, and the computing time."""
    rows, points = map_.kind.shape
    lines = [
        f"{map_.scene.name}: {rows} x {points} steady-state motions, {map_.over} {map_.value[0]:.3g} to "
        f"{map_.value[-1]:.3g} {map_.unit}, {map_.frequency[0]:.4g} to {map_.frequency[-1]:.4g} Hz",
        "",
        f"{'type of motion':20}{'share':>7}{'impacts / period':>18}{'CPU µs / period':>17}{'CPU ms / motion':>17}",
    ]
    for index, kind in enumerate(KINDS):
        is_kind = map_.kind == index
        if is_kind.any():
            lines.append(
                f"{kind:20}{100.0 * is_kind.mean():5.1f} %{map_.impacts[is_kind].mean():18.3g}"
                f"{1e6 * map_.cpu[is_kind].sum() / map_.periods[is_kind].sum():17.3g}"
                f"{1e3 * np.median(map_.cpu[is_kind]):17.3g}"
            )
    lines += [
        "",
        "CPU µs / period: time to compute a period. CPU ms / motion: time to compute a motion, from the motion at the "
        f"previous\nfrequency until it is steady within {STEADY_TOLERANCE:.0e} or irregular. These are not times of a "
        "test on a bench.",
        f"total CPU time: {map_.cpu.sum():.3g} s",
    ]
    return "\n".join(lines)


def write_map(map_: MotionMap, folder: Path) -> list[Path]:
    """Write map-<scene> or map-clearance-<scene>, as .png, .svg and .csv, into a folder; `SceneError` on failure."""
    table = map_.columns()
    rows: list[list[object]] = [[name.lower() for name in table]]
    for cells in zip(*table.values(), strict=True):
        rows.append([f"{cell:.9g}" if isinstance(cell, float) else cell for cell in cells])
    return save_with_table(_draw(map_), output_stem(map_.scene, map_.over, folder), rows)


def output_stem(scene: Scene, over: str, folder: Path) -> Path:
    """Return the path of a map's files without their suffix."""
    return folder / file_stem("map-clearance" if over == "clearance" else "map", scene.name)


def _draw(map_: MotionMap) -> Figure:
    from matplotlib.colors import LogNorm
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from scipy.ndimage import median_filter

    nouns = " and ".join(["dampers"] * bool(map_.scene.dampers) + ["joints"] * bool(map_.scene.joints))
    with new_figure(4.6, 10.0) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        map_.draw(left)
        settling = map_.settling_time
        # The time depends on the instant of the frequency step in the vibration period, which would hide the pattern.
        median = median_filter(np.nan_to_num(settling, nan=np.inf), 3, mode="nearest")
        settling = np.where(np.isfinite(settling) & np.isfinite(median), median, settling)
        known = settling[np.isfinite(settling)] if np.isfinite(settling).any() else np.ones(1)
        norm = LogNorm(known.min(), max(known.max(), 1.01 * known.min()))
        mesh = right.pcolormesh(*map_.borders, settling, cmap="viridis", norm=norm, rasterized=True)
        bar = figure.colorbar(mesh, ax=right, label="settling time / s (median of 3 × 3 points)", pad=0.02)
        set_log_scale(bar.ax.yaxis)
        map_.draw_axes(right)
        right.set_ylabel("")
        left.set_title(f"Most complex type of motion of the {nouns}")
        right.set_title(f"Settling within {STEADY_TOLERANCE:.0e} after a frequency step".replace("1e-06", "10⁻⁶"))
        present = sorted(set(map_.kind.ravel()))
        handles: list[Patch | Line2D] = [Patch(color=MOTIONS[k], label=LEGEND[k]) for k in present]
        if map_.over != "clearance":
            handles.append(Line2D([], [], color="black", lw=1.2, label="linear below this line (beds: 1 g)"))
        if map_.own_value is not None:
            handles.append(Line2D([], [], color="black", lw=1.0, ls="--", label=f"{map_.over} of the scene"))
        if not np.isfinite(settling).all():
            handles.append(Patch(facecolor="white", edgecolor="black", lw=0.5, label="does not settle (right)"))
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
        rows, points = map_.kind.shape
        add_page_title(
            figure, f"{map_.scene.name} (computed)",
            f"{rows} × {points} steady motions; each row upward in frequency, each motion from the previous one",
        )  # fmt: skip
        return figure
