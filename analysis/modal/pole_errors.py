"""Uncertainty of identified poles, from the residuals of the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.modal.order_selection import correlation, half_width
from analysis.modal.pole_residue import Curves, Fit
from analysis.responses.systematic import ALIASING, MODEL, REFERENCE_NOISE, RESOLUTION
from rig.arrays import Array, ComplexArray
from rig.results.response import Response
from rig.results.uncertainty import CLOCK, SENSITIVITY

# Systematic parts that shift a pole like a stiffness error, those that shift it like a complex stiffness, because
# aliases have an arbitrary phase, and those that may change its width. They are evaluated within this number of
# half-widths around the pole.
_STIFFENS, _TURNS = (SENSITIVITY, CLOCK), (ALIASING,)
_WIDENS = (ALIASING, RESOLUTION, MODEL, REFERENCE_NOISE)
_FLANKS = 10.0
# Leakage of a Hann window widens a resonance. The fitted half of the half-power width is too large by this factor
# times the squared resolution over the width, and by at most half the resolution. The frequency of a peak that is
# narrower than the resolution has an error below one line.
SMEAR, _WIDEST, _LINE = 0.16, 0.5, 2.0 / 3.0
# Lines within this multiple of the correlation length of the misfit may have common errors.
_REACH = 3.0

# A misfit above this part of its expected value is due to the errors of the curves.
_IS_NOISE = 0.3
# Errors of a curve that resemble a mode (residual transients, phase errors of sensors) do not increase the misfit.
# This is therefore the smallest uncertainty of a damping ratio, and of a frequency relative to half of the half-power
# width.
_UNSEEN = 5e-4
# Eigenvalues of the information matrix below this part of the largest are rounding errors.
_RANK = 1e-15


def pole_errors(curves: Curves, model: Fit) -> tuple[Array, Array]:
    """Return the standard deviations of natural frequencies [Hz] and damping ratios, both of shape (modes,).

    The largest of three estimates: for independent errors of all lines and responses, with the variance of the
    misfit; for errors common to responses and neighbouring lines, due to force noise, transients or a nonlinear
    structure (W. K. Newey, K. D. West, A simple, positive semi-definite, heteroskedasticity and autocorrelation
    consistent covariance matrix, Econometrica 55 (1987) 703-708); and for errors of the reference.

    J. G. MacKinnon, H. White, Some heteroskedasticity-consistent covariance matrix estimators with improved finite
    sample properties, Journal of Econometrics 29 (1985) 305-325.
    """
    f_error, z_error = propagated(model.poles, _factors(curves, model))
    # Errors of random phase shift a pole in any direction; with few lines the estimate in one direction may be small
    # by chance.
    size = abs(model.poles)
    f_error = np.maximum(f_error, np.hypot(f_error, z_error * size / (2 * np.pi)) / np.sqrt(2.0))
    return _with_unseen(model.poles, f_error, z_error)


def refined_pole_errors(poles: ComplexArray, covariance: Array) -> tuple[Array, Array]:
    """Return the same from the covariance of the poles' parameters, shape (2 modes, 2 modes)."""
    size, axes = np.linalg.eigh(covariance)
    return _with_unseen(poles, *propagated(poles, [axes * np.sqrt(np.maximum(size, 0.0))]))


def _with_unseen(poles: ComplexArray, f_error: Array, z_error: Array) -> tuple[Array, Array]:
    unseen = -_UNSEEN * poles.real
    return np.hypot(f_error, unseen / (2 * np.pi)), np.hypot(z_error, unseen / abs(poles))


def propagated(poles: ComplexArray, factors: Sequence[Array]) -> tuple[Array, Array]:
    """Return the largest standard deviations of frequencies [Hz] and damping ratios over covariances ``F F^T``.

    The parameters are the logarithms of the decay rates, then the damped frequencies in units of the decay rates.
    """
    count = poles.size
    decay, damped, size = -poles.real, poles.imag, abs(poles)
    f_error, z_error = np.empty(count), np.empty(count)
    for i in range(count):
        to_f = np.array([decay[i], damped[i]]) * decay[i] / size[i] / (2 * np.pi)
        to_z = np.array([damped[i] ** 2, -decay[i] * damped[i]]) * decay[i] / size[i] ** 3
        pairs = [factor[[i, i + count]] for factor in factors]
        f_error[i], z_error[i] = (
            max(float(np.linalg.norm(to @ pair)) for pair in pairs) for to in (to_f, to_z)
        )
    return f_error, z_error


def systematic_pole_errors(
    frfs: Sequence[Response], poles: ComplexArray, without: Sequence[str] = ()
) -> tuple[Array, Array]:
    """Return limits of the systematic errors of natural frequencies [Hz] and damping ratios, shape (modes,).

    A reference that is the difference of two readings with gain errors contains a part of the response. To first order
    this is a stiffness error: a relative error d of the curve at s shifts the pole p by ``d |s - p|`` (no shift if d is
    constant). An error at the peak alone may also change its width, and so does the leakage of a window. The parts
    `without` are those that the random errors already include.
    """
    widening = tuple(name for name in _WIDENS if name not in without)
    half = half_width(poles)
    resolution = max(curve.resolution for curve in frfs)
    f_error = np.where(2.0 * half < resolution, _LINE * resolution, 0.0)
    blurred = np.minimum(SMEAR * resolution**2 / half, _WIDEST * resolution)
    z_error = 2.0 * np.pi * blurred / abs(poles)
    for curve in frfs:
        stiffens, turns, widens = (_relative(curve, names) for names in (_STIFFENS, _TURNS, widening))
        for i, p in enumerate(poles):
            natural = abs(p) / (2.0 * np.pi)
            away = abs(curve.frequency - natural - 1j * half[i])
            stiff, turned = (_shift(off, away, float(half[i])) for off in (stiffens, turns))
            peak = float(np.nan_to_num(widens[int(np.argmin(away))], nan=1.0, posinf=1.0)) * float(half[i])
            f_error[i] = max(f_error[i], float(np.linalg.norm([stiff, turned, peak])))
            damps = float(np.linalg.norm([half[i] / natural * stiff, turned, peak]))
            z_error[i] = max(z_error[i], damps / natural)
    return f_error, z_error


def _relative(curve: Response, names: Sequence[str]) -> Array:
    """Root sum of squares of some systematic parts, relative to the curve."""
    parts = [curve.limits[name] for name in names if name in curve.limits]
    return np.asarray(
        np.linalg.norm([np.zeros(curve.value.size), *parts], axis=0) / np.maximum(abs(curve.value), 1e-300)
    )


def _shift(off: Array, away: Array, half: float) -> float:
    """Shift of a pole, Hz, by the relative errors of a curve at given distances from the pole."""
    known = np.isfinite(off)
    if not known.any():
        return float("inf")
    near = away <= max(_FLANKS * half, np.sort(away)[:4].max())
    moved = np.where(known, off - off[known].min(), np.inf) * away
    # If the uncertainty of the curve around a pole is unbounded, the uncertainty of the pole is, too.
    return float(np.quantile(moved[near], 0.75, method="higher"))


def _factors(curves: Curves, model: Fit) -> tuple[Array, Array, Array]:
    """Factors F of the covariance ``F F^T`` of the parameters for three kinds of errors, shape (parameters, columns).

    The kinds are: independent errors; errors common to responses and neighbouring lines, estimated from the misfit;
    and errors of the reference. The latter cause equal relative errors of all responses at a line, so that poles
    follow them and the misfit shows little. They are at most the errors of the most precise response.
    """
    parameters = model.slope.shape[0]
    slope = model.slope.reshape(parameters, -1)
    information = (slope @ slope.conj().T).real
    size, axes = np.linalg.eigh(information)
    known = size > _RANK * size[-1]
    root = axes[:, known] / np.sqrt(size[known])
    normal = root @ root.T
    degrees = curves.degrees(model.poles.size)
    score = np.einsum("pmn,mn->pn", model.slope.conj(), model.rest).real
    # The weights must extend beyond the correlation length; otherwise they include only half of it.
    reach = max(correlation(model.rest), curves.shared)
    lags = int(np.clip(round(_REACH * reach), 1, max(score.shape[1] // 4, 1)))
    # The covariance of moving sums is the covariance with Bartlett weights.
    sums = np.stack([np.convolve(row, np.ones(lags)) for row in score]) / np.sqrt(lags)
    # The fit reduces the degrees of freedom of the misfit.
    plain = root * np.sqrt(model.misfit / degrees * reach)
    # The pseudoinverse omits undetermined parameters, such as the width of a pole far narrower than the line spacing.
    with np.errstate(divide="ignore"):
        least = model.misfit / degrees * reach / np.diag(information)
    missing = np.maximum(least - np.sum(np.square(plain), axis=1), 0.0)
    plain = np.concatenate([plain, np.diag(np.sqrt(missing))], axis=1)
    # With few data the fit reduces each residual by a large factor, which is corrected (MacKinnon and White's HC3).
    seen = np.asarray(normal @ sums * (curves.numbers / degrees), dtype=float)
    # A line of zero weight in all responses has no common error.
    surest = np.max(curves.weight * abs(curves.value), axis=0)
    relative = np.divide(1.0, surest, out=np.zeros_like(surest), where=surest > 0.0)
    scored = np.einsum("pmn,mn->pn", model.slope.conj(), curves.weight * curves.value) * relative
    # If the misfit is due to the errors of the curves, both have the same correlation between lines.
    alike = reach if model.misfit > _IS_NOISE * degrees else curves.shared
    common = normal @ np.concatenate([scored.real, scored.imag], axis=1) * np.sqrt(alike)
    return plain, seen, np.asarray(common, dtype=float)
