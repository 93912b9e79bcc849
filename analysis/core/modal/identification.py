"""Identification of natural frequencies, damping ratios and mode shapes from measured frequency responses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.modal.band_choice import band_choice
from analysis.core.modal.line_choice import are_in_gaps, is_peak, reduce_lines, scatter
from analysis.core.modal.lscf import ChartPole, merge_charts, stabilization_chart
from analysis.core.modal.mode_warnings import mode_warnings
from analysis.core.modal.modes import MAX_RELATIVE_UNCERTAINTY, Modes
from analysis.core.modal.order_selection import (
    MAX_MODES,
    are_in_band,
    are_narrower_than_resolution,
    better_model,
    have_same_poles,
    initial_model,
    select_model,
)
from analysis.core.modal.pole_errors import pole_errors, refined_pole_errors, systematic_pole_errors
from analysis.core.modal.pole_residue import Curves, ModalModel, fit, residual_terms
from analysis.core.modal.refinement import Refinement, refine
from analysis.core.modal.several_references import separate
from analysis.core.responses.systematic import ALIASING, IRREGULAR
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError, SceneError
from rig.core.numerics.blas_threads import with_one_blas_thread
from rig.core.results.response import Response, stack
from rig.core.results.uncertainty import expand, standard_of_limit

# A point has at least this relative error, so that a few points with a very small error do not determine the result.
MIN_RELATIVE_ERROR = 1e-4
# A second chart assumes this relative error, so that the whole curve has weight and not only its peaks.
_CHART_ERROR = 0.03
# Maximum number of initial poles.
_MAX_INITIAL_POLES = 15
# Maximum number of candidates for a further pole.
_MAX_CANDIDATES = 40
# Noise explains a misfit up to this multiple of its expected value. Above it, a model error is assumed.
_MAX_NOISE_RATIO = 4.0
# Model errors relative to the highest neighboring magnitude, which are assumed in this order until they and the noise
# explain the misfit.
_MODEL_ERRORS = (0.0, 0.01, 0.03, 0.1, 0.2, 0.4)
# For the model error, two lines are neighbors if their frequencies differ by at most this ratio.
_NEIGHBOR_FREQUENCY_RATIO = 1.15
# Maximum number of covariances of two responses at a line; a larger model is not refined, because their arrays would
# take half a gigabyte.
_MAX_COVARIANCES = 1 << 22
# The error of a line with fewer degrees of freedom than this is combined with the errors of neighboring lines.
_MIN_DEGREES = 10.0


@with_one_blas_thread
def identify(frfs: Response | Sequence[Response], count: int | None = None) -> Modes:
    """Identify the common modes of a set of frequency responses of one test.

    The initial poles are taken from stabilization charts (least-squares complex frequency domain). Poles and residues
    are refined by weighted least squares, with the error bar of each point as its weight. Poles that do not improve
    the fit beyond noise are removed, and further candidates are tried, until only significant poles remain. If the
    residuals of the best model exceed the error bars, as for a structure with nonlinear dampers, the points are
    weighted by the model error. The standard deviations are computed from the residuals.

    Parameters
    ----------
    frfs : sequence of Response
        Responses to one reference at equal frequencies; or a `Response` to several inputs, which allows the
        separation of close and repeated modes.
    count : int, optional
        Largest number of modes; all significant modes if omitted.

    Returns
    -------
    Modes
        Natural frequencies, damping ratios and shapes, with standard uncertainties.

    Raises
    ------
    RecordingError
        If there are too few frequencies, or if no mode is identified.
    SceneError
        If `count` is below 1, if `frfs` contains no responses, or if their frequencies differ.
    """
    if count is not None and not (isinstance(count, int) and count >= 1):
        raise SceneError(f"number of modes: got {count}; expected 1 or more")
    is_valid = isinstance(frfs, Sequence | Response) and all(isinstance(frf, Response) for frf in frfs)
    if is_valid and not isinstance(frfs, Response) and any(not frf.is_curve for frf in frfs):
        raise SceneError(
            "identify: got a list of responses with several curves each; expected the curves of one test. Give one "
            "element of the list."
        )
    if not is_valid or not len(frfs):
        raise SceneError(
            f"identify: got {frfs!r:.60}; expected several curves, as analysis.frfs or read_frfs returns them"
        )
    if isinstance(frfs, Response) and len(frfs.inputs) > 1:
        matrix = frfs
        return separate(
            identify(list(matrix), count),
            matrix.keys(),
            tuple(f"{point.quantity} at {point.place or point.name}" for point in matrix.inputs),
            tuple(point.place for point in matrix.outputs),
        )
    all_lines = [frf.to("displacement").sorted() for frf in frfs]
    curves = _remove_unbounded(reduce_lines(all_lines))
    fitted = _fit_modes(curves, count)
    measured, charts, weighted, model, model_error, rejected = fitted
    refinement = None if model_error else _refine(weighted, model, curves)
    if refinement is not None:
        model = refinement.model
    accepted = are_in_band(weighted, model.poles)
    choice = None
    if not any(curve.degrees.any() for curve in curves):
        choice = band_choice(
            all_lines[0].frequency, model.poles, lambda lines: _poles_of_lines(all_lines, lines, count)
        )
        rejected += (abs(model.poles[accepted & ~choice.confirmed]) / (2 * np.pi)).tolist()
        accepted &= choice.confirmed
    if not accepted.any():
        raise RecordingError(
            f"{curves[0].label}: no resonance is higher than the noise and wider than the frequency resolution. "
            "Measure for longer, with a smaller frequency step, or in another band."
        )
    included: tuple[str, ...] = ()
    if refinement is None:
        random_errors = pole_errors(weighted, model)
    else:
        included, random_errors = refinement.included, refined_pole_errors(model.poles, refinement.covariance)
    systematic = systematic_pole_errors(curves, model.poles, included)
    frequency_error, damping_error = (
        np.hypot(*errors) for errors in zip(random_errors, map(standard_of_limit, systematic), strict=True)
    )
    if choice is not None:
        frequency_error = np.hypot(frequency_error, choice.frequency_error)
        damping_error = np.hypot(damping_error, choice.damping_error)
    # The frequency of a pole is unknown if the uncertainty of the curves is unbounded.
    frequency: Array = np.asarray(abs(model.poles) / (2 * np.pi), dtype=float)
    is_unbounded = accepted & (expand(frequency_error) >= frequency)
    is_in_gap = accepted & ~is_unbounded & are_in_gaps(weighted.frequency, model.poles)
    accepted &= ~(is_unbounded | is_in_gap)
    uncertain, unmeasured = frequency[is_unbounded], frequency[is_in_gap]
    if not accepted.any() and unmeasured.size:
        raise RecordingError(
            f"{curves[0].label}: all resonances ({', '.join(f'{f:.4g}' for f in unmeasured)} Hz) lie where points of "
            "the curves were left out. `analysis frf` prints the reasons; correct them, and record again."
        )
    if not accepted.any():
        raise RecordingError(
            f"{curves[0].label}: all resonances ({', '.join(f'{f:.4g}' for f in uncertain)} Hz) lie where the "
            "uncertainty of the curves is too large. Reduce the largest contributions to the uncertainty, which "
            "`analysis frf` lists."
        )
    poles, frequency = model.poles[accepted], frequency[accepted]
    frequency_error, damping_error = frequency_error[accepted], damping_error[accepted]
    # A clock error shifts all poles by the same relative amount; it is a common error of all lines.
    clock = max(curve.uncertainty.clock for curve in frfs)
    frequency_error = np.hypot(frequency_error, standard_of_limit(clock * abs(poles) / (2 * np.pi)))
    lower, upper = _residual_terms(model, accepted, measured.frequency)
    result = Modes(
        frequency=frequency,
        frequency_error=frequency_error,
        damping=-poles.real / abs(poles),
        damping_error=damping_error,
        shape_error=_shape_errors(curves, poles, model.residue[:, accepted]),
        residue=model.residue[:, accepted],
        responses=tuple(curve.response for curve in curves),
        chart=tuple(charts[0]),
        lower=lower,
        upper=upper,
        model_error=model_error,
        label=curves[0].label,
        warnings=(),
        input=curves[0].input,
        places=tuple(curve.output_at for curve in curves),
    )
    unused = [frf.response for frf in frfs if frf.response not in result.responses]
    notes = mode_warnings(result, curves, count, rejected, uncertain, unmeasured, unused)
    return replace(result, warnings=(*curves[0].warnings, *notes))


class _FittedModes(NamedTuple):
    """A modal model of curves, whose poles are not yet examined for being modes."""

    measured: Curves
    charts: list[list[ChartPole]]
    weighted: Curves
    model: ModalModel
    model_error: float
    rejected: list[float]


def _fit_modes(curves: Sequence[Response], count: int | None) -> _FittedModes:
    """Fit the model of significant poles to curves."""
    measured, sigma = _measured(curves)
    magnitude = abs(measured.value)
    equal_weights = np.ones(sigma.shape) / magnitude.max(axis=1, keepdims=True)
    weights = (equal_weights, 1.0 / np.hypot(sigma, _CHART_ERROR * magnitude))
    charts = [stabilization_chart(measured.frequency, measured.value, weight) for weight in weights]
    stable, candidates = merge_charts(measured.frequency, charts)
    stable, candidates = stable[:_MAX_INITIAL_POLES], candidates[:_MAX_CANDIDATES]
    max_modes = MAX_MODES if count is None else count
    weighted, model, model_error = _best_model(measured, sigma, stable, candidates, max_modes)
    model, rejected = _remove_spurious_poles(weighted, model, curves)
    return _FittedModes(measured, charts, weighted, model, model_error, rejected)


def _poles_of_lines(curves: Sequence[Response], lines: NDArray[np.intp], count: int | None) -> ComplexArray:
    """Identify the poles of some lines of curves."""
    fitted = _fit_modes(_remove_unbounded(reduce_lines([curve.at(lines) for curve in curves])), count)
    return fitted.model.poles[are_in_band(fitted.weighted, fitted.model.poles)]


def _shape_errors(curves: Sequence[Response], poles: ComplexArray, residue: ComplexArray) -> Array:
    """Return standard uncertainties of shapes with largest element 1, from the curves at resonance.

    Errors of the reference, of the clock and of readings that curves have in common change all elements alike. They
    cancel in the ratio of two curves. The result has the shape (responses, modes).
    """
    frequency: Array = np.asarray(abs(poles) / (2 * np.pi), dtype=float)
    largest = np.argmax(abs(residue), axis=0)
    error: Array = np.zeros(residue.shape)
    for row in np.unique(largest).tolist():
        modes = np.flatnonzero(largest == row)
        for k in np.delete(np.arange(len(curves)), row).tolist():
            is_common = np.isfinite(curves[k].value) & np.isfinite(curves[row].value)
            element, scale = (
                curve.at(_nearest(curve, frequency[modes], is_common)) for curve in (curves[k], curves[row])
            )
            ratio = element.uncertainty.of_ratio(scale.uncertainty, element.value, scale.value)
            error[k, modes] = ratio.combined()
    return error


def _nearest(curve: Response, frequency: Array, selected: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the nearest of the selected lines of a curve to each of some frequencies, Hz."""
    lines = np.flatnonzero(selected)
    return np.asarray(lines[np.argmin(abs(curve.frequency[lines] - frequency[:, None]), axis=1)])


def _remove_unbounded(curves: Sequence[Response]) -> list[Response]:
    """Remove responses with unbounded uncertainty, which have zero weight."""
    bounded = [curve for curve in curves if np.isfinite(_standard_deviations([curve])).any()]
    if not bounded:
        raise RecordingError(
            f"{curves[0].label}: the uncertainty of the responses at {', '.join(curve.response for curve in curves)} "
            "is unbounded, because the readings are only a few counts of the converter or the reference may be zero. "
            "Record again at a higher level, with a smaller converter range or with more sensitive sensors."
        )
    return bounded


def _measured(curves: Sequence[Response]) -> tuple[Curves, Array]:
    """Return the responses at lines where all are measured, and their standard deviations."""
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
            "each resonance."
        )
    for curve, row in zip(curves, value[:, valid], strict=True):
        if not np.any(abs(row) > 0):
            raise RecordingError(f"{curve.label}: {curve.response} is zero throughout. Choose other channels.")
    sigma = sigma[:, valid]
    shared = max(curve.uncertainty.shared for curve in curves)
    resolution = max(curve.resolution for curve in curves)
    references = len({curve.inputs for curve in curves})
    return Curves(frequency[valid], value[:, valid], 1.0 / sigma, shared, resolution, references), sigma


def _best_model(
    measured: Curves, sigma: Array, stable: ComplexArray, candidates: ComplexArray, max_modes: int
) -> tuple[Curves, ModalModel, float]:
    """Return the curves with the weights of the best fit, its model, and the model's relative error.

    The relative error is the root mean square of the residual over the highest neighboring magnitude; 0 if noise
    explains the residual.
    """
    # Nonlinear errors are proportional to the peaks, not to the curve between them.
    frequency, magnitude = measured.frequency, np.abs(measured.value)
    first = np.searchsorted(frequency, frequency / _NEIGHBOR_FREQUENCY_RATIO)
    stop = np.searchsorted(frequency, frequency * _NEIGHBOR_FREQUENCY_RATIO, side="right")
    local_peak = np.stack([magnitude[:, begin:end].max(axis=1) for begin, end in zip(first, stop, strict=True)], axis=1)
    models: list[tuple[Curves, ModalModel]] = []
    for error in _MODEL_ERRORS:
        curves = replace(measured, weight=1.0 / np.hypot(sigma, error * local_peak), has_model_error=error > 0.0)
        initial = initial_model(curves, stable)
        model = select_model(curves, initial, candidates, max_modes)
        if models:
            # Poles that are significant only in combination may be removed one by one. The poles of the previous model
            # are therefore tried as initial values, too. Often both initial models are the same.
            other_initial = initial_model(curves, models[-1][1].poles)
            if not have_same_poles(initial, other_initial):
                model = better_model(curves, model, select_model(curves, other_initial, candidates, max_modes))
        models.append((curves, model))
        if model.misfit < _MAX_NOISE_RATIO * curves.degrees_of_freedom(model.poles.size):
            break
    # A model error relative to neighboring peaks may exceed a peak of one or two lines and hide its mode. The model
    # with the most modes of this kind is therefore used if the last model has fewer.
    n_narrow_modes = [
        int((are_in_band(curves, model.poles) & are_narrower_than_resolution(curves, model.poles)).sum())
        for curves, model in models
    ]
    curves, model = models[int(np.argmax(n_narrow_modes)) if max(n_narrow_modes) > n_narrow_modes[-1] else -1]
    # Points of zero weight are not fitted, and points of zero value have no relative error.
    scale = curves.weight * local_peak
    relative = np.divide(model.residual, scale, out=np.zeros_like(model.residual), where=scale > 0.0)
    relative_error = np.linalg.norm(relative) / np.sqrt(curves.degrees_of_freedom(model.poles.size))
    # A smaller error may be due to modes far outside the band, which deviate slightly from their residual terms.
    is_nonlinear = len(models) > 1 and relative_error > MIN_RELATIVE_ERROR
    return curves, model, float(relative_error) if is_nonlinear else 0.0


def _remove_spurious_poles(
    curves: Curves, model: ModalModel, frfs: Sequence[Response]
) -> tuple[ModalModel, list[float]]:
    """Remove poles that are not modes; also return their frequencies, Hz.

    A pole is not a mode if its damping is undetermined. A pole is not a mode either if its peak is small relative to
    the systematic uncertainty of every curve, because residual transients and aliasing cause similar peaks. A distinct
    peak that is narrower than the resolution is accepted although its damping is undetermined.
    """
    rejected: list[float] = []
    while model.poles.size:
        _, damping_error = pole_errors(curves, model)
        relative_damping_error = damping_error * abs(model.poles) / -model.poles.real
        relative_uncertainty = np.where(
            are_in_band(curves, model.poles),
            np.maximum(relative_damping_error, MAX_RELATIVE_UNCERTAINTY * _systematic_ratio(model, frfs)),
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


def _refine(weighted: Curves, model: ModalModel, frfs: Sequence[Response]) -> Refinement | None:
    """Refine the model with the covariance of all responses; return None if it is not known or too large."""
    if any(frf.uncertainty.errors is None for frf in frfs):
        return None
    if len(frfs) ** 2 * weighted.frequency.size > _MAX_COVARIANCES:
        return None
    lines = np.searchsorted(frfs[0].frequency, weighted.frequency)
    curves = [frf.at(lines) for frf in frfs]
    errors = stack(curves).covariance()
    magnitude = np.stack([abs(frf.value) for frf in curves])
    line_deviation = np.hypot(standard_of_limit(_systematic_bound(curves, IRREGULAR)), MIN_RELATIVE_ERROR * magnitude)
    if not (np.isfinite(errors.lines).all() and np.isfinite(line_deviation).all()):
        return None
    return refine(weighted, model, errors, line_deviation)


def _systematic_ratio(model: ModalModel, frfs: Sequence[Response]) -> Array:
    """Return the ratio of systematic uncertainty to peak height at each pole, in the curve with the smallest ratio."""
    frequency: Array = np.asarray(abs(model.poles) / (2 * np.pi), dtype=float)
    bounds = [
        bound[_nearest(frf, frequency, np.isfinite(frf.value + bound))]
        for frf, bound in zip(frfs, _systematic_bound(frfs, (*IRREGULAR, ALIASING)), strict=True)
    ]
    height = abs(model.residue) / -model.poles.real
    return np.asarray(np.min(bounds / np.maximum(height, 1e-300), axis=0))


def _residual_terms(model: ModalModel, accepted: NDArray[np.bool_], frequency: Array) -> tuple[Array, Array]:
    """Return `Modes.lower` and `Modes.upper`, with the contributions of the fitted modes that are not accepted."""
    s = 2j * np.pi * frequency
    contribution = np.zeros((model.residue.shape[0], s.size), dtype=complex)
    for pole, residue in zip(model.poles[~accepted], model.residue[:, ~accepted].T, strict=True):
        contribution += residue[:, None] / (s - pole) + residue.conj()[:, None] / (s - pole.conjugate())
    terms = np.stack(residual_terms(s), axis=1)
    scale = abs(terms).max(axis=0)
    columns, target = (np.concatenate([part.real, part.imag]) for part in (terms / scale, contribution.T))
    factors = np.linalg.lstsq(columns, target, rcond=None)[0].T / scale
    return model.lower + factors[:, 0], model.upper + factors[:, 1:]


def _standard_deviations(curves: Sequence[Response]) -> Array:
    """Return the standard deviation of either quadrature component of each line, shape (responses, lines)."""
    magnitude = np.stack([abs(curve.value) for curve in curves])
    error = np.stack([curve.error for curve in curves])
    for row, curve in zip(error, curves, strict=True):
        finite = np.isfinite(row)
        if not finite.all():
            row[~finite] = scatter(curve.value)[~finite]
        if not curve.degrees.any():
            # The errors that a file gives may be incomplete; the scatter between its lines is their lower bound.
            row[:] = np.maximum(row, scatter(curve.value))
        row[:] = np.maximum(row, _local_median(row, curve.degrees))
    # Systematic errors that differ from line to line act like noise. Smooth errors do not resemble a mode.
    error = np.hypot(error, standard_of_limit(_systematic_bound(curves, IRREGULAR)))
    largest = np.nanmax(magnitude, axis=1, keepdims=True)
    return np.hypot(error, MIN_RELATIVE_ERROR * np.maximum(magnitude, 1e-6 * largest))


def _local_median(error: Array, degrees_of_freedom: Array) -> Array:
    """Return the median error over enough lines for `_MIN_DEGREES`; 0 if each line has enough, or if they are unknown.

    Errors estimated from few segments may be close to zero by chance, and such lines would dominate the fit.
    """
    median_degrees = float(np.median(degrees_of_freedom))
    if not 0.0 < median_degrees < _MIN_DEGREES:
        return np.zeros(error.size)
    return np.asarray(
        scipy.ndimage.median_filter(error, min(1 + 2 * int(_MIN_DEGREES / median_degrees), error.size), mode="nearest")
    )


def _systematic_bound(curves: Sequence[Response], names: Sequence[str]) -> Array:
    """Return the root sum of squares of some systematic errors, shape (responses, lines); infinite if unknown."""
    bounds = [[curve.limits.get(name, np.zeros(curve.value.size)) for name in names] for curve in curves]
    return np.asarray(np.nan_to_num(np.linalg.norm(bounds, axis=1), nan=np.inf, posinf=np.inf))
