"""Figure of a fit: measured curves, curves of the fitted scene, and the normalized residuals."""

import numpy as np

from analysis.core.fitting.fit import Comparison, Fit
from analysis.core.fitting.predicted import linear_response, scene_of_test
from analysis.core.recordings.descriptions import line_spacing
from rig.core.base.arrays import Array
from rig.core.base.figure_style import add_legend_below, add_title, frequency_axis, log_axis, new_figure
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.palette import location_styles
from rig.core.results import format_percent
from rig.core.scene.scene import Scene

# At most this number of sweeps is drawn: more panels would not fit on a page.
MAX_ROWS = 8
_ROW_HEIGHT_IN = 2.4
# Frequencies of the drawn model: at least 10 in the half-power width of a resonance with a damping ratio of 0.4 %, in a
# band of 1 to 10.
_MODEL_POINTS = 3000
# Axes with larger normalized residuals are logarithmic beyond 1.
_MAX_LINEAR = 5.0


def fit_figure(result: Fit) -> Figure:
    """Draw one row for each sweep or test: measured and fitted curves on the left, residuals on the right."""
    rows = result.compared[:MAX_ROWS]
    bands = [(float(compared.curves.frequency.min()), float(compared.curves.frequency.max())) for compared in rows]
    crosses = "" if all(compared.is_fitted.all() for compared in rows) else " Crosses: points omitted from the fit."
    # Scenes name the recordings if their names differ.
    has_names = len({each.curves.scene.name for each in rows}) == len(
        {each.curves.label.split(", ")[0] for each in rows}
    )
    relative = "Responses relative to the table: their peaks are not at natural frequencies. " * any(
        compared.curves.reference == "table" for compared in rows
    )
    orbits = "" if all(each.curves.is_linear for each in rows) else ", with moving dampers at the same frequencies only"
    with new_figure(_ROW_HEIGHT_IN * len(rows) + 1.0, 10.0) as figure:
        axes = figure.subplots(len(rows), 2, squeeze=False)
        for compared, band, (curve_axes, residual_axes) in zip(rows, bands, axes, strict=True):
            _draw(curve_axes, residual_axes, compared, result.scene, has_names)
            # Rows of the same band share the frequency labels below the last row.
            labeled = compared is rows[-1] or any(band != other for other in bands)
            for ax in (curve_axes, residual_axes):
                for mode in result.modes:
                    if band[0] <= mode.frequency <= band[1]:
                        ax.axvline(mode.frequency, color="#777777", lw=0.8, ls=":", zorder=1)
                frequency_axis(ax, *band, labeled)
        add_legend_below(
            figure,
            f"Points: measured. Lines: the fitted scene{orbits}.{crosses} "
            f"{relative}Dotted: natural frequencies of the fitted structure. "
            "Gray: U, the expanded uncertainty (95 %) of a point.",
        )
    return figure


def _draw(curve_axes: Axes, residual_axes: Axes, compared: Comparison, scene: Scene, is_named: bool) -> None:
    """Draw the curves and residuals of one sweep; `is_named`: whether its scene names the recording."""
    curves, order = compared.curves, np.argsort(compared.curves.frequency, kind="stable")
    frequency, is_fitted = curves.frequency[order], compared.is_fitted[order]
    factor, unit = (1.0, "m/m") if curves.reference == "table" else (1e6, "µm/N")
    drawn, model = _model(scene, compared)
    styles = location_styles([sensor.at for sensor in curves.sensors])
    for k, (sensor, style) in enumerate(zip(curves.sensors, styles, strict=True)):
        magnitude = factor * abs(curves.value[k, order])
        # The sign is that of the magnitude; the size includes the phase.
        sign = np.sign(abs(curves.value[k, order]) - abs(compared.predicted[k, order]))
        residual = sign * compared.normalized_residuals[k, order] / 2.0
        for ax, y in ((curve_axes, magnitude), (residual_axes, residual)):
            ax.plot(frequency, np.where(is_fitted, y, np.nan), style.marker, color=style.color, label=sensor.name)
            ax.plot(frequency, np.where(is_fitted, np.nan, y), "x", color=style.color)
        curve_axes.plot(drawn, factor * model[k], "-", lw=0.8, color=style.color)
    log_axis(curve_axes, [factor * abs(curves.value), factor * model])
    curve_axes.set_ylabel(f"|x / {curves.reference}| / ({unit})")
    recording, *details = curves.label.split(", ", 1)
    if (test := curves.scene.test) is not None:
        # With several levels, the label names the level.
        details += [test.title, test.level_text(curves.scene.driven_shaker) if len(test.levels) == 1 else ""]
        details += [*test.details, line_spacing(curves.frfs[0])]
    add_title(curve_axes, f"Fit: {curves.scene.name if is_named else recording} ({', '.join(filter(None, details))})")
    residual_axes.axhspan(-1.0, 1.0, color="#555555", alpha=0.12, lw=0)
    residual_axes.axhline(0.0, color="#555555", lw=0.6)
    largest = max(1.5, 0.55 * float(np.nanmax(compared.normalized_residuals, initial=0.0)))
    if largest > _MAX_LINEAR:
        residual_axes.set_yscale("symlog", linthresh=1.0)
    residual_axes.set_ylim(-largest, largest)
    residual_axes.set_ylabel("residual / U")
    omitted = int((~is_fitted).sum())
    omission = f", {omitted} point{'s' if omitted > 1 else ''} omitted" if omitted else ""
    add_title(residual_axes, f"Residual {format_percent(compared.relative)} of the curve, rms{omission}")


def _model(scene: Scene, compared: Comparison) -> tuple[Array, Array]:
    """Return frequencies [Hz] and magnitudes, (responses, frequencies), of a fitted scene.

    Orbits of moving dampers are known only at the measured frequencies.
    """
    curves = compared.curves
    order = np.argsort(curves.frequency, kind="stable")
    frequency, magnitude = curves.frequency[order], np.asarray(abs(compared.predicted[:, order]), dtype=float)
    if not curves.is_linear:
        return frequency, magnitude
    test_scene, bodies = scene_of_test(scene, curves), list(curves.bodies)
    dense = np.unique(np.append(np.geomspace(frequency[0], frequency[-1], _MODEL_POINTS), frequency))
    model = abs(linear_response(test_scene, curves, dense)[0][bodies])
    # The readings contain the fitted deviations of the sensitivities.
    gains = np.median(magnitude / model[:, np.isin(dense, frequency)], axis=1, keepdims=True)
    return dense, np.asarray(model * gains, dtype=float)
