"""Where a scene gets hard: type of motion and periods to compute it over level or clearance, and frequency."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.engine.trajectory import Array
from rig.figure_style import cell_edges, plain_logarithmic
from rig.motion_map.grid import KIND_OF_UNIT, columns, rows_of, take_off, vertical_axis
from rig.results import Result
from rig.scene.loading import SceneLike, scene_of
from rig.scene.quantities import FREQUENCY, positives
from rig.scene.scene import Scene
from rig.steady_response.frequency_response import Follower
from rig.study import Study, digest
from rig.system.open_loop_drive import level_of, with_ideal_force
from rig.system.structural_model import structural_model

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

#: What a damper does, from the tamest to the wildest; a point of the map counts as what its wildest damper does.
KINDS = ("riding", "I", "II", "III", "other, every period", "longer period", "irregular")
#: Distance from the steady state at which a motion's type is determined, relative to the motion.
TOLERANCE = 1e-6
#: A motion that has not repeated after so many times the slowest mode's decay to the tolerance is irregular.
PATIENCE = 3.0
#: Shortest limit of the wait, periods: fewer cost little.
FEWEST = 2000
#: Longest limit of the wait, periods.
MOST = 20_000
#: From tame to wild: grey, three blues to green for the paper's types, warm colours for the rest.
COLOURS = ("#e4e4e4", "#a6cee3", "#3f8fc4", "#1b4f7e", "#f2c14e", "#e07b39", "#8c1c3a")
LEGEND = ("riding", "Type I", "Type II", "Type III", *KINDS[4:])


@dataclass(frozen=True, repr=False)
class MotionMap(Result):
    """Steady motion over a grid.

    Attributes
    ----------
    scene : Scene
        As it was followed: a force that its test holds acts on the body itself.
    over : {"force", "drive", "clearance"}
        What changes from row to row.
    unit : str
        N, V or m.
    value : ndarray, shape (rows,)
        Level, or clearance of every damper.
    frequency : ndarray, shape (frequencies,)
        Hz, rising; each motion starts from the one before in its row.
    kind : ndarray of int, shape (rows, frequencies)
        Position in `KINDS`.
    motion : ndarray of str, shape (rows, frequencies)
        Type of every damper's motion, in their order, joined by "/".
    impacts : ndarray, shape (rows, frequencies)
        Impacts of all dampers a period.
    repetition : ndarray of int, shape (rows, frequencies)
        Periods of the drive after which the motion repeats; 0 if none was found.
    periods : ndarray of int, shape (rows, frequencies)
        Periods that were computed to find out, from the motion at the frequency before; a test waits otherwise.
    cpu : ndarray, shape (rows, frequencies)
        CPU time spent, s; in no table or figure, which are the same wherever they are computed.
    take_off : ndarray, shape (frequencies,)
        Level above which the linear structure with all dampers riding accelerates one of them at more than gravity.
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
        """Say what was mapped, and how much of it each kind of motion takes."""
        shares = [(kind, (self.kind == number).mean()) for number, kind in enumerate(KINDS)]
        return (
            f"{self.scene.name}: {self.over} {self.value[0]:.3g} to {self.value[-1]:.3g} {self.unit}, "
            f"{self.frequency[0]:.4g} to {self.frequency[-1]:.4g} Hz; "
            f"{', '.join(f'{kind} {share:.0%}' for kind, share in shares if share)}"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Every point of the grid: where, which motion, how often it hits and repeats, periods computed to know."""
        dampers = np.array([each.split("/") for each in self.motion.ravel()]).T
        return {
            f"{self.over}_{self.unit}": np.repeat(self.value, self.frequency.size),
            "frequency_Hz": np.tile(self.frequency, self.value.size),
            "kind": np.array(KINDS)[self.kind.ravel()],
            **{f"damper{k}_motion": row for k, row in enumerate(dampers, 1)},
            "impacts_per_period": self.impacts.ravel(),
            "repetition_periods": self.repetition.ravel(),
            "periods_followed": self.periods.ravel(),
        }

    def to_xarray(self) -> xarray.Dataset:
        """Give the columns as an xarray data set over both axes."""
        return self.to_dataframe().set_index("frequency_Hz", append=True).to_xarray()

    def draw(self, ax: Axes, **style: Any) -> None:
        """Kind of motion over level or clearance, and frequency."""
        from matplotlib.colors import ListedColormap

        look: dict[str, Any] = {
            "cmap": ListedColormap(COLOURS),
            "vmin": -0.5,
            "vmax": len(KINDS) - 0.5,
            "rasterized": True,
        }
        ax.pcolormesh(*self.borders, self.kind, **look | style)
        for k in sorted(set(self.kind.ravel())):
            ax.plot([], [], "s", color=COLOURS[k], label=LEGEND[k])
        self.dress(ax)

    @property
    def borders(self) -> tuple[Array, Array]:
        """Borders of the cells along frequency and along the level or clearance."""
        return cell_edges(self.frequency, False), cell_edges(self.value, True)

    @property
    def own_value(self) -> float | None:
        """The scene's own value, if it lies on the map and there is only one."""
        if self.over == "clearance":
            found = {d.clearance for d in self.scene.dampers if d.moves}
            value = found.pop() if len(found) == 1 else np.inf
        else:
            value = level_of(self.scene)
        return value if self.value[0] <= value <= self.value[-1] else None

    def dress(self, ax: Axes) -> None:
        """Draw axes, the border to flight, and the scene's own value."""
        (left, *_, right), (low, *_, high) = self.borders
        ax.grid(False)
        ax.set(xlim=(left, right), xlabel="frequency / Hz")
        millimetres = self.unit == "m"
        plain_logarithmic(ax.yaxis, factor=1e3 if millimetres else 1.0)
        ax.set(ylim=(low, high), ylabel=f"{self.over} / {'mm' if millimetres else self.unit}")
        if self.over != "clearance":
            ax.plot(self.frequency, self.take_off, color="black", lw=1.2)
        own = self.own_value
        if own is not None:
            ax.axhline(own, color="black", lw=1.0, ls="--")


def map_motion(
    scene: SceneLike,
    over: str | None = None,
    values: ArrayLike | None = None,
    frequencies: ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
    cluster: str | None = None,
    kept: Path | None = None,
) -> MotionMap:
    """Follow the steady motion over a grid of levels, or of clearances, and frequencies.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or what `rig.load` takes. Where its test holds the amplitude of the spring force, that force acts on
        the body as a pure tone; a test that gives a drive goes through its shaker.
    over : {"force", "drive", "clearance"}, optional
        What changes beside the frequency; None: the level that the test gives. A clearance is that of every damper
        that is not locked, at the test's level.
    values : array_like, shape (rows,), optional
        Levels [N, or the drive's unit] or clearances [m], or texts with units; None: around what decides over
        take-off and over hitting the ceiling, the scene's own value among them.
    frequencies : array_like, shape (frequencies,), optional
        Hz, or texts with units; None: the test's range, closer around the natural frequencies.
    progress : callable, optional
        Called with the number of points done and of all.
    cluster : str, optional
        As for `rig.design`.
    kept : Path, optional
        CSV file with every row as soon as it is done; rows of the same map that are in it are not computed again.

    Raises
    ------
    RunError
        If that file cannot be read or written.
    SceneError
        If the scene has no damper that moves, no shaker or no level, or a value is not positive.
    """
    scene = scene_of(scene)
    over, unit = vertical_axis(scene, over)
    scene = with_ideal_force(scene)
    asked = frequencies if frequencies is not None else columns(scene)
    frequency = np.unique(positives(asked, FREQUENCY, "frequencies"))
    levels = values if values is not None else rows_of(scene, over, frequency)
    value = np.unique(positives(levels, KIND_OF_UNIT[unit], "values"))
    longest = _longest(scene, frequency)
    rows = [_Row(_with(scene, over, float(each)), frequency, longest) for each in value]
    count = frequency.size
    points = _STUDY.run(
        rows,
        kept,
        cluster,
        None if progress is None else lambda done, total: progress(done * count, total * count),
    )
    return MotionMap(
        scene=scene,
        over=over,
        unit=unit,
        value=value,
        frequency=frequency,
        kind=np.array([[max(map(_kind, point.types)) for point in row] for row in points]),
        motion=np.array([["/".join(point.types) for point in row] for row in points]),
        impacts=np.array([[point.impacts for point in row] for row in points]),
        repetition=np.array([[point.repetition for point in row] for row in points]),
        periods=np.array([[point.periods for point in row] for row in points]),
        cpu=np.array([[point.cpu for point in row] for row in points]),
        take_off=take_off(scene, frequency),
    )


def _with(scene: Scene, over: str, value: float) -> Scene:
    if over == "clearance":
        dampers = [d.replace(clearance=value) if d.moves else d for d in scene.dampers]
        return scene.replace(dampers=dampers)
    assert scene.test is not None
    return scene.replace(test=scene.test.replace(**{over: value}))


def _longest(scene: Scene, frequency: Array) -> int:
    """Periods of the quickest tone after which the slowest mode has decayed to the tolerance several times."""
    rate = structural_model(scene).modes.decay_rate
    with np.errstate(divide="ignore"):
        periods = PATIENCE * np.log(1.0 / TOLERANCE) * frequency[-1] / max(float(rate.min()), 0.0)
    return int(np.clip(periods, FEWEST, MOST))


class _Row(NamedTuple):
    """A row to follow upwards in frequency."""

    scene: Scene
    frequency: Array
    longest: int


class _Point(NamedTuple):
    """What a map shows of a steady motion."""

    types: list[str]
    impacts: float
    repetition: int
    periods: int
    cpu: float


def _followed(row: _Row) -> list[_Point]:
    """Every point of a row with the CPU time it took."""
    # What is compiled or loaded from disk at first use is no part of the cost.
    Follower(row.scene, TOLERANCE, 1).point(float(row.frequency[0]), None)
    found, points = [], Follower(row.scene, TOLERANCE, row.longest).follow(row.frequency)
    for _ in row.frequency:
        begun = time.thread_time()
        point = next(points)
        cpu = time.thread_time() - begun
        steady, impacts = point.steady, float(point.impacts.sum())
        found.append(_Point(list(point.types), impacts, steady.repetition, steady.periods, cpu))
    return found


def _digest(row: _Row) -> str:
    return digest(repr((row.scene.to_yaml(), row.frequency.tolist(), row.longest)))


_STUDY: Study[_Row, list[_Point]] = Study(
    "rows of a map",
    ("row", "points"),
    _followed,
    _digest,
    lambda key, points: [key, json.dumps(points)],
    lambda row: (row[0], [_Point(*point) for point in json.loads(row[1])]),
)


def _kind(damper_motion: str) -> int:
    """Position in `KINDS` of what a damper does.

    >>> [KINDS[_kind(each)] for each in ("riding", "III", "3 per 1", "3 per 2", "irregular")]
    ['riding', 'III', 'other, every period', 'longer period', 'irregular']
    """
    if damper_motion in KINDS:
        return KINDS.index(damper_motion)
    return KINDS.index("other, every period" if damper_motion.endswith(" per 1") else "longer period")
