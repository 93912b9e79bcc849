"""Figure of a modal identification: measured FRFs with the model, stabilization diagram, mode shapes."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from analysis.commands.figures.determined_lines import MAX_MARKED, determined_band, is_determined
from analysis.commands.figures.tolerance_texts import intervals_text, unstated_tolerances
from analysis.core.modal.mode_warnings import EXTRAPOLATED_TO, MAX_LINEAR_RESIDUAL, extrapolates_damping
from analysis.core.modal.modes import MODE_WIDTH, Modes
from rig.core.base.arrays import Array
from rig.core.base.escaping import escape_figure
from rig.core.base.figure_style import add_legend_below, add_title, frequency_axis, log_axis, new_figure
from rig.core.base.figure_types import Figure
from rig.core.base.palette import faded, location_styles
from rig.core.results import format_percent
from rig.core.results.response import Response
from rig.core.results.uncertainty import expand

# A mode shape is faded if the expanded uncertainty of a component exceeds this fraction of the largest component.
MAX_SHAPE_BOUND = 0.5
_FADED = 0.35
# Error bars are cut at this length, because longer bars are wider than the panel.
_WIDEST_BAR = 3.0
# A mode is poorly stabilized if its poles are stable at less than this fraction of the model orders.
_MIN_STABLE = 0.25
# Number of mode shapes side by side; with more, their titles would overlap.
_MAX_COLUMNS = 5


def is_known_shape(bounds: Array) -> bool:
    """Return whether a shape is drawn without fading: no expanded uncertainty exceeds half the largest component."""
    return bool(np.all(bounds <= MAX_SHAPE_BOUND))


def modes_figure(frfs: Sequence[Response], modes: Modes, title: str, remarks: Sequence[str] = ()) -> Figure:
    """Draw measured FRFs with the modal model, the stabilization diagram and the mode shapes.

    `frfs`: the FRFs from which `analysis.core.modal.identification.identify` estimated the modes. If they have several
    inputs, only the FRFs of the modes' input are drawn. `remarks`: sentences for the caption.
    """
    several = len({frf.input for frf in frfs}) > 1
    curves = [frf.to("displacement").with_gaps() for frf in frfs if not several or frf.input == modes.input]
    low, high = determined_band(curves)
    count = modes.frequency.size
    shape_rows = max(-(-count // _MAX_COLUMNS), 1)  # rounded up
    columns = max(-(-count // shape_rows), 1)
    with new_figure(5.6 + 2.0 * shape_rows) as figure:
        rows = figure.add_gridspec(2 + shape_rows, columns, height_ratios=[2.2, 1.3, *[1.3] * shape_rows])
        magnitude_axes = figure.add_subplot(rows[0, :])
        chart_axes = figure.add_subplot(rows[1, :])
        # More points near each resonance; otherwise the drawn model would miss its peaks.
        near_peaks = modes.frequency[:, None] * (1.0 + np.outer(modes.damping, np.linspace(-8.0, 8.0, 161)))
        dense = np.unique(np.append(np.geomspace(low, high, 1500), near_peaks))
        dense = dense[(dense >= low) & (dense <= high)]
        # Few points are drawn as dots with a line for the model, many points as a broad line with a thin line.
        is_sparse = curves[0].frequency.size <= MAX_MARKED
        styles = location_styles([curve.outputs[0].at for curve in curves])
        unit, factor = curves[0].shown_in
        for index, (curve, style) in enumerate(zip(curves, styles, strict=True)):
            color = style.color
            measured, known = factor * abs(curve.value), is_determined(curve)
            points: dict[str, Any] = {"marker": style.marker, "ls": ""} if is_sparse else {"lw": 2.8}
            pale = color if is_sparse else faded(color)
            magnitude_axes.plot(curve.frequency, np.where(known, measured, np.nan), ms=2.4, color=pale, **points)
            magnitude_axes.plot(
                curve.frequency, np.where(known, np.nan, measured), color=faded(color), lw=0.7, zorder=1
            )
            model = factor * abs(modes.receptance(dense)[index])
            name = escape_figure(curve.response)
            magnitude_axes.plot(
                dense, model, color=color, lw=1.1, ls="-" if is_sparse else style.line, label=name, ms=3.5,
                marker=style.marker if is_sparse else "", markevery=[],
            )  # fmt: skip
        magnitudes = [factor * abs(modes.receptance(dense)), *(factor * abs(curve.value) for curve in curves)]
        log_axis(magnitude_axes, magnitudes)
        frequency_axis(magnitude_axes, low, high, False)
        magnitude_axes.set_ylabel(f"|{curves[0].name}| / ({unit})")
        add_title(magnitude_axes, title)
        modes.plot_stabilization(chart_axes)
        if legend := chart_axes.get_legend():
            legend.remove()
        frequency_axis(chart_axes, low, high, True)
        for line in chart_axes.get_lines():
            frequency = np.asarray(line.get_xdata())
            if not ((low <= frequency) & (frequency <= high)).any():
                line.set_label("_outside")
        for frequency in modes.frequency:
            magnitude_axes.axvline(frequency, color="#777777", lw=0.7, ls=":", zorder=0)
        bodies = modes.of_bodies()
        heights = np.arange(1, len(bodies.names) + 1)
        is_extrapolated, orders = extrapolates_damping(modes, frfs), {pole.order for pole in modes.chart}
        has_faded = False
        for i in range(count):
            row, column = divmod(i, columns)
            axes = figure.add_subplot(rows[2 + row, column])
            shape, expanded = bodies.shapes[:, i].real, expand(bodies.errors[:, i])
            is_near = (abs(pole.frequency / modes.frequency[i] - 1.0) <= MODE_WIDTH for pole in modes.chart)
            stable = {pole.order for pole, near in zip(modes.chart, is_near, strict=True) if pole.stable and near}
            is_poor = len(stable) < _MIN_STABLE * len(orders)
            opacity = 1.0 if is_known_shape(expanded) and not is_poor else _FADED
            has_faded |= opacity < 1.0
            axes.plot(np.append(0, shape), np.append(0, heights), "o-", color="#333333", alpha=opacity)
            xerr = np.minimum(np.nan_to_num(expanded, posinf=_WIDEST_BAR), _WIDEST_BAR)
            axes.errorbar(shape, heights, xerr=xerr, fmt="none", ecolor="#333333", capsize=2, lw=0.9, alpha=opacity)
            axes.set(xlim=(-1.25, 1.25), xlabel="shape" if row == shape_rows - 1 else "")
            axes.axvline(0.0, color="#777777", lw=0.7)
            positive: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "axes fraction", "va": "center"}
            arrow = {"arrowstyle": "->", "color": "#555555"}
            axes.annotate("", (0.98, 0.08), (0.84, 0.08), arrowprops=arrow, **positive)
            axes.annotate("+", (0.82, 0.08), (0.82, 0.08), ha="right", color="#555555", **positive)
            notes = ["damping extrapolated"] * bool(is_extrapolated[i])
            notes += [f"stable at {len(stable)} of {len(orders)} orders"] * is_poor
            axes.annotate(
                "\n".join(notes), (0.02, 0.97), xycoords="axes fraction", va="top", fontsize=7.5, color="#555555",
                bbox={"fc": "white", "ec": "none", "pad": 1.0},
            )  # fmt: skip
            names = ["ground", *map(escape_figure, bodies.names)] if column == 0 else [""] * (heights.size + 1)
            axes.set_yticks(np.append(0, heights), names)
            axes.set_title(
                f"{modes.frequency_text(i)}\nζ = {modes.damping_text(i)}", y=1.0, fontsize=9,
                fontweight="normal",
            )  # fmt: skip
        residual = f"Residual: {format_percent(modes.model_error)} of the peak height."
        data = "Points" if is_sparse else "Broad and pale"
        add_legend_below(
            figure, f"{data}: measured. Lines: modal model. ±: {intervals_text(unstated_tolerances(frfs))}.",
            residual * (modes.model_error > MAX_LINEAR_RESIDUAL),
            f"Damping extrapolated: from the flanks {EXTRAPOLATED_TO}." * bool(is_extrapolated.any()),
            f"Shapes: the largest component is +1{'; faded: uncertain' * has_faded}.", *remarks,
        )  # fmt: skip
        return figure
