"""Uncertainty of identified poles, from the residuals of the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.modal.order_selection import correlation_length, half_width
from analysis.modal.pole_residue import Curves, ModalModel
from analysis.responses.systematic import ALIASING, MODEL, REFERENCE_NOISE, RESOLUTION
from rig.arrays import Array, ComplexArray
from rig.results.response import Response
from rig.results.uncertainty import CLOCK, SENSITIVITY

# Systematic errors that shift a pole like a stiffness error.
_STIFFNESS_ERRORS = (SENSITIVITY, CLOCK)
# Systematic errors that shift a pole like a complex stiffness error, because aliases have an arbitrary phase.
_PHASE_ERRORS = (ALIASING,)
# Systematic errors that may change the width of a peak.
_WIDTH_ERRORS = (ALIASING, RESOLUTION, MODEL, REFERENCE_NOISE)
# Range around a pole in which systematic errors are evaluated, in halves of the half-power bandwidth (half-widths).
_FLANK_HALF_WIDTHS = 10.0
# Increase of a fitted half-width by leakage of a Hann window, relative to the squared resolution over the half-width.
LEAKAGE_FACTOR = 0.16
# Largest widening by leakage, as a multiple of the resolution.
_MAX_WIDENING = 0.5
# Largest frequency error of a peak that is narrower than the resolution, as a multiple of the resolution.
_MAX_LINE_ERROR = 2.0 / 3.0
# Distance of lines that may have common errors, in correlation lengths of the misfit.
_CORRELATION_LENGTHS = 3.0
# Smallest misfit that is due to the errors of the curves, relative to its expected value.
_MIN_NOISE_RATIO = 0.3
# Smallest relative uncertainty of a damping ratio, and of a frequency relative to the half-width. Errors of a curve
# that resemble a mode (residual transients, phase errors of sensors) do not increase the misfit.
_MIN_UNCERTAINTY = 5e-4
# Smallest eigenvalue of the information matrix that is not a rounding error, relative to the largest.
_MIN_EIGENVALUE_RATIO = 1e-15


def pole_errors(curves: Curves, model: ModalModel) -> tuple[Array, Array]:
    """Return the standard deviations of natural frequencies [Hz] and damping ratios, both of shape (modes,).

    They are the largest of three estimates. The first is for independent errors of all lines and responses, with the
    variance of the misfit. The second is for errors common to responses and neighboring lines, due to force noise,
    transients or a nonlinear structure (W. K. Newey, K. D. West, A simple, positive semi-definite, heteroskedasticity
    and autocorrelation consistent covariance matrix, Econometrica 55 (1987) 703-708). The third is for errors of the
    reference.

    J. G. MacKinnon, H. White, Some heteroskedasticity-consistent covariance matrix estimators with improved finite
    sample properties, Journal of Econometrics 29 (1985) 305-325.
    """
    frequency_error, damping_error = propagate(model.poles, _covariance_factors(curves, model))
    # Errors of random phase shift a pole in any direction. With few lines the estimate in one direction may be small
    # by chance, so the frequency error is at least the mean over both directions.
    decay_error = damping_error * abs(model.poles) / (2 * np.pi)
    frequency_error = np.maximum(frequency_error, np.hypot(frequency_error, decay_error) / np.sqrt(2.0))
    return _add_min_uncertainty(model.poles, frequency_error, damping_error)


def refined_pole_errors(poles: ComplexArray, covariance: Array) -> tuple[Array, Array]:
    """Return the same standard deviations from the covariance of the poles' parameters, shape (2 modes, 2 modes)."""
    eigenvalues, axes = np.linalg.eigh(covariance)
    return _add_min_uncertainty(poles, *propagate(poles, [axes * np.sqrt(np.maximum(eigenvalues, 0.0))]))


def _add_min_uncertainty(poles: ComplexArray, frequency_error: Array, damping_error: Array) -> tuple[Array, Array]:
    min_uncertainty = -_MIN_UNCERTAINTY * poles.real
    return np.hypot(frequency_error, min_uncertainty / (2 * np.pi)), np.hypot(
        damping_error, min_uncertainty / abs(poles)
    )


def propagate(poles: ComplexArray, factors: Sequence[Array]) -> tuple[Array, Array]:
    """Return the largest standard deviations of frequencies [Hz] and damping ratios over covariances ``F F^T``.

    The parameters are the logarithms of the decay rates, then the damped frequencies in units of the decay rates.
    """
    count = poles.size
    decay_rate, damped, size = -poles.real, poles.imag, abs(poles)
    frequency_error, damping_error = np.empty(count), np.empty(count)
    for i in range(count):
        # Derivatives of frequency and damping ratio with respect to the two parameters of a pole.
        of_frequency = np.array([decay_rate[i], damped[i]]) * decay_rate[i] / size[i] / (2 * np.pi)
        of_damping = np.array([damped[i] ** 2, -decay_rate[i] * damped[i]]) * decay_rate[i] / size[i] ** 3
        pairs = [factor[[i, i + count]] for factor in factors]
        frequency_error[i], damping_error[i] = (
            max(float(np.linalg.norm(derivative @ pair)) for pair in pairs) for derivative in (of_frequency, of_damping)
        )
    return frequency_error, damping_error


def systematic_pole_errors(
    frfs: Sequence[Response], poles: ComplexArray, included: Sequence[str] = ()
) -> tuple[Array, Array]:
    """Return limits of the systematic errors of natural frequencies [Hz] and damping ratios, shape (modes,).

    A reference that is the difference of two readings with gain errors contains a part of the response. To first order
    the effect is a stiffness error: a relative error d of the curve at s shifts the pole p by ``d |s - p|`` (no shift
    if d is constant). An error at the peak alone, and the leakage of a window, may also change its width. The errors
    `included` are omitted, because the random errors already contain them.
    """
    width_errors = tuple(name for name in _WIDTH_ERRORS if name not in included)
    half_width_hz = half_width(poles)
    resolution = max(curve.resolution for curve in frfs)
    frequency_error = np.where(2.0 * half_width_hz < resolution, _MAX_LINE_ERROR * resolution, 0.0)
    widening = np.minimum(LEAKAGE_FACTOR * resolution**2 / half_width_hz, _MAX_WIDENING * resolution)
    damping_error = 2.0 * np.pi * widening / abs(poles)
    for curve in frfs:
        stiffness, phase, width = (
            _relative(curve, names) for names in (_STIFFNESS_ERRORS, _PHASE_ERRORS, width_errors)
        )
        for i, p in enumerate(poles):
            natural, half = abs(p) / (2.0 * np.pi), float(half_width_hz[i])
            distance = abs(curve.frequency - natural - 1j * half_width_hz[i])
            by_stiffness, by_phase = _shift(stiffness, distance, half), _shift(phase, distance, half)
            by_width = float(np.nan_to_num(width[int(np.argmin(distance))], nan=1.0, posinf=1.0)) * half
            frequency_error[i] = max(frequency_error[i], float(np.linalg.norm([by_stiffness, by_phase, by_width])))
            decay_error = float(np.linalg.norm([half_width_hz[i] / natural * by_stiffness, by_phase, by_width]))
            damping_error[i] = max(damping_error[i], decay_error / natural)
    return frequency_error, damping_error


def _relative(curve: Response, names: Sequence[str]) -> Array:
    """Return the root sum of squares of some systematic errors, relative to the curve; shape (n,)."""
    limits = [curve.limits[name] for name in names if name in curve.limits]
    return np.asarray(
        np.linalg.norm([np.zeros(curve.value.size), *limits], axis=0) / np.maximum(abs(curve.value), 1e-300)
    )


def _shift(error: Array, distance: Array, half_width_hz: float) -> float:
    """Compute the shift of a pole, Hz, by the relative errors of a curve at given distances from the pole, Hz."""
    bounded = np.isfinite(error)
    if not bounded.any():
        return float("inf")
    flanks = distance <= max(_FLANK_HALF_WIDTHS * half_width_hz, np.sort(distance)[:4].max())
    shift = np.where(bounded, error - error[bounded].min(), np.inf) * distance
    # If the uncertainty of the curve around a pole is unbounded, so is the uncertainty of the pole.
    return float(np.quantile(shift[flanks], 0.75, method="higher"))


def _covariance_factors(curves: Curves, model: ModalModel) -> tuple[Array, Array, Array]:
    """Return factors F of the covariance ``F F^T`` of the parameters by three kinds of errors, (parameters, columns).

    The kinds are independent errors, errors common to responses and neighboring lines, estimated from the misfit, and
    errors of the reference. Errors of the reference cause equal relative errors of all responses at a line, so that
    the poles follow them and the misfit hardly increases. They are at most the errors of the most precise response.
    """
    parameters = model.jacobian.shape[0]
    jacobian = model.jacobian.reshape(parameters, -1)
    information = (jacobian @ jacobian.conj().T).real
    eigenvalues, axes = np.linalg.eigh(information)
    determined = eigenvalues > _MIN_EIGENVALUE_RATIO * eigenvalues[-1]
    root = axes[:, determined] / np.sqrt(eigenvalues[determined])
    inverse = root @ root.T
    degrees = curves.degrees(model.poles.size)
    score = np.einsum("pmn,mn->pn", model.jacobian.conj(), model.residual).real
    # The weights must extend beyond the correlation length; otherwise they include only half of the correlation.
    length = max(correlation_length(model.residual), curves.shared)
    lags = int(np.clip(round(_CORRELATION_LENGTHS * length), 1, max(score.shape[1] // 4, 1)))
    # The covariance of moving sums is the covariance with Bartlett weights.
    sums = np.stack([np.convolve(row, np.ones(lags)) for row in score]) / np.sqrt(lags)
    # The fit reduces the degrees of freedom of the misfit.
    independent = root * np.sqrt(model.misfit / degrees * length)
    # The pseudoinverse omits undetermined parameters, such as the width of a pole far narrower than the line spacing.
    with np.errstate(divide="ignore"):
        min_variance = model.misfit / degrees * length / np.diag(information)
    omitted = np.maximum(min_variance - np.sum(np.square(independent), axis=1), 0.0)
    independent = np.concatenate([independent, np.diag(np.sqrt(omitted))], axis=1)
    # With few data the fit reduces each residual by a large factor, which is corrected (MacKinnon and White's HC3).
    correlated = np.asarray(inverse @ sums * (curves.n_values / degrees), dtype=float)
    # A line of zero weight in all responses has no common error.
    precision = np.max(curves.weight * abs(curves.value), axis=0)
    relative = np.divide(1.0, precision, out=np.zeros_like(precision), where=precision > 0.0)
    gradient = np.einsum("pmn,mn->pn", model.jacobian.conj(), curves.weight * curves.value) * relative
    # If the misfit is due to the errors of the curves, both have the same correlation between lines.
    n_lines = length if model.misfit > _MIN_NOISE_RATIO * degrees else curves.shared
    common = inverse @ np.concatenate([gradient.real, gradient.imag], axis=1) * np.sqrt(n_lines)
    return independent, correlated, np.asarray(common, dtype=float)
