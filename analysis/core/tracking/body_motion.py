"""Amplitude of one body at each line of a measured response, for results as functions of amplitude."""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.figure_types import Axes
from rig.core.base.palette import CurveStyle
from rig.core.results import format_percent
from rig.core.results.response import Response
from rig.core.results.table import Table
from rig.core.results.uncertainty import SENSITIVITY

# Bars with the errors that all points share.
_COMMON_COLOR = "#d0d0d0"


class BodyMotion(NamedTuple):
    """Motion of a body at the lines of a response, each of shape (lines,)."""

    output: int  # index of the body's channel in the response
    force: Array  # amplitude [N]; NaN if it is not known
    amplitude: Array  # displacement [m]
    relative: Array  # half of the 95 % interval of the response, relative to the response
    own: Array  # as `relative`, without the tolerances of the sensors, which all lines share
    settled: NDArray[np.bool_]


class LevelPoint(NamedTuple):
    """The highest measured point at one level of a test."""

    level: str
    frequency: float  # excitation frequency [Hz]
    # Value and text with its 95 % interval of each quantity; its name ends with its unit: "damping ratio / %".
    quantities: Mapping[str, tuple[float, str]]
    note: str = ""


def table_of_levels(points: Sequence[LevelPoint], names: Collection[str]) -> Table:
    """Return a table with a row for each level: level, text of each named quantity, and note."""
    rows = [
        (point.level, *(point.quantities.get(name, (0.0, "not determined"))[1] for name in names), point.note)
        for point in points
    ]
    return Table(("level", *names, "remark"), ">" * (len(names) + 1) + "<", rows)


def quantity_ranges(points: Sequence[LevelPoint]) -> dict[str, str]:
    """Write each quantity with its interval at the first and last level, and at its smallest and largest value.

    >>> points = [(level, {"damping / %": (d, f"{d} ± 0.1")}) for level, d in (("1 N", 0.7), ("2 N", 0.9))]
    >>> quantity_ranges([LevelPoint(level, 1.0, quantities) for level, quantities in points])
    {'damping': '(0.7 ± 0.1) % at 1 N → (0.9 ± 0.1) % at 2 N'}
    """
    ranges = {}
    for key in dict.fromkeys(key for point in points for key in point.quantities):
        name, _, unit = key.partition(" / ")
        known = [(*point.quantities[key], point.level) for point in points if key in point.quantities]
        known = [each for each in known if each[1]]
        if known:
            chosen = [each for each in known if each in (known[0], min(known), max(known), known[-1])]
            ranges[name] = " → ".join(f"{_with_unit(text, unit)} at {level}" for _, text, level in chosen)
    return ranges


def _with_unit(text: str, unit: str) -> str:
    """Add a unit to a value with its interval, before a remark that follows a comma."""
    number, comma, remark = text.partition(",")
    unit = unit.strip("()")
    if number == "not determined":
        return text
    return f"({number}) {unit}{comma}{remark}" if "±" in number else f"{number} {unit}{comma}{remark}"


class CurvePart(NamedTuple):
    """Points of a curve with a common symbol. The curve consists of the parts with equal styles."""

    name: str
    style: CurveStyle
    selected: NDArray[np.bool_]  # shape (points,)
    is_stable: bool


def body_motion(response: Response, location: str) -> BodyMotion:
    """Return the motion at a location such as "body 2" and the measured force of the test."""
    k = [output.at for output in response.outputs].index(location)
    size, magnitude = response.frequency.size, abs(response.value[:, k, 0])
    force = np.full(size, np.nan) if response.amplitude is None else response.amplitude
    settled = np.ones(size, dtype=bool) if response.unsteady is None else ~response.unsteady
    relative, own = (each.expanded()[:, k, 0] / magnitude for each in (response, response.without(SENSITIVITY)))
    return BodyMotion(k, force, magnitude * force, relative, own, settled)


def draw_common_error(ax: Axes, *columns: Array) -> None:
    """Draw a gray bar with the tolerances of the sensors at the first of the points that share them.

    `columns`: position, value, and its expanded uncertainty without and with the tolerances.
    """
    at, value, own, expanded = (float(column[0]) for column in columns)
    if own < expanded:
        ax.vlines(at, max(value - expanded, 0.0), value + expanded, colors=_COMMON_COLOR, lw=5.0, zorder=1)


def common_error_text(value: Array, own: Array, expanded: Array, points: str = "all points") -> str:
    """Write that bars in a figure exclude the errors of the sensors, and the largest relative interval with them.

    >>> common_error_text(np.array([1.0, 2.0]), np.array([0.01, 0.02]), np.array([0.05, 0.1]))
    'Bars exclude the tolerances of the sensors, which all points share; with them, 95 % intervals are up to ± 5 %.'
    """
    largest = float(np.nanmax(expanded / value, initial=0.0, where=own < expanded))
    return (
        f"Bars exclude the tolerances of the sensors, which {points} share; with them, 95 % intervals are up to "
        f"± {format_percent(largest)}."
    ) * (largest > 0.0)
