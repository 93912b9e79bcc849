"""Identification of natural frequencies, damping ratios and mode shapes from measured frequency responses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from analysis.core.modal.line_choice import are_in_gaps, reduce_lines
from analysis.core.modal.modal_fit import (
    MIN_RELATIVE_ERROR,
    FittedModes,
    are_errors_stated,
    fit_modes,
    measured_curves,
    nearest_lines,
    remove_unbounded,
    stabilization_diagrams,
    systematic_limit,
)
from analysis.core.modal.mode_warnings import mode_warnings, rejections
from analysis.core.modal.modes import Modes
from analysis.core.modal.pole_errors import pole_errors, refined_pole_errors, systematic_pole_errors
from analysis.core.modal.refinement import Refinement, refine
from analysis.core.modal.several_references import separate
from analysis.core.modal.window_fits import IdentifiedPoles, identify_windows, no_poles
from analysis.core.modal_models.lscf import ChartPole
from analysis.core.modal_models.order_selection import are_in_band
from analysis.core.modal_models.pole_residue import UPPER_TERMS, Curves, ModalModel, modal_receptance, residual_terms
from analysis.core.responses.errors.systematic import IRREGULAR
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError, SceneError
from rig.core.numerics.blas_threads import with_one_blas_thread
from rig.core.results.response import Response, stack
from rig.core.results.uncertainty import expand, standard_of_limit

# Maximum number of covariances at a line; the arrays of a larger model would take half a gigabyte.
_MAX_COVARIANCES = 1 << 22


@with_one_blas_thread
def identify(frfs: Response | Sequence[Response], count: int | None = None) -> Modes:
    """Identify the common modes of a set of frequency responses of one test.

    The initial poles are taken from stabilization diagrams (least-squares complex frequency domain). Poles and residues
    are refined by least squares, weighted by the inverse standard uncertainty of each point. Poles that do not improve
    the fit beyond noise are removed, and further candidates are tried, until only significant poles remain. If the
    residuals of the best model exceed the uncertainty of the points, as for a structure with nonlinear dampers, the
    points are weighted by the model error. The standard uncertainties are computed from the residuals. Curves without
    stated uncertainty, such as tables of other programs, are treated differently: modes are identified in windows of
    lines around each peak, and their uncertainties include the choice of lines. Modes that parts of the lines do not
    confirm are listed as uncertain.

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
        Natural frequencies [Hz], damping ratios and shapes, with standard uncertainties.

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
            tuple(f"{point.quantity} at {point.place or point.name}" for point in matrix.inputs),
            matrix.outputs,
        )
    labeled = [replace(frf, label=frf.label or "responses") for frf in frfs]
    all_lines = [frf.to("displacement").sorted() for frf in labeled]
    curves, measured, chart, fitted_poles = _fit_lines(all_lines, count)
    if not fitted_poles.poles.size:
        used = {curve.response for curve in curves}
        lines = [each for each in all_lines if each.response in used]
        raise RecordingError(f"{curves[0].label}: {_reason_without_modes(lines, count, fitted_poles)}")
    # A pole is omitted if the uncertainty of the curves at its frequency is unbounded.
    frequency: Array = np.asarray(abs(fitted_poles.poles) / (2 * np.pi), dtype=float)
    is_unbounded = expand(fitted_poles.frequency_std) >= frequency
    is_in_gap = ~is_unbounded & are_in_gaps(measured.frequency, fitted_poles.poles)
    accepted = ~(is_unbounded | is_in_gap)
    uncertain, unmeasured = frequency[is_unbounded], frequency[is_in_gap]
    if not accepted.any():
        place, remedy = "the uncertainty of the curves is too large", "Reduce its largest contributions, which"
        if unmeasured.size:
            place, remedy = "points of the curves were omitted", "Correct the reasons, which"
        listed = ", ".join(f"{f:.4g}" for f in (unmeasured if unmeasured.size else uncertain))
        raise RecordingError(
            f"{curves[0].label}: all resonances ({listed} Hz) lie where {place}. {remedy} `analysis frf` lists, and "
            "record again."
        )
    poles, residue = fitted_poles.poles[accepted], fitted_poles.residue[:, accepted]
    # A clock error changes all frequencies by the same factor, because it is common to all lines.
    clock = max(curve.uncertainty.clock for curve in frfs)
    clock_std = standard_of_limit(clock * frequency[accepted])
    residuals = _residual_terms(measured.frequency, fitted_poles.value, poles, residue)
    result = Modes(
        frequency=frequency[accepted],
        frequency_std=np.hypot(fitted_poles.frequency_std[accepted], clock_std),
        damping=-poles.real / abs(poles),
        damping_std=fitted_poles.damping_std[accepted],
        shape_std=_shape_uncertainties(curves, poles, residue),
        residue=residue,
        responses=tuple(curve.response for curve in curves),
        chart=tuple(chart),
        lower=residuals[:, 0],
        upper=residuals[:, 1:],
        model_error=fitted_poles.model_error,
        label=curves[0].label,
        warnings=(),
        input=curves[0].input,
        places=tuple(curve.output_at for curve in curves),
        bodies=tuple(curve.outputs[0].body for curve in curves),
        uncertain=tuple(fitted_poles.uncertain),
    )
    unused = [frf.response for frf in frfs if frf.response not in result.responses]
    notes = mode_warnings(result, curves, count, fitted_poles, uncertain, unmeasured, unused)
    return replace(result, warnings=(*curves[0].warnings, *notes))


def _reason_without_modes(all_lines: Sequence[Response], count: int | None, fitted_poles: IdentifiedPoles) -> str:
    """Return why responses have no modes, and what to do."""

    def has_modes(lines: Sequence[Response]) -> bool:
        return _fit_lines(lines, count)[-1].poles.size > 0

    if has_modes([replace(lines, value=lines.value.conj()) for lines in all_lines]):
        return (
            "the phases have the opposite sign: only the complex conjugates contain modes. Change the sign of the "
            "phase or of the imaginary part."
        )
    longer = "Measure for longer, with a smaller frequency spacing, or in a different band."
    if rejected := " ".join(rejections(fitted_poles)):
        return f"{rejected} {longer}"
    alone = [lines.response for lines in all_lines if has_modes([lines])] if len(all_lines) > 1 else []
    if alone:
        have = f"each of {', '.join(alone)} alone has" if len(alone) > 1 else f"{alone[0]} alone has"
        return (
            f"the responses have no common modes, but {have} modes: a channel is late or faulty. Identify {alone[0]} "
            "alone, and correct the others."
        )
    peaks = [lines.response for lines in all_lines if _has_clear_peak(lines)]
    if peaks:
        return (
            f"{', '.join(peaks)}: no model of few modes fits the peaks. A late channel, modes closer than their "
            "half-power width, or a nonlinear structure can be the cause. Add responses at other bodies, or compare "
            "with a stepped-sine test at a lower level."
        )
    return f"no resonance is higher than the noise and wider than the frequency resolution. {longer}"


def _has_clear_peak(lines: Response) -> bool:
    """Return whether the largest value is not at an end, and far above its uncertainty and the median."""
    magnitude = np.where(np.isfinite(lines.value), abs(lines.value), 0.0)
    line = int(np.argmax(magnitude))
    # The largest of 1000 values of noise is twice its expanded uncertainty.
    limit = max(3.0 * float(lines.expanded()[line]), 2.0 * float(np.median(magnitude)))
    return 0 < line < magnitude.size - 1 and bool(magnitude[line] > limit)


def _fit_lines(
    all_lines: Sequence[Response], count: int | None
) -> tuple[list[Response], Curves, Sequence[ChartPole], IdentifiedPoles]:
    """Return the curves with uncertainty, their common lines, a stabilization diagram, and the modes."""
    curves = remove_unbounded(reduce_lines(all_lines))
    if are_errors_stated(curves):
        fitted = fit_modes(curves, count)
        return curves, fitted.measured, fitted.chart, _modes_of_band(curves, fitted)
    measured, sigma = measured_curves(curves)
    charts, used = stabilization_diagrams(measured, sigma), {curve.response for curve in curves}
    used_lines = [curve for curve in all_lines if curve.response in used]
    return curves, measured, charts[0], identify_windows(used_lines, measured, charts, count)


def _modes_of_band(curves: Sequence[Response], fitted: FittedModes) -> IdentifiedPoles:
    """Return the modes of a model of the whole band."""
    model, weighted = fitted.model, fitted.weighted
    if not are_in_band(weighted, model.poles).any():
        return no_poles(weighted.value)._replace(rejected=fitted.rejected)
    refinement = None if fitted.model_error else _refine(weighted, model, curves)
    included: tuple[str, ...] = ()
    if refinement is None:
        random_std = pole_errors(weighted, model)
    else:
        model, included = refinement.model, refinement.included
        random_std = refined_pole_errors(model.poles, refinement.covariance)
    systematic = map(standard_of_limit, systematic_pole_errors(curves, model.poles, included))
    errors = [np.hypot(*each) for each in zip(random_std, systematic, strict=True)]
    accepted = are_in_band(weighted, model.poles)
    return IdentifiedPoles(
        model.poles[accepted],
        model.residue[:, accepted],
        errors[0][accepted],
        errors[1][accepted],
        fitted.model_error,
        fitted.rejected,
        [],
        modal_receptance(weighted.frequency, model.poles, model.residue, np.column_stack([model.lower, model.upper])),
    )


def _shape_uncertainties(curves: Sequence[Response], poles: ComplexArray, residue: ComplexArray) -> Array:
    """Return standard uncertainties of shapes with largest component 1, from curves at resonance."""
    # Errors of the reference, of the clock and of common readings cancel in the ratio of two curves.
    frequency: Array = np.asarray(abs(poles) / (2 * np.pi), dtype=float)
    largest = np.argmax(abs(residue), axis=0)
    error: Array = np.zeros(residue.shape)
    for row in np.unique(largest).tolist():
        modes = np.flatnonzero(largest == row)
        for k in np.delete(np.arange(len(curves)), row).tolist():
            is_common = np.isfinite(curves[k].value) & np.isfinite(curves[row].value)
            component, scale = (
                curve.at(nearest_lines(curve, frequency[modes], is_common)) for curve in (curves[k], curves[row])
            )
            ratio = component.uncertainty.of_ratio(scale.uncertainty, component.value, scale.value)
            error[k, modes] = ratio.combined()
    return error


def _refine(weighted: Curves, model: ModalModel, frfs: Sequence[Response]) -> Refinement | None:
    """Refine the model with the covariance of all responses; return None if the covariance is unknown or too large."""
    if any(frf.uncertainty.errors is None for frf in frfs):
        return None
    if len(frfs) ** 2 * weighted.frequency.size > _MAX_COVARIANCES:
        return None
    lines = np.searchsorted(frfs[0].frequency, weighted.frequency)
    curves = [frf.at(lines) for frf in frfs]
    errors = stack(curves).covariance()
    magnitude = np.stack([abs(frf.value) for frf in curves])
    line_deviation = np.hypot(standard_of_limit(systematic_limit(curves, IRREGULAR)), MIN_RELATIVE_ERROR * magnitude)
    if not (np.isfinite(errors.lines).all() and np.isfinite(line_deviation).all()):
        return None
    return refine(weighted, model, errors, line_deviation)


def _residual_terms(frequency: Array, value: ComplexArray, poles: ComplexArray, residue: ComplexArray) -> Array:
    """Return `Modes.lower` and `Modes.upper`, (responses, 4): the part of curves that the modes do not represent."""
    remainder = value - modal_receptance(frequency, poles, residue, np.zeros((len(value), 1 + UPPER_TERMS)))
    terms = np.stack(residual_terms(2j * np.pi * frequency), axis=1)
    scale = abs(terms).max(axis=0)
    factors = []
    for row, curve in zip(remainder, value, strict=True):
        # Relative errors are minimized; the lower limit bounds the weight of points near zero, such as antiresonances.
        weight = 1.0 / np.maximum(abs(curve), 1e-6 * abs(curve).max())
        columns, target = (
            np.concatenate([part.real, part.imag]) for part in (terms / scale * weight[:, None], row * weight)
        )
        factors.append(np.linalg.lstsq(columns, target, rcond=None)[0])
    return np.array(factors) / scale
