"""Figure of a fit: measured curves, curves of the fitted scene, and the normalized residuals."""

import numpy as np

from analysis.core.fitting.fit import Comparison, Fit
from rig.core.base.figure_style import add_legend_below, add_title, frequency_axis, log_axis, new_figure
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.palette import location_styles
from rig.core.results import format_number

# At most this number of sweeps is drawn: more panels would not fit on a page.
MAX_ROWS = 8
_ROW_HEIGHT_IN = 2.4
# Largest frequency step without a gap in a fitted curve, relative to both neighbors: nothing was computed in gaps.
_MIN_BREAK_RATIO = 3.0


def fit_figure(result: Fit) -> Figure:
    """Draw one row for each sweep or test: measured and fitted curves on the left, residuals on the right."""
    rows = result.compared[:MAX_ROWS]
    bands = [(float(compared.curves.frequency.min()), float(compared.curves.frequency.max())) for compared in rows]
    crosses = "" if all(compared.is_fitted.all() for compared in rows) else " Crosses: points omitted from the fit."
    with new_figure(_ROW_HEIGHT_IN * len(rows) + 1.0, 10.0) as figure:
        axes = figure.subplots(len(rows), 2, squeeze=False)
        for compared, band, (curve_axes, residual_axes) in zip(rows, bands, axes, strict=True):
            _draw(curve_axes, residual_axes, compared)
            # Rows of the same band share the frequency labels below the last row.
            labeled = compared is rows[-1] or any(band != other for other in bands)
            for ax in (curve_axes, residual_axes):
                frequency_axis(ax, *band, labeled)
        add_legend_below(
            figure,
            f"Dots: measured. Lines: the fitted scene at the same frequencies.{crosses} Gray: twice the standard "
            "uncertainty.",
        )
    return figure


def _draw(curve_axes: Axes, residual_axes: Axes, compared: Comparison) -> None:
    curves, order = compared.curves, np.argsort(compared.curves.frequency, kind="stable")
    frequency, is_fitted = curves.frequency[order], compared.is_fitted[order]
    factor, unit = (1.0, "m/m") if curves.reference == "table" else (1e6, "µm/N")
    steps = np.diff(frequency)
    neighboring_steps = np.maximum(np.append(0.0, steps[:-1]), np.append(steps[1:], 0.0))
    breaks = (
        np.flatnonzero(steps > _MIN_BREAK_RATIO * neighboring_steps) + 1 if steps.size > 1 else np.empty(0, dtype=int)
    )
    styles = location_styles([sensor.at for sensor in curves.sensors])
    for k, (sensor, style) in enumerate(zip(curves.sensors, styles, strict=True)):
        magnitude, residual = factor * abs(curves.value[k, order]), compared.normalized_residuals[k, order]
        for ax, y in ((curve_axes, magnitude), (residual_axes, residual)):
            ax.plot(frequency, np.where(is_fitted, y, np.nan), style.marker, color=style.color, label=sensor.name)
            ax.plot(frequency, np.where(is_fitted, np.nan, y), "x", color=style.color)
        line = np.insert(factor * abs(compared.predicted[k, order]), breaks, np.nan)
        curve_axes.plot(np.insert(frequency, breaks, np.nan), line, "-", lw=0.8, color=style.color)
    log_axis(curve_axes, [factor * abs(curves.value)])
    curve_axes.set_ylabel(f"|x / {curves.reference}| / ({unit})")
    test, details = curves.scene.test, [curves.label]
    if test is not None:
        # With several levels, the label names the level.
        details += [test.title, test.level_text(curves.scene.driven_shaker) if len(test.levels) == 1 else ""]
    add_title(curve_axes, ", ".join(filter(None, details)))
    log_axis(residual_axes, [compared.normalized_residuals], max_decades=5.0)
    residual_axes.axhline(2.0, color="#555555", lw=0.6)
    residual_axes.set_ylabel("residual / standard uncertainty")
    omitted = int((~is_fitted).sum())
    omission = f", {omitted} point{'s' if omitted > 1 else ''} omitted" if omitted else ""
    add_title(residual_axes, f"Residual {format_number(100 * compared.relative)} % of the curve, rms{omission}")
