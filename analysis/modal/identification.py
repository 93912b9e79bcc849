"""Natural frequencies, damping ratios and shapes from measured frequency responses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.modal.line_choice import in_gaps, is_peak, scatter, thin_out
from analysis.modal.lscf import chart, merge_charts
from analysis.modal.mode_warnings import mode_warnings
from analysis.modal.modes import MAX_RELATIVE_UNCERTAINTY, Modes
from analysis.modal.order_selection import MAX_MODES, better_model, in_band, narrower_than_resolution, select
from analysis.modal.pole_errors import pole_errors, refined_pole_errors, systematic_pole_errors
from analysis.modal.pole_residue import Curves, Fit, fit, residual_terms
from analysis.modal.refinement import Refinement, refine
from analysis.modal.several_references import separate
from analysis.responses.systematic import ALIASING, ROUGH
from rig.arrays import Array, ComplexArray
from rig.errors import RecordingError, SceneError
from rig.results.response import Response, stack

# Smallest relative error assigned to a point, so that a few points of very small error do not determine the result.
MIN_RELATIVE_ERROR = 1e-4
# Relative error for a second chart, which weights the whole curve and not only its peaks.
_CHART_ERROR = 0.03
# Limit of the number of initial poles.
_MAX_INITIAL_POLES = 15
# Limit of the number of candidates in the search for a further pole.
_MAX_CANDIDATES = 40
# A misfit above this multiple of the noise power is not noise: the structure is nonlinear.
_MAX_NOISE_RATIO = 4.0
# Model errors relative to the neighboring peaks, assumed in this order.
_MODEL_ERRORS = (0.0, 0.01, 0.03, 0.1, 0.2, 0.4)
# The neighborhood of a frequency extends by this factor in both directions.
_NEIGHBORHOOD_RATIO = 1.15
# With fewer degrees of freedom, a line's own error is uncertain and the neighboring errors are used too.
_MIN_DEGREES = 10.0
# Ratio of a limit of error to its standard uncertainty.
_LIMIT_FACTOR = 1.8


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

    Raises
    ------
    RecordingError
        If there are too few frequencies, or if no mode is identified.
    SceneError
        If `count` is below 1, if `frfs` contains no responses, or if their frequencies differ.
    """
    if count is not None and not (isinstance(count, int) and count >= 1):
        raise SceneError(f"identify: count {count}; expected at least 1 mode")
    is_valid = isinstance(frfs, Sequence | Response) and all(isinstance(frf, Response) for frf in frfs)
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
    curves = _remove_unbounded(thin_out([frf.to("displacement").sorted() for frf in frfs]))
    measured, sigma = _measured(curves)
    size = abs(measured.value)
    weights = (np.ones(sigma.shape) / size.max(axis=1, keepdims=True), 1.0 / np.hypot(sigma, _CHART_ERROR * size))
    charts = [chart(measured.frequency, measured.value, weight) for weight in weights]
    stable, candidates = merge_charts(measured.frequency, charts)
    stable, candidates = stable[:_MAX_INITIAL_POLES], candidates[:_MAX_CANDIDATES]
    weighted, model, error = _best_model(measured, sigma, stable, candidates, MAX_MODES if count is None else count)
    weighted, model, dropped = _remove_spurious_poles(weighted, model, curves)
    refinement = None if error else _refine(weighted, model, curves)
    if refinement is not None:
        model = refinement.model
    inside = in_band(weighted, model.poles)
    if not inside.any():
        raise RecordingError(
            f"{curves[0].label}: no resonance exceeds the noise and the resolution of the curves. Measure for longer, "
            "more densely around the resonances, or in another band."
        )
    # Expanded uncertainties (95 %) are twice the standard uncertainties.
    included: tuple[str, ...] = ()
    if refinement is None:
        random_errors = pole_errors(weighted, model)
    else:
        included, random_errors = refinement.parts, refined_pole_errors(model.poles, refinement.covariance)
    systematic = systematic_pole_errors(curves, model.poles, included)
    f_error, z_error = (
        np.hypot(*pair) for pair in zip(random_errors, (0.5 * part for part in systematic), strict=True)
    )
    # The frequency of a pole is unknown if the uncertainty of the curves is unbounded.
    frequency: Array = np.asarray(abs(model.poles) / (2 * np.pi), dtype=float)
    unbounded = inside & (2.0 * f_error >= frequency)
    gaps = inside & ~unbounded & in_gaps(weighted.frequency, model.poles)
    inside &= ~(unbounded | gaps)
    uncertain, unmeasured = frequency[unbounded], frequency[gaps]
    if not inside.any() and unmeasured.size:
        raise RecordingError(
            f"{curves[0].label}: the poles ({', '.join(f'{f:.4g}' for f in unmeasured)} Hz) lie only where lines were "
            "excluded. Correct the faults in the warnings and record again."
        )
    if not inside.any():
        raise RecordingError(
            f"{curves[0].label}: poles ({', '.join(f'{f:.4g}' for f in uncertain)} Hz) only where the uncertainty of "
            "the curves is too large. Reduce the largest parts of the uncertainty that `analysis frf` lists."
        )
    poles, frequency = model.poles[inside], frequency[inside]
    f_error, z_error = f_error[inside], z_error[inside]
    # A clock error shifts all poles by the same relative amount; it is a common error of all lines.
    clock = max(curve.uncertainty.clock for curve in frfs)
    f_error = np.hypot(f_error, clock * abs(poles) / (2 * np.pi * _LIMIT_FACTOR))
    lower, upper = _residuals(model, inside, measured.frequency)
    result = Modes(
        frequency=frequency,
        frequency_error=f_error,
        damping=-poles.real / abs(poles),
        damping_error=z_error,
        shape_error=_shape_errors(curves, poles, model.residue[:, inside]),
        residue=model.residue[:, inside],
        responses=tuple(curve.response for curve in curves),
        chart=tuple(charts[0]),
        lower=lower,
        upper=upper,
        model_error=error,
        label=curves[0].label,
        warnings=(),
        input=curves[0].input,
        places=tuple(curve.output_at for curve in curves),
    )
    unused = [frf.response for frf in frfs if frf.response not in result.responses]
    notes = mode_warnings(result, curves, count, dropped, uncertain, unmeasured, unused)
    return replace(result, warnings=(*curves[0].warnings, *notes))


def _shape_errors(curves: Sequence[Response], poles: ComplexArray, residue: ComplexArray) -> Array:
    """Estimate standard deviations of shapes with largest element 1, from the uncertainty of the curves at resonance.

    An error of the reference sensor is common to all curves.
    """
    frequency: Array = np.asarray(abs(poles) / (2 * np.pi), dtype=float)
    lines = [_nearest(curve, frequency, np.isfinite(curve.value)) for curve in curves]
    size = np.array([abs(curve.value[nearest]) for curve, nearest in zip(curves, lines, strict=True)])
    expanded = np.array([curve.bound()[nearest] for curve, nearest in zip(curves, lines, strict=True)])
    expanded -= np.array([[curve.uncertainty.scale] for curve in curves]) * size
    top, modes = np.argmax(abs(residue), axis=0), np.arange(poles.size)
    element = abs(residue) / abs(residue[top, modes])
    error: Array = 0.5 * np.hypot(expanded, element * expanded[top, modes]) / size[top, modes]
    error[top, modes] = 0.0
    return error


def _nearest(curve: Response, frequency: Array, selected: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the selected lines of a curve that are nearest to other frequencies."""
    lines = np.flatnonzero(selected)
    return np.asarray(lines[np.argmin(abs(curve.frequency[lines] - frequency[:, None]), axis=1)])


def _remove_unbounded(curves: Sequence[Response]) -> list[Response]:
    """Remove responses with unbounded uncertainty, which have zero weight."""
    bounded = [curve for curve in curves if np.isfinite(_sigma([curve])).any()]
    if not bounded:
        raise RecordingError(
            f"{curves[0].label}: the uncertainty of the responses at {', '.join(curve.response for curve in curves)} "
            "is unbounded, because the readings are a few counts or the reference may be zero. Record again with a "
            "converter range and sensors that suit the level."
        )
    return bounded


def _measured(curves: Sequence[Response]) -> tuple[Curves, Array]:
    """Return the responses at lines where all are measured, and their standard deviations."""
    frequency = curves[0].frequency
    if any(curve.frequency.shape != frequency.shape or np.any(curve.frequency != frequency) for curve in curves):
        raise SceneError(
            f"identify: {curves[0].label}: the responses have different frequencies. Identify one recording at a time."
        )
    value, sigma = np.stack([curve.value for curve in curves]), _sigma(curves)
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
    return Curves(frequency[valid], value[:, valid], 1.0 / sigma, shared, resolution), sigma


def _best_model(
    measured: Curves, sigma: Array, stable: ComplexArray, candidates: ComplexArray, max_modes: int
) -> tuple[Curves, Fit, float]:
    """Return the best model, the curves with the weights of its fit, and its relative error beyond noise."""
    # Largest value around each point. Nonlinear errors are proportional to the peaks, not to the curve between them.
    f, value = measured.frequency, np.abs(measured.value)
    low, high = (np.searchsorted(f, f / _NEIGHBORHOOD_RATIO), np.searchsorted(f, f * _NEIGHBORHOOD_RATIO, side="right"))
    size = np.stack([value[:, a:b].max(axis=1) for a, b in zip(low, high, strict=True)], axis=1)
    models: list[tuple[Curves, Fit]] = []
    for error in _MODEL_ERRORS:
        curves = replace(measured, weight=1.0 / np.hypot(sigma, error * size))
        model = select(curves, stable, candidates, max_modes)
        if models:
            # Poles that are significant only in combination may be removed individually. The previous poles are
            # therefore further initial values.
            model = better_model(curves, model, select(curves, models[-1][1].poles, candidates, max_modes))
        models.append((curves, model))
        if model.misfit < _MAX_NOISE_RATIO * curves.degrees(model.poles.size):
            break
    # The model error is relative to neighboring peaks, so it may exceed a peak of one or two lines and hide its
    # mode.
    narrow = [
        int((in_band(curves, model.poles) & narrower_than_resolution(curves, model.poles)).sum())
        for curves, model in models
    ]
    curves, model = models[int(np.argmax(narrow)) if max(narrow) > narrow[-1] else -1]
    # Points of zero weight are not fitted, and points of zero value have no relative error.
    scale = curves.weight * size
    relative = np.divide(model.residual, scale, out=np.zeros_like(model.residual), where=scale > 0.0)
    relative_error = np.linalg.norm(relative) / np.sqrt(curves.degrees(model.poles.size))
    # Modes far outside the band deviate slightly from their residual terms, which does not indicate a nonlinear
    # structure.
    is_nonlinear = len(models) > 1 and relative_error > MIN_RELATIVE_ERROR
    return curves, model, float(relative_error) if is_nonlinear else 0.0


def _remove_spurious_poles(curves: Curves, model: Fit, frfs: Sequence[Response]) -> tuple[Curves, Fit, list[float]]:
    """Remove poles that are not modes; also return their frequencies, in Hz.

    A pole is not a mode if its damping is undetermined, or if its peak is below the systematic uncertainty of every
    curve, because residual transients and images cause similar peaks. A distinct peak narrower than the resolution is
    accepted as a mode, because its width cannot be measured.
    """
    dropped: list[float] = []
    while model.poles.size:
        _, z_error = pole_errors(curves, model)
        damping = z_error * abs(model.poles) / -model.poles.real
        relative_uncertainty = np.where(
            in_band(curves, model.poles),
            np.maximum(damping, MAX_RELATIVE_UNCERTAINTY * _systematic_ratio(model, frfs)),
            0.0,
        )
        for k in np.flatnonzero(narrower_than_resolution(curves, model.poles)):
            line = int(np.argmin(abs(curves.frequency - abs(model.poles[k]) / (2 * np.pi))))
            relative_uncertainty[k] = 0.0 if any(is_peak(abs(row), line) for row in curves.value) else np.inf
        worst = int(np.argmax(relative_uncertainty))
        if relative_uncertainty[worst] < MAX_RELATIVE_UNCERTAINTY:
            break
        dropped.append(abs(model.poles[worst]) / (2 * np.pi))
        model = fit(curves, np.delete(model.poles, worst))
    return curves, model, dropped


def _refine(weighted: Curves, model: Fit, frfs: Sequence[Response]) -> Refinement | None:
    """Refine with the covariance of all responses; return None if only their standard deviations are known."""
    if any(frf.uncertainty.errors is None for frf in frfs):
        return None
    lines = np.searchsorted(frfs[0].frequency, weighted.frequency)
    curves = [frf.at(lines) for frf in frfs]
    errors = stack(curves).covariance()
    size = np.stack([abs(frf.value) for frf in curves])
    rough = np.hypot(0.5 * _limit(curves, ROUGH), MIN_RELATIVE_ERROR * size)
    if not (np.isfinite(errors.lines).all() and np.isfinite(rough).all()):
        return None
    return refine(weighted, model, errors, rough)


def _systematic_ratio(model: Fit, frfs: Sequence[Response]) -> Array:
    """Return the ratio of systematic uncertainty to peak height at each pole, in the curve with the smallest ratio."""
    frequency: Array = np.asarray(abs(model.poles) / (2 * np.pi), dtype=float)
    limit = [
        part[_nearest(frf, frequency, np.isfinite(frf.value + part))]
        for frf, part in zip(frfs, _limit(frfs, (*ROUGH, ALIASING)), strict=True)
    ]
    height = abs(model.residue) / -model.poles.real
    return np.asarray(np.min(limit / np.maximum(height, 1e-300), axis=0))


def _residuals(model: Fit, inside: NDArray[np.bool_], frequency: Array) -> tuple[Array, Array]:
    """Sum the contributions of modes outside the band, including fitted modes."""
    s = 2j * np.pi * frequency
    contribution = np.zeros((model.residue.shape[0], s.size), dtype=complex)
    for p, residue in zip(model.poles[~inside], model.residue[:, ~inside].T, strict=True):
        contribution += residue[:, None] / (s - p) + residue.conj()[:, None] / (s - p.conjugate())
    terms = np.stack(residual_terms(s), axis=1)
    size = abs(terms).max(axis=0)
    columns, target = (np.concatenate([part.real, part.imag]) for part in (terms / size, contribution.T))
    factors = np.linalg.lstsq(columns, target, rcond=None)[0].T / size
    return model.lower + factors[:, 0], model.upper + factors[:, 1:]


def _sigma(curves: Sequence[Response]) -> Array:
    size = np.stack([abs(curve.value) for curve in curves])
    error = np.stack([curve.error for curve in curves])
    for row, curve in zip(error, curves, strict=True):
        finite = np.isfinite(row)
        if not finite.all():
            row[~finite] = scatter(curve.value)[~finite]
        if not curve.degrees.any():
            # The errors stated in a file may be incomplete; the scatter of its lines is a lower limit.
            row[:] = np.maximum(row, scatter(curve.value))
        row[:] = np.maximum(row, _local_median(row, curve.degrees))
    # Errors that differ from line to line act like noise. Smooth errors do not resemble a mode.
    error = np.hypot(error, 0.5 * _limit(curves, ROUGH))
    top = np.nanmax(size, axis=1, keepdims=True)
    return np.hypot(error, MIN_RELATIVE_ERROR * np.maximum(size, 1e-6 * top))


def _local_median(error: Array, degrees: Array) -> Array:
    """Return the median of errors over enough lines for the required degrees of freedom; 0 if each line has enough.

    Errors estimated from few parts may be close to zero by chance, and such lines would dominate the fit.
    """
    median_degrees = float(np.median(degrees))
    if not 0.0 < median_degrees < _MIN_DEGREES:
        return np.zeros(error.size)
    return np.asarray(
        scipy.ndimage.median_filter(error, min(1 + 2 * int(_MIN_DEGREES / median_degrees), error.size), mode="nearest")
    )


def _limit(curves: Sequence[Response], names: Sequence[str]) -> Array:
    """Return the limit of error of each line by some systematic parts; infinite if a part is unknown."""
    parts = [[curve.limits.get(name, np.zeros(curve.value.size)) for name in names] for curve in curves]
    return np.asarray(np.nan_to_num(np.linalg.norm(parts, axis=1), nan=np.inf, posinf=np.inf))
