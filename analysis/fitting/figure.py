"""What a fit leaves: measured curves over those of the fitted scene, and what is missed, in standard deviations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rig.figure_style import colour, decades, drawing, frequency_axis, heading, legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from analysis.fitting.fit import Compared, Fit

# Sweeps drawn, and the height of each in inches.
MOST_ROWS, _ROW = 8, 2.4


def fit_figure(found: Fit) -> Figure:
    """One row for each sweep or test: measured and fitted on the left, what is missed on the right."""
    rows = found.compared[:MOST_ROWS]
    with drawing(_ROW * len(rows) + 1.0, 10.0) as figure:
        axes = figure.subplots(len(rows), 2, squeeze=False)
        for one, (left, right) in zip(rows, axes, strict=True):
            _compared(left, one)
            _missed(right, one)
            last = one is rows[-1]
            for ax in (left, right):
                frequency_axis(ax, one.curves.frequency.min(), one.curves.frequency.max(), last)
        legend_below(
            figure,
            "Dots: measured. Lines: the fitted scene at the same frequencies. Crosses: points left out of the fit. "
            "Grey: two standard deviations.",
        )
    return figure


def _compared(ax: Axes, one: Compared) -> None:
    order = np.argsort(one.curves.frequency, kind="stable")
    frequency = one.curves.frequency[order]
    factor, unit = (1.0, "m/m") if one.curves.reference == "table" else (1e6, "µm/N")
    for k, sensor in enumerate(one.curves.sensors):
        size = factor * abs(one.curves.value[k, order])
        ax.plot(frequency, size, ".", color=colour(k), label=sensor.name)
        ax.plot(frequency, factor * abs(one.predicted[k, order]), "-", lw=0.8, color=colour(k))
    decades(ax, [factor * abs(one.curves.value)])
    ax.set_ylabel(f"|x / {one.curves.reference}| / ({unit})")
    heading(ax, one.curves.label)


def _missed(ax: Axes, one: Compared) -> None:
    order = np.argsort(one.curves.frequency, kind="stable")
    frequency, used = one.curves.frequency[order], one.used[order]
    for k in range(len(one.curves.sensors)):
        misses = one.misses[k, order]
        ax.plot(frequency, np.where(used, misses, np.nan), ".", color=colour(k))
        ax.plot(frequency, np.where(used, np.nan, misses), "x", color=colour(k))
    decades(ax, [one.misses], most=5.0)
    ax.axhline(2.0, color="#555555", lw=0.6)
    ax.set_ylabel("miss / std. deviation")
    left_out = f", {int((~used).sum())} points left out" if not used.all() else ""
    heading(ax, f"Off by {100 * one.relative:.2g} % of the curve, rms{left_out}")
