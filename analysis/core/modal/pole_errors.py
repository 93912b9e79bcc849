"""Uncertainty of identified poles: random errors from the residuals of the model, and limits of systematic errors.

The parameters of a pole are the logarithm of its decay rate, and its damped natural frequency in units of the decay
rate.
"""

from collections.abc import Sequence

import numpy as np

from analysis.core.modal_models.order_selection import correlation_length, half_width
from analysis.core.modal_models.pole_residue import Curves, ModalModel, jacobian
from analysis.core.responses.errors.systematic import ALIASING, MODEL, REFERENCE_NOISE, RESOLUTION
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response
from rig.core.results.uncertainty import CLOCK, SENSITIVITY, SYSTEMATIC

# Systematic errors that shift a pole as an error of stiffness does.
_STIFFNESS_ERRORS = (SENSITIVITY, CLOCK, SYSTEMATIC)
# Systematic errors that shift a pole as an error of complex stiffness does, because aliases have an arbitrary phase.
_PHASE_ERRORS = (ALIASING,)
# Systematic errors that may change the width of a peak.
_WIDTH_ERRORS = (ALIASING, RESOLUTION, MODEL, REFERENCE_NOISE)
# Systematic errors are evaluated up to this distance from a pole, in half-widths (halves of the half-power width).
_FLANK_HALF_WIDTHS = 10.0
# Increase of a fitted half-width by a Hann window, in squared resolutions over the half-width.
LEAKAGE_FACTOR = 0.16
# Leakage only increases a half-width, and a random error may increase it further. The symmetric interval shall contain
# the sum of both: of 16 random tests, it contained the damping ratio in all, and in 12 with a multiple of 1.
_LEAKAGE_MARGIN = 1.5
# Leakage increases a half-width by at most this multiple of the resolution.
_MAX_WIDENING = 0.5
# Limit of the frequency error of a peak that is narrower than the resolution, as a multiple of the resolution.
_MAX_LINE_ERROR = 2.0 / 3.0
# Lines may have common errors up to this distance, in correlation lengths of the residual.
_CORRELATION_LENGTHS = 3.0
# Smallest misfit, relative to its expected value, that contains information on the correlation of the errors.
_MIN_NOISE_RATIO = 0.3
# A damping ratio has at least this relative uncertainty, and a frequency at least this uncertainty relative to the
# half-width. Errors of a curve that resemble a mode (residual transients, phase errors of sensors) do not increase the
# misfit.
_MIN_UNCERTAINTY = 5e-4
# Eigenvalues of the information matrix below this fraction of the largest are rounding errors.
_MIN_EIGENVALUE_RATIO = 1e-15


def pole_errors(curves: Curves, model: ModalModel) -> tuple[Array, Array]:
    """Return the standard uncertainties of natural frequencies [Hz] and damping ratios, both of shape (modes,).

    They are the largest of three estimates. The first assumes independent errors of all lines and responses. The second
    assumes errors common to responses and neighboring lines, due to force noise, transients or a nonlinear structure
    (W. K. Newey, K. D. West, Econometrica 55 (1987) 703-708). The estimate is corrected for few data (J. G. MacKinnon,
    H. White, Journal of Econometrics 29 (1985) 305-325, estimator HC3). The third assumes errors of the reference.
    """
    frequency_std, damping_std = propagate(model.poles, _covariance_factors(curves, model))
    # Errors of random phase shift a pole in any direction of the complex plane. With few lines the estimate in one
    # direction may be small by chance, so the frequency error is at least the root mean square of both directions.
    decay_uncertainty = damping_std * abs(model.poles) / (2 * np.pi)
    frequency_std = np.maximum(frequency_std, np.hypot(frequency_std, decay_uncertainty) / np.sqrt(2.0))
    return _add_min_uncertainty(model.poles, frequency_std, damping_std)


def refined_pole_errors(poles: ComplexArray, covariance: Array) -> tuple[Array, Array]:
    """Return the uncertainties as in `pole_errors`, from the covariance of the parameters, (2 modes, 2 modes)."""
    # The decay rate of a pole far outside the band may be undetermined. Its variance would dominate the rounding errors
    # of a factorization of the covariance, but not of the correlation.
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    eigenvalues, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    factor = scale[:, None] * axes * np.sqrt(np.maximum(eigenvalues, 0.0))
    return _add_min_uncertainty(poles, *propagate(poles, [factor]))


def _add_min_uncertainty(poles: ComplexArray, frequency_std: Array, damping_std: Array) -> tuple[Array, Array]:
    min_error = -_MIN_UNCERTAINTY * poles.real
    return np.hypot(frequency_std, min_error / (2 * np.pi)), np.hypot(damping_std, min_error / abs(poles))


def propagate(poles: ComplexArray, factors: Sequence[Array]) -> tuple[Array, Array]:
    """Return the largest standard uncertainties of frequencies [Hz] and damping ratios over covariances ``F F^T``.

    `factors`: factors F; their rows belong to the first parameters of all poles, then to the second parameters.
    """
    count = poles.size
    decay_rate, damped, natural = -poles.real, poles.imag, abs(poles)
    frequency_std, damping_std = np.empty(count), np.empty(count)
    for i in range(count):
        # Derivatives of frequency and damping ratio with respect to the two parameters of a pole.
        of_frequency = np.array([decay_rate[i], damped[i]]) * decay_rate[i] / natural[i] / (2 * np.pi)
        of_damping = np.array([damped[i] ** 2, -decay_rate[i] * damped[i]]) * decay_rate[i] / natural[i] ** 3
        pairs = [factor[[i, i + count]] for factor in factors]
        frequency_std[i], damping_std[i] = (
            max(float(np.linalg.norm(derivative @ pair)) for pair in pairs) for derivative in (of_frequency, of_damping)
        )
    return frequency_std, damping_std


def systematic_pole_errors(
    frfs: Sequence[Response], poles: ComplexArray, already_counted: Sequence[str] = ()
) -> tuple[Array, Array]:
    """Return limits of the systematic errors of natural frequencies [Hz] and damping ratios, shape (modes,).

    A relative error d(s) of a curve shifts the pole p by up to ``d |s - p|``; a constant error only scales the curve.
    For example, unequal gains at the two ends of a spring act like an error of its stiffness. An error at the peak
    alone, and the leakage of a window, may also change the width of the peak. The errors named in `already_counted` are
    omitted, because the random errors include them.
    """
    width_errors = tuple(name for name in _WIDTH_ERRORS if name not in already_counted)
    half_width_hz = half_width(poles)
    resolution = max(curve.resolution for curve in frfs)
    frequency_limit = np.where(2.0 * half_width_hz < resolution, _MAX_LINE_ERROR * resolution, 0.0)
    widening = np.minimum(_LEAKAGE_MARGIN * LEAKAGE_FACTOR * resolution**2 / half_width_hz, _MAX_WIDENING * resolution)
    damping_limit = 2.0 * np.pi * widening / abs(poles)
    for curve in frfs:
        stiffness, phase, width = (
            _relative(curve, names) for names in (_STIFFNESS_ERRORS, _PHASE_ERRORS, width_errors)
        )
        for i, pole in enumerate(poles):
            natural, width_hz = abs(pole) / (2.0 * np.pi), float(half_width_hz[i])
            distance = abs(curve.frequency - natural - 1j * width_hz)
            by_stiffness, by_phase = _shift(stiffness, distance, width_hz), _shift(phase, distance, width_hz)
            by_width = float(np.nan_to_num(width[int(np.argmin(distance))], nan=1.0, posinf=1.0)) * width_hz
            frequency_limit[i] = max(frequency_limit[i], float(np.linalg.norm([by_stiffness, by_phase, by_width])))
            decay_limit = float(np.linalg.norm([width_hz / natural * by_stiffness, by_phase, by_width]))
            damping_limit[i] = max(damping_limit[i], decay_limit / natural)
    return frequency_limit, damping_limit


def _relative(curve: Response, names: Sequence[str]) -> Array:
    """Return the root sum of squares of the named systematic errors, relative to the curve; shape (n,)."""
    bounds = [curve.limits[name] for name in names if name in curve.limits]
    return np.asarray(
        np.linalg.norm([np.zeros(curve.value.size), *bounds], axis=0) / np.maximum(abs(curve.value), 1e-300)
    )


def _shift(error: Array, distance: Array, half_width_hz: float) -> float:
    """Compute the shift of a pole [Hz] due to relative errors of a curve at given distances [Hz] from the pole."""
    bounded = np.isfinite(error)
    if not bounded.any():
        return float("inf")
    near_pole = distance <= max(_FLANK_HALF_WIDTHS * half_width_hz, np.sort(distance)[:4].max())
    shift = np.where(bounded, error - error[bounded].min(), np.inf) * distance
    # If the uncertainty of the curve around a pole is unbounded, so is the uncertainty of the pole.
    return float(np.quantile(shift[near_pole], 0.75, method="higher"))


def _covariance_factors(curves: Curves, model: ModalModel) -> tuple[Array, Array, Array]:
    """Return factors F of the covariance ``F F^T`` of the parameters for the three estimates of `pole_errors`.

    Errors of the reference cause equal relative errors of all responses at a line. The fitted poles adapt to these
    errors, so the misfit increases little. The errors of the reference are at most as large as the errors of the most
    precise response. The factors have the shape (parameters, columns).
    """
    # A line of zero weight in all responses has no error of the reference.
    precision = np.max(curves.weight * abs(curves.value), axis=0)
    relative = np.divide(1.0, precision, out=np.zeros_like(precision), where=precision > 0.0)
    information, score, gradient = _sums_over_responses(curves, model)
    gradient = gradient * relative
    eigenvalues, axes = np.linalg.eigh(information)
    determined = eigenvalues > _MIN_EIGENVALUE_RATIO * eigenvalues[-1]
    root = axes[:, determined] / np.sqrt(eigenvalues[determined])
    inverse = root @ root.T
    # The fit reduces the degrees of freedom of the misfit.
    degrees_of_freedom = curves.degrees_of_freedom(model.poles.size)
    variance = model.misfit / degrees_of_freedom
    # The Bartlett weights must extend beyond the correlation length to include more than half of the correlation.
    length = max(correlation_length(model.residual), curves.shared)
    n_lags = int(np.clip(round(_CORRELATION_LENGTHS * length), 1, max(score.shape[1] // 4, 1)))
    # The covariance of moving sums equals the sum of the lagged covariances with Bartlett weights.
    sums = np.stack([np.convolve(row, np.ones(n_lags)) for row in score]) / np.sqrt(n_lags)
    independent = root * np.sqrt(variance * length)
    # The pseudoinverse omits undetermined parameters, such as the width of a pole far narrower than the line spacing.
    with np.errstate(divide="ignore"):
        min_variance = variance * length / np.diag(information)
    omitted = np.maximum(min_variance - np.sum(np.square(independent), axis=1), 0.0)
    independent = np.concatenate([independent, np.diag(np.sqrt(omitted))], axis=1)
    # With few data the fit reduces each residual considerably. The reduction is corrected (HC3).
    correlated = np.asarray(inverse @ sums * (curves.n_values / degrees_of_freedom), dtype=float)
    # If the residual is due to the errors of the curves, residual and errors have the same correlation between lines.
    correlated_lines = length if variance > _MIN_NOISE_RATIO else curves.shared
    common = inverse @ np.concatenate([gradient.real, gradient.imag], axis=1) * np.sqrt(correlated_lines)
    return independent, correlated, np.asarray(common, dtype=float)


def _sums_over_responses(curves: Curves, model: ModalModel) -> tuple[Array, Array, ComplexArray]:
    """Return the information matrix, and sums of derivatives times residual (real) and times weighted responses."""
    count = 2 * model.poles.size
    information = np.zeros((count, count))
    score, gradient = np.zeros((count, curves.frequency.size)), np.zeros((count, curves.frequency.size), dtype=complex)
    # The derivatives of all of many responses would take several times the memory of the responses.
    for rows, part in curves.blocks(4 * model.poles.size):
        derivatives = jacobian(part, model.poles)
        flat, conjugate = derivatives.reshape(len(derivatives), -1), derivatives.conj()
        information += (flat @ flat.conj().T).real
        score += np.einsum("pmn,mn->pn", conjugate, model.residual[rows]).real
        gradient += np.einsum("pmn,mn->pn", conjugate, part.weight * part.value)
    return information, score, gradient
