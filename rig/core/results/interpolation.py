"""Interpolation of a response between its lines, with the error that the spacing of the lines causes.

Around each frequency, two rational functions of type (2, 2) pass through five lines each: two poles, two zeros. They
are computed from the null vector of a Loewner matrix, in barycentric form [1]_. Their mean is the interpolated value.
Their difference estimates the error due to the spacing of the lines: it is small only if these resolve all resonances.

Errors e_i of the values at the lines change a rational interpolant r = P / Q at the frequency t by ``sum(l_i(t) (Q(f_i)
/ Q(t))^2 e_i)``, with the Lagrange polynomials l_i of the lines f_i.

References
----------
.. [1] A. C. Antoulas, Approximation of Large-Scale Dynamical Systems, SIAM 2005, section 4.5.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.uncertainty import Contribution, UncertaintyBudget

#: Contribution of the spacing of the lines to the uncertainty of interpolated values.
SPACING = "spacing of the lines"
# Number of lines of each rational function: of type (2, 2), or (1, 1) if there are few lines.
_LINES = 5
_FEW_LINES = 3
# Limit of error as a multiple of the difference of the two functions, whose errors may have the same sign.
_ERROR_FACTOR = 2.0
# Lines resolve a response if the error of interpolation is at most this fraction of the nearby values, or if it is
# at most this multiple of the uncertainty of these values, because noise disturbs interpolation, too.
_MAX_ERROR_RATIO = 0.1
_MAX_ERROR_IN_UNCERTAINTIES = 3.0
# Relative error of interpolation with the recommended spacing.
_GOOD_ERROR_RATIO = 0.01
# Smallest recommended spacing, relative to the current spacing; estimates of smaller spacings are too uncertain.
_MIN_SPACING_RATIO = 0.02
# A frequency differs from the frequency of a line if their relative difference exceeds this value.
_SAME_FREQUENCY = 1e-9


@dataclass(frozen=True)
class Interpolation:
    """A response interpolated at frequencies between its lines."""

    value: ComplexArray  # NaN outside the range of the lines
    uncertainty: UncertaintyBudget
    spacing: Array  # spacing of the lines around each frequency [Hz]
    needed_spacing: Array  # spacing that resolves the curve [Hz]; infinite where the lines resolve it


def interpolate_curve(
    frequency: Array, value: ComplexArray, uncertainty: UncertaintyBudget, at: Array
) -> Interpolation | None:
    """Interpolate a response between its frequencies, which are ascending; None if fewer than four are distinct.

    The uncertainty of the lines is propagated to first order. Errors of type A are independent, except for `shared`
    neighboring lines, which have a common error. The error of a sensor or clock is the same at all lines. How other
    errors of neighboring lines are related is unknown, so their limits are added.
    """
    lines = np.flatnonzero(np.isfinite(value) & np.append(True, np.diff(frequency) > 0.0))
    count = lines.size
    if count <= _FEW_LINES:
        return None
    f, values, known = frequency[lines], value[lines], uncertainty.at(lines)
    n_lines = _LINES if count > _LINES else _FEW_LINES
    below = np.clip(np.searchsorted(f, at, side="right") - 1, 0, count - 2)
    first = np.clip(below - n_lines // 2, 0, count - n_lines - 1)
    window = first[:, None] + np.arange(n_lines + 1)
    parts = [_rational(f[columns], values[columns], at) for columns in (window[:, :-1], window[:, 1:])]
    result = 0.5 * (parts[0][0] + parts[1][0])
    error = _ERROR_FACTOR * abs(parts[0][0] - parts[1][0])
    weights = np.zeros(window.shape, dtype=complex)
    weights[:, :-1] += 0.5 * parts[0][1]
    weights[:, 1:] += 0.5 * parts[1][1]
    # At the frequency of a line, the value of the line is returned.
    nearest, is_line = nearest_lines(f, at)
    weights[is_line] = window[is_line] == nearest[is_line, None]
    result = np.where(is_line, values[nearest], result)
    error = np.where(is_line, 0.0, np.nan_to_num(error, nan=np.inf))
    is_inside = (at >= f[0]) & (at <= f[-1]) | is_line
    result = np.where(is_inside, result, np.nan)
    budget = _propagate(known, weights, window, result)
    local = np.fmax(abs(result), np.maximum(abs(values[below]), abs(values[below + 1])))
    limit = np.maximum(
        _MAX_ERROR_RATIO * local, _MAX_ERROR_IN_UNCERTAINTIES * np.broadcast_to(budget.expanded(), at.shape)
    )
    is_unresolved, spacing = is_inside & ~(error <= limit), f[below + 1] - f[below]
    # The error of interpolation decreases at least with the square of the spacing.
    ratio = np.divide(_GOOD_ERROR_RATIO * local, error, out=np.ones(at.size), where=error > 0.0)
    needed = np.where(is_unresolved, spacing * np.maximum(np.sqrt(ratio), _MIN_SPACING_RATIO), np.inf)
    return Interpolation(result, budget.with_limits({SPACING: np.where(is_inside, error, np.nan)}), spacing, needed)


def nearest_lines(frequency: Array, at: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the index of the line nearest to each frequency, and whether they are equal; `frequency`: ascending."""
    above = np.clip(np.searchsorted(frequency, at), min(1, frequency.size - 1), frequency.size - 1)
    below = np.maximum(above - 1, 0)
    nearest = np.where(at - frequency[below] < frequency[above] - at, below, above)
    return nearest, abs(frequency[nearest] - at) <= _SAME_FREQUENCY * at


def _rational(f: Array, values: ComplexArray, at: Array) -> tuple[ComplexArray, ComplexArray]:
    """Interpolate each row of `values` over `f`, (n, 2 k + 1), at `at`, (n,); return values and error weights."""
    # Every other line is a support point; the remaining lines determine the weights of the barycentric form.
    support, others = np.arange(0, f.shape[1], 2), np.arange(1, f.shape[1], 2)
    scale = abs(values).max(axis=1, keepdims=True)
    scaled = values / np.where(scale > 0.0, scale, 1.0)
    span = np.ptp(f, axis=1)[:, None]
    x = (f - at[:, None]) / span
    loewner = (scaled[:, others, None] - scaled[:, None, support]) / (x[:, others, None] - x[:, None, support])
    null = np.linalg.svd(loewner)[2][:, -1].conj()
    # Products of the distances from each line to all support points, and to all lines.
    with np.errstate(divide="ignore", invalid="ignore"):
        basis = null / -x[:, support]
        result = np.sum(basis * values[:, support], axis=1) / basis.sum(axis=1)
        distance = x[:, :, None] - x[:, None, :]
        index = np.arange(f.shape[1])
        distance[:, index, index] = 1.0
        lagrange = np.prod(np.where(np.eye(f.shape[1], dtype=bool), 1.0, -x[:, None, :] / distance), axis=2)
        at_lines = np.zeros(f.shape, dtype=complex)
        to_support = distance[:, :, support]
        at_lines[:, support] = null * np.prod(to_support[:, support], axis=2)
        at_lines[:, others] = np.prod(to_support[:, others], axis=2) * np.sum(
            null[:, None] / to_support[:, others], axis=2
        )
        at_target = np.prod(-x[:, support], axis=1) * basis.sum(axis=1)
        return result, lagrange * (at_lines / at_target[:, None]) ** 2


def _propagate(
    budget: UncertaintyBudget, weights: ComplexArray, window: NDArray[np.intp], result: ComplexArray
) -> UncertaintyBudget:
    """Propagate the uncertainty of lines to weighted sums of their values."""
    sizes = abs(weights)

    def add(cause: Contribution) -> Contribution:
        deviation = cause.deviation[window]
        if cause.evaluation == "A":
            # Weights of neighbors with a common error are added.
            total = np.sqrt(budget.shared) * np.linalg.norm(sizes * deviation, axis=1)
            degrees_of_freedom = (
                None if cause.degrees_of_freedom is None else cause.degrees_of_freedom[window].min(axis=1)
            )
            return replace(
                cause,
                deviation=np.minimum(total, np.sum(sizes * deviation, axis=1)),
                degrees_of_freedom=degrees_of_freedom,
            )
        if any(cause.sources):
            changes = {key: np.sum(weights * change[window], axis=1) for key, change in cause.sources[0].items()}
            total = np.linalg.norm(list(changes.values()), ord=1, axis=0)
            # The limits of large tolerances exceed their first-order changes, by about the same factor at neighbors.
            first_order = np.linalg.norm(list(cause.sources[0].values()), ord=1, axis=0)
            excess = np.divide(cause.deviation, first_order, out=np.ones(first_order.size), where=first_order > 0.0)
            with np.errstate(invalid="ignore"):
                total = total * np.sum(sizes * excess[window], axis=1) / sizes.sum(axis=1)
            return replace(cause, deviation=total, sources=(changes,))
        return replace(cause, deviation=np.sum(sizes * deviation, axis=1))

    return replace(budget, contributions=tuple(map(add, budget.contributions)), errors=None)
