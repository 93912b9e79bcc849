"""What a fit leaves: measured curves over those of the fitted scene, and what is missed, in standard deviations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.figure_style import colour, decades, drawing, frequency_axis, heading, legend_below
from rig.results import plainly

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from analysis.fitting.fit import Compared, Fit

# Sweeps drawn, and the height of each in inches.
MOST_ROWS, _ROW = 8, 2.4
# A step so many times as wide as its neighbours is a hole in a curve.
_HOLE = 3.0


def fit_figure(found: Fit) -> Figure:
    """One row for each sweep or test: measured and fitted on the left, what is missed on the right."""
    rows = found.compared[:MOST_ROWS]
    bands = [(float(one.curves.frequency.min()), float(one.curves.frequency.max())) for one in rows]
    crosses = "" if all(one.used.all() for one in rows) else " Crosses: points left out of the fit."
    with drawing(_ROW * len(rows) + 1.0, 10.0) as figure:
        axes = figure.subplots(len(rows), 2, squeeze=False)
        for one, band, (left, right) in zip(rows, bands, axes, strict=True):
            _compared(left, one)
            _missed(right, one)
            # Only rows of the same band may share the numbers below the last.
            labelled = one is rows[-1] or any(band != other for other in bands)
            for ax in (left, right):
                frequency_axis(ax, *band, labelled)
        legend_below(
            figure,
            f"Dots: measured. Lines: the fitted scene at the same frequencies.{crosses} Grey: two standard deviations.",
        )
    return figure


def _compared(ax: Axes, one: Compared) -> None:
    order = np.argsort(one.curves.frequency, kind="stable")
    frequency = one.curves.frequency[order]
    factor, unit = (1.0, "m/m") if one.curves.reference == "table" else (1e6, "µm/N")
    for k, sensor in enumerate(one.curves.sensors):
        size = factor * abs(one.curves.value[k, order])
        _dots(ax, frequency, size, one.used[order], k, sensor.name)
        ax.plot(*_broken(frequency, factor * abs(one.predicted[k, order])), "-", lw=0.8, color=colour(k))
    decades(ax, [factor * abs(one.curves.value)])
    ax.set_ylabel(f"|x / {one.curves.reference}| / ({unit})")
    heading(ax, one.curves.label)


def _dots(
    ax: Axes,
    frequency: NDArray[np.float64],
    size: NDArray[np.float64],
    used: NDArray[np.bool_],
    number: int,
    label: str | None = None,
) -> None:
    """Draw points of a response as dots, those left out as crosses."""
    ax.plot(frequency, np.where(used, size, np.nan), ".", color=colour(number), label=label)
    ax.plot(frequency, np.where(used, np.nan, size), "x", color=colour(number))


def _broken(frequency: NDArray[np.float64], size: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Break a line where points were left out: at steps far wider than those on either side."""
    steps = np.diff(frequency)
    beside = np.maximum(np.append(0.0, steps[:-1]), np.append(steps[1:], 0.0))
    holes = np.flatnonzero(steps > _HOLE * beside) + 1 if steps.size > 1 else np.empty(0, dtype=int)
    return np.insert(frequency, holes, np.nan), np.insert(size, holes, np.nan)


def _missed(ax: Axes, one: Compared) -> None:
    order = np.argsort(one.curves.frequency, kind="stable")
    frequency, used = one.curves.frequency[order], one.used[order]
    for k in range(len(one.curves.sensors)):
        _dots(ax, frequency, one.misses[k, order], used, k)
    decades(ax, [one.misses], most=5.0)
    ax.axhline(2.0, color="#555555", lw=0.6)
    ax.set_ylabel("miss / std. deviation")
    missing = int((~used).sum())
    left_out = f", {missing} point{'s' if missing > 1 else ''} left out" if missing else ""
    heading(ax, f"Off by {plainly(100 * one.relative)} % of the curve, rms{left_out}")
