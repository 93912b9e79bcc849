"""Fit of the significant poles to the curves in a band or a part of it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.modal.line_choice import is_peak, scatter
from analysis.core.modal.modes import MAX_RELATIVE_UNCERTAINTY
from analysis.core.modal.pole_errors import pole_errors
from analysis.core.modal_models.lscf import ChartPole, merge_charts, stabilization_diagram
from analysis.core.modal_models.order_selection import (
    MAX_MODES,
    are_in_band,
    are_narrower_than_resolution,
    better_model,
    have_same_poles,
    initial_model,
    select_model,
)
from analysis.core.modal_models.pole_residue import Curves, ModalModel, fit
from analysis.core.responses.errors.systematic import ALIASING, IRREGULAR
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError, SceneError
from rig.core.results.response import Response
from rig.core.results.uncertainty import standard_of_limit

# Smallest relative uncertainty of a point: a few precise points must not determine the result.
MIN_RELATIVE_ERROR = 1e-4
# A second chart assumes this relative uncertainty, so the whole curve has weight and not only its peaks.
_CHART_ERROR = 0.03
# Maximum number of initial poles.
_MAX_INITIAL_POLES = 15
# Maximum number of candidates for a further pole; each requires a linear fit.
_MAX_CANDIDATES = 40
# A misfit up to this multiple of its expected value is noise. For a larger misfit, a model error is assumed.
_MAX_NOISE_RATIO = 4.0
# Model errors relative to the highest neighboring magnitude, tried in this order until the misfit is that of noise.
MODEL_ERRORS = (0.0, 0.01, 0.03, 0.1, 0.2, 0.4)
# Lines are neighbors up to this frequency ratio: wider than a resonance, narrower than the spacing of most modes.
_NEIGHBOR_FREQUENCY_RATIO = 1.15
# Smallest number of degrees of freedom of a line whose uncertainty is not combined with its neighbors'.
_MIN_DEGREES = 10.0


class FittedModes(NamedTuple):
    """A modal model of curves, before its poles are tested for being modes."""

    measured: Curves
    weighted: Curves  # curves with the weights of the fit
    model: ModalModel
    chart: list[ChartPole]  # stabilization diagram with equal weights
    # Root mean square of the residual over the highest neighboring magnitude; 0 if it is consistent with noise.
    model_error: float
    assumed_error: float  # model error in the weights
    rejected: list[float]  # frequencies of poles that are not modes [Hz]


def fit_modes(
    curves: Sequence[Response], count: int | None = None, assumed_errors: Sequence[float] = MODEL_ERRORS
) -> FittedModes:
    """Fit the model of significant poles to curves, with the smallest model error that the misfit requires."""
    measured, sigma = measured_curves(curves)
    charts = stabilization_diagrams(measured, sigma)
    stable, candidates = merge_charts(measured.frequency, charts)
    stable, candidates = stable[:_MAX_INITIAL_POLES], candidates[:_MAX_CANDIDATES]
    max_modes = MAX_MODES if count is None else count
    weighted, model, model_error, assumed = _best_model(measured, sigma, stable, candidates, max_modes, assumed_errors)
    model, rejected = _remove_computational_poles(weighted, model, curves)
    return FittedModes(measured, weighted, model, charts[0], model_error, assumed, rejected)


def are_errors_stated(curves: Sequence[Response]) -> bool:
    """Return whether curves state their uncertainty, as curves from recordings and files of this program do."""
    return any(curve.degrees_of_freedom.any() or curve.limits for curve in curves)


def stabilization_diagrams(measured: Curves, sigma: Array) -> tuple[list[ChartPole], list[ChartPole]]:
    """Compute the diagrams with equal weights of all points of a curve, and with weights of the whole curve.

    `sigma`: standard deviations of the points.
    """
    magnitude = abs(measured.value)
    equal = np.ones(magnitude.shape) / magnitude.max(axis=1, keepdims=True)
    weights = equal, 1.0 / np.hypot(sigma, _CHART_ERROR * magnitude)
    first, second = (stabilization_diagram(measured.frequency, measured.value, weight) for weight in weights)
    return first, second


def remove_unbounded(curves: Sequence[Response]) -> list[Response]:
    """Remove responses with unbounded uncertainty, which have zero weight."""
    bounded = [curve for curve in curves if np.isfinite(_standard_deviations([curve])).any()]
    if not bounded:
        raise RecordingError(
            f"{curves[0].label}: the uncertainty of the responses at {', '.join(curve.response for curve in curves)} "
            "is unbounded, because the readings are only a few counts of the converter or the reference may be zero. "
            "Record again at a higher level, with a smaller converter range or with more sensitive sensors."
        )
    return bounded


def measured_curves(curves: Sequence[Response]) -> tuple[Curves, Array]:
    """Return the responses at the lines where all responses are measured, and the standard deviations."""
    frequency = curves[0].frequency
    if any(curve.frequency.shape != frequency.shape or np.any(curve.frequency != frequency) for curve in curves):
        raise SceneError(
            f"identify: {curves[0].label}: the responses have different frequencies. Identify one recording at a time."
        )
    value, sigma = np.stack([curve.value for curve in curves]), _standard_deviations(curves)
    # A line with unbounded uncertainty in every response has zero weight.
    valid = np.isfinite(value).all(axis=0) & (frequency > 0) & np.isfinite(sigma).any(axis=0)
    if valid.sum() < 8:
        raise RecordingError(
            f"{curves[0].label}: {valid.sum()} frequencies are too few for modes. Measure at least 8, with several in "
            "each resonance. For a test of phase resonance, run `analysis backbone`."
        )
    for curve, row in zip(curves, value[:, valid], strict=True):
        if not np.any(abs(row) > 0):
            raise RecordingError(f"{curve.label}: {curve.response} is zero throughout. Choose other channels.")
    sigma = sigma[:, valid]
    shared = max(curve.uncertainty.shared for curve in curves)
    resolution = max(curve.resolution for curve in curves)
    references = len({curve.inputs for curve in curves})
    are_stated = are_errors_stated(curves)
    return Curves(
        frequency[valid], value[:, valid], 1.0 / sigma, shared, resolution, references, are_errors_stated=are_stated
    ), sigma


def neighboring_maxima(frequency: Array, magnitude: Array) -> Array:
    """Return the largest magnitude among the neighbors of each line, (responses, n); `frequency`: ascending [Hz]."""
    first = np.searchsorted(frequency, frequency / _NEIGHBOR_FREQUENCY_RATIO)
    stop = np.searchsorted(frequency, frequency * _NEIGHBOR_FREQUENCY_RATIO, side="right")
    return np.stack([magnitude[:, begin:end].max(axis=1) for begin, end in zip(first, stop, strict=True)], axis=1)


def _best_model(
    measured: Curves,
    sigma: Array,
    stable: ComplexArray,
    candidates: ComplexArray,
    max_modes: int,
    assumed_errors: Sequence[float],
) -> tuple[Curves, ModalModel, float, float]:
    """Return the curves with the weights of the best fit, its model, the model's relative error and the assumed error.

    The relative error is the root mean square of the residual over the highest neighboring magnitude; 0 if the residual
    is consistent with noise.
    """
    # Errors due to nonlinearity are proportional to the peaks, not to the curve between the peaks.
    local_peak = neighboring_maxima(measured.frequency, np.abs(measured.value))
    models: list[tuple[Curves, ModalModel]] = []
    for error in assumed_errors:
        curves = replace(measured, weight=1.0 / np.hypot(sigma, error * local_peak), has_model_error=error > 0.0)
        initial = initial_model(curves, stable)
        model = select_model(curves, initial, candidates, max_modes)
        if models:
            # Poles that are significant only in combination may be removed one by one. Therefore the poles of the
            # previous model are tried as initial values, too, unless both initial models are the same.
            other_initial = initial_model(curves, models[-1][1].poles)
            if not have_same_poles(initial, other_initial):
                model = better_model(curves, model, select_model(curves, other_initial, candidates, max_modes))
        models.append((curves, model))
        if model.misfit < _MAX_NOISE_RATIO * curves.degrees_of_freedom(model.poles.size):
            break
    # A model error relative to neighboring peaks may exceed a peak of one or two lines and hide its mode. The last
    # model is therefore replaced with an earlier model if that has more modes of such peaks.
    n_narrow_modes = [
        int((are_in_band(curves, model.poles) & are_narrower_than_resolution(curves, model.poles)).sum())
        for curves, model in models
    ]
    best = int(np.argmax(n_narrow_modes)) if max(n_narrow_modes) > n_narrow_modes[-1] else len(models) - 1
    curves, model = models[best]
    # Points of zero weight are not fitted, and points of zero value have no relative error.
    scale = curves.weight * local_peak
    relative = np.divide(model.residual, scale, out=np.zeros_like(model.residual), where=scale > 0.0)
    relative_error = np.linalg.norm(relative) / np.sqrt(curves.degrees_of_freedom(model.poles.size))
    # A smaller misfit may be due to modes far outside the band, which the residual terms represent only approximately.
    is_nonlinear = models[-1][0].has_model_error and relative_error > MIN_RELATIVE_ERROR
    return curves, model, float(relative_error) if is_nonlinear else 0.0, assumed_errors[best]


def _remove_computational_poles(
    curves: Curves, model: ModalModel, frfs: Sequence[Response]
) -> tuple[ModalModel, list[float]]:
    """Remove poles that are not modes; return the new model, and the frequencies of the removed poles [Hz].

    A pole is not a mode if its damping is undetermined. A pole is not a mode either if its peak is small relative to
    the limit of the systematic error of every curve, because residual transients and aliasing cause similar peaks. A
    distinct peak that is narrower than the resolution is accepted although its damping is undetermined.
    """
    rejected: list[float] = []
    while model.poles.size:
        _, damping_std = pole_errors(curves, model)
        relative_damping_uncertainty = damping_std * abs(model.poles) / -model.poles.real
        relative_uncertainty = np.where(
            are_in_band(curves, model.poles),
            np.maximum(relative_damping_uncertainty, MAX_RELATIVE_UNCERTAINTY * _systematic_ratio(model, frfs)),
            0.0,
        )
        for k in np.flatnonzero(are_narrower_than_resolution(curves, model.poles)):
            line = int(np.argmin(abs(curves.frequency - abs(model.poles[k]) / (2 * np.pi))))
            relative_uncertainty[k] = 0.0 if any(is_peak(abs(row), line) for row in curves.value) else np.inf
        worst = int(np.argmax(relative_uncertainty))
        if relative_uncertainty[worst] < MAX_RELATIVE_UNCERTAINTY:
            break
        rejected.append(abs(model.poles[worst]) / (2 * np.pi))
        model = fit(curves, np.delete(model.poles, worst))
    return model, rejected


def _systematic_ratio(model: ModalModel, frfs: Sequence[Response]) -> Array:
    """Return the smallest ratio of the systematic limit of a curve to the peak height at each pole."""
    frequency: Array = np.asarray(abs(model.poles) / (2 * np.pi), dtype=float)
    bounds = [
        limit[nearest_lines(frf, frequency, np.isfinite(frf.value + limit))]
        for frf, limit in zip(frfs, systematic_limit(frfs, (*IRREGULAR, ALIASING)), strict=True)
    ]
    height = abs(model.residue) / -model.poles.real
    return np.asarray(np.min(bounds / np.maximum(height, 1e-300), axis=0))


def nearest_lines(curve: Response, frequency: Array, selected: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return, for each frequency in Hz, the nearest of the selected lines of a curve."""
    lines = np.flatnonzero(selected)
    return np.asarray(lines[np.argmin(abs(curve.frequency[lines] - frequency[:, None]), axis=1)])


def _standard_deviations(curves: Sequence[Response]) -> Array:
    """Return the standard deviation of the real and of the imaginary part of each line, shape (responses, lines)."""
    magnitude = np.stack([abs(curve.value) for curve in curves])
    error = np.stack([curve.error for curve in curves])
    for row, curve in zip(error, curves, strict=True):
        finite = np.isfinite(row)
        if not finite.all():
            row[~finite] = scatter(curve.value)[~finite]
        if not curve.degrees_of_freedom.any():
            # The uncertainty stated in a file may be incomplete. It is at least the scatter between the lines.
            row[:] = np.maximum(row, scatter(curve.value))
        row[:] = np.maximum(row, _local_median(row, curve.degrees_of_freedom))
    # Systematic errors that differ from line to line act like noise; smooth errors do not resemble a mode.
    error = np.hypot(error, standard_of_limit(systematic_limit(curves, IRREGULAR)))
    largest = np.nanmax(magnitude, axis=1, keepdims=True)
    return np.hypot(error, MIN_RELATIVE_ERROR * np.maximum(magnitude, 1e-6 * largest))


def _local_median(error: Array, degrees_of_freedom: Array) -> Array:
    """Return the median uncertainty of neighboring lines; 0 if degrees of freedom are sufficient or unknown."""
    # Errors estimated from few segments may be close to zero by chance, and such lines would dominate the fit.
    median_degrees = float(np.median(degrees_of_freedom))
    if not 0.0 < median_degrees < _MIN_DEGREES:
        return np.zeros(error.size)
    return np.asarray(
        scipy.ndimage.median_filter(error, min(1 + 2 * int(_MIN_DEGREES / median_degrees), error.size), mode="nearest")
    )


def systematic_limit(curves: Sequence[Response], names: Sequence[str]) -> Array:
    """Return the root sum of squares of the named systematic errors, shape (responses, lines); infinite if unknown."""
    bounds = [[curve.limits.get(name, np.zeros(curve.value.size)) for name in names] for curve in curves]
    return np.asarray(np.nan_to_num(np.linalg.norm(bounds, axis=1), nan=np.inf, posinf=np.inf))
