"""Uncertainty of identified poles, from what the model leaves of the curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.modal.order_selection import correlation, half_width
from analysis.modal.pole_residue import Curves, Fit
from analysis.responses.systematic import ALIASING, MODEL, REFERENCE_NOISE, RESOLUTION
from rig.results.response import Response
from rig.results.uncertainty import CLOCK, SENSITIVITY

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Systematic parts that move a pole as a stiffness does, or as one with a loss, for aliases have any phase; estimated
# from so many half-widths around it; and those that may be its width.
_STIFFENS, _TURNS = (SENSITIVITY, CLOCK), (ALIASING,)
_WIDENS = (ALIASING, RESOLUTION, MODEL, REFERENCE_NOISE)
_FLANKS = 10.0
# A Hann window's leakage widens a resonance; fitted, half its half-power width comes out too large by so much of the
# resolution squared over itself, and by no more than half the resolution. Where a peak is narrower than the resolution,
# it lies within a line of where it seems to be.
SMEAR, _WIDEST, _LINE = 0.16, 0.5, 2.0 / 3.0
# Neighbours within so many times the correlation of the misfit may share errors.
_REACH = 3.0

# A misfit of this part of what the curves' errors would leave is of their kind.
_IS_NOISE = 0.3
# Errors of a curve that look like a mode themselves (what is left of a transient, a sensor's phase) leave nothing
# to see in the misfit: no damping ratio is claimed to be known better than this, and no frequency better than this
# part of half the half-power width.
_UNSEEN = 5e-4
# Eigenvalues of the information below this part of the largest are rounding.
_RANK = 1e-15


def pole_errors(curves: Curves, model: Fit) -> tuple[Array, Array]:
    """Return the standard deviations of natural frequencies [Hz] and damping ratios, both of shape (modes,).

    The largest of three: that of errors independent from line to line and response to response, as large as the
    misfit says; that of errors which responses have in common and neighbouring lines share, as they do
    where force noise, transients or a structure that is not linear leave them [1]_; and that of the reference.

    References
    ----------
    .. [1] W. K. Newey, K. D. West, A simple, positive semi-definite, heteroskedasticity and autocorrelation
       consistent covariance matrix, Econometrica 55 (1987) 703-708.
    .. [2] J. G. MacKinnon, H. White, Some heteroskedasticity-consistent covariance matrix estimators with improved
       finite sample properties, Journal of Econometrics 29 (1985) 305-325.
    """
    f_error, z_error = propagated(model.poles, _factors(curves, model))
    # Errors of any phase put a pole off in any direction: of few lines the error along it may come out small by chance.
    size = abs(model.poles)
    f_error = np.maximum(f_error, np.hypot(f_error, z_error * size / (2 * np.pi)) / np.sqrt(2.0))
    return _with_unseen(model.poles, f_error, z_error)


def refined_pole_errors(poles: ComplexArray, covariance: Array) -> tuple[Array, Array]:
    """Give the same from the covariance of the poles' parameters, shape (2 modes, 2 modes)."""
    size, axes = np.linalg.eigh(covariance)
    return _with_unseen(poles, *propagated(poles, [axes * np.sqrt(np.maximum(size, 0.0))]))


def _with_unseen(poles: ComplexArray, f_error: Array, z_error: Array) -> tuple[Array, Array]:
    unseen = -_UNSEEN * poles.real
    return np.hypot(f_error, unseen / (2 * np.pi)), np.hypot(z_error, unseen / abs(poles))


def propagated(poles: ComplexArray, factors: Sequence[Array]) -> tuple[Array, Array]:
    """Largest standard deviations of natural frequencies [Hz] and damping ratios, of some covariances ``F F^T``.

    The parameters are the logarithms of the decay rates, then the damped frequencies in decay rates.
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

    A reference that is the difference of two readings, each a little off, has some of the response in it: to first
    order another stiffness, which moves the pole p by ``d |s - p|`` where the curve is off by the part d of itself at s
    (and by nothing where d is the same everywhere). What is off at the peak alone may as well be its width, and so may
    what a window smears.

    Parameters
    ----------
    frfs : sequence of Response
        The curves, by rising frequency.
    poles : ndarray of complex, shape (modes,)
        rad/s.
    without : sequence of str
        Parts that the random errors of the poles have in them.
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
    """Root of the sum of squares of some systematic parts, as a part of the curve."""
    parts = [curve.limits[name] for name in names if name in curve.limits]
    return np.asarray(
        np.linalg.norm([np.zeros(curve.value.size), *parts], axis=0) / np.maximum(abs(curve.value), 1e-300)
    )


def _shift(off: Array, away: Array, half: float) -> float:
    """How far, in Hz, a pole of some half-width is moved by what a curve is off by, so far away from the pole."""
    known = np.isfinite(off)
    if not known.any():
        return float("inf")
    near = away <= max(_FLANKS * half, np.sort(away)[:4].max())
    moved = np.where(known, off - off[known].min(), np.inf) * away
    # Where nothing bounds the curve about a pole, nothing bounds where that is.
    return float(np.quantile(moved[near], 0.75, method="higher"))


def _factors(curves: Curves, model: Fit) -> tuple[Array, Array, Array]:
    """Factors F of the covariance ``F F^T`` of the parameters for three kinds of errors, shape (parameters, columns).

    Independent ones; those shared by responses and neighbours, as the misfit shows them; and those of a reference,
    by which all responses are divided: a line's errors are the same part of each response, so that poles follow them
    and the misfit shows little. Their size follows from the curves' own errors: at most that of the surest response.
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
    # Weights that fall to nothing within the correlation itself would miss half of it.
    reach = max(correlation(model.rest), curves.shared)
    lags = int(np.clip(round(_REACH * reach), 1, max(score.shape[1] // 4, 1)))
    # Sums over so many neighbours have the covariance with Bartlett's weights.
    sums = scipy.signal.convolve(score, np.ones((1, lags)), method="direct") / np.sqrt(lags)
    # The misfit has fewer degrees of freedom than numbers: the fit has taken its share.
    plain = root * np.sqrt(model.misfit / degrees * reach)
    # A pseudoinverse omits what no line determines, such as the width of a pole far narrower than the spacing.
    with np.errstate(divide="ignore"):
        least = model.misfit / degrees * reach / np.diag(information)
    missing = np.maximum(least - np.sum(np.square(plain), axis=1), 0.0)
    plain = np.concatenate([plain, np.diag(np.sqrt(missing))], axis=1)
    # Of few numbers it has taken most of each, and what is left is the smaller still (MacKinnon and White's HC3).
    seen = np.asarray(normal @ sums * (curves.numbers / degrees), dtype=float)
    # Of a line that no response measures, which weighs nothing, there is nothing to have in common.
    surest = np.max(curves.weight * abs(curves.value), axis=0)
    relative = np.divide(1.0, surest, out=np.zeros_like(surest), where=surest > 0.0)
    scored = np.einsum("pmn,mn->pn", model.slope.conj(), curves.weight * curves.value) * relative
    # Where the misfit consists of the curves' own errors, neighbours share as much of both.
    alike = reach if model.misfit > _IS_NOISE * degrees else curves.shared
    common = normal @ np.concatenate([scored.real, scored.imag], axis=1) * np.sqrt(alike)
    return plain, seen, np.asarray(common, dtype=float)
