"""Nonlinear least squares with a trust region, by the Levenberg-Marquardt method of Moré [1]_.

It takes the steps of `scipy.optimize.least_squares` with the method ``trf`` and without bounds. The order of a modal
model is selected by a hundred fits of a few unknowns: the import of scipy.optimize and its overhead in each call would
take longer than these fits.

References
----------
.. [1] J. J. Moré, The Levenberg-Marquardt algorithm: implementation and theory, Lecture Notes in Mathematics 630,
   Springer 1978, 105-116.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import numpy as np

from rig.arrays import Array

# The iteration has converged if a step reduces the sum of squares, or changes the unknowns, by less than this ratio.
_TOLERANCE = 1e-9
# The iteration has also converged if no element of the gradient of half the sum of squares exceeds this.
_MAX_FINAL_GRADIENT = 1e-12
# The radius decreases if the sum of squares decreases by less than this ratio of the decrease of the linearization.
_POOR_RATIO = 0.25
# The radius increases if this ratio is exceeded in a step to the edge of the trust region.
_GOOD_RATIO = 0.75
# A step ends at the edge if its length exceeds this ratio of the radius.
_EDGE_RATIO = 0.95
# Maximum relative deviation of the length of a damped step from the radius.
_LENGTH_TOLERANCE = 0.01
# Maximum number of iterations for the damping of a step.
_MAX_DAMPING_STEPS = 10
# Relative rounding error of the singular values.
_ROUNDING = float(np.finfo(float).eps)
# Minimum damping relative to its upper bound.
_MIN_DAMPING_RATIO = 1e-3


def minimize_squares(
    residual: Callable[[Array], Array], jacobian: Callable[[Array], Array], start: Array, max_evaluations: int
) -> Array:
    """Minimize the sum of squared residuals with at most `max_evaluations` evaluations; return the unknowns.

    >>> minimize_squares(lambda x: x**2 - 4.0, lambda x: np.diag(2.0 * x), np.array([1.0, -1.0]), 25).round(9)
    array([ 2., -2.])
    """
    x, values = start, residual(start)
    radius, damping, evaluations = _norm(start) or 1.0, 0.0, 1
    is_converged = False
    while evaluations < max_evaluations and not is_converged:
        matrix, cost = jacobian(x), float(values @ values)
        gradient = matrix.T @ values
        if abs(gradient).max() < _MAX_FINAL_GRADIENT:
            break
        left, singular, right = np.linalg.svd(matrix, full_matrices=False)
        projection = left.T @ values
        is_better = False
        while evaluations < max_evaluations and not is_better and not is_converged:
            step, damping = _step(singular, projection, right, len(matrix), radius, damping)
            length, trial = _norm(step), residual(x + step)
            evaluations += 1
            if not np.isfinite(trial).all():
                radius = 0.25 * length
                continue
            reduction = cost - float(trial @ trial)
            change = matrix @ step
            expected = -float(change @ change + 2.0 * (step @ gradient))
            ratio = reduction / expected if expected > 0.0 else 0.0
            is_better = reduction > 0.0
            is_converged = (reduction < _TOLERANCE * cost and ratio > _POOR_RATIO) or length < _TOLERANCE * (
                _TOLERANCE + _norm(x)
            )
            previous_radius = radius
            if ratio < _POOR_RATIO:
                radius = 0.25 * length
            elif ratio > _GOOD_RATIO and length > _EDGE_RATIO * radius:
                radius *= 2.0
            damping *= previous_radius / radius
        if is_better:
            x, values = x + step, trial
    return x


def _step(
    singular: Array, projection: Array, right: Array, n_residuals: int, radius: float, damping: float
) -> tuple[Array, float]:
    """Return the step that minimizes the linearized sum of squares within a radius, and its damping.

    `singular`, `right`: singular values and right singular vectors of the Jacobian; `projection`: components of the
    residuals along its left singular vectors; `damping`: initial value.
    """
    scaled = singular * projection
    lower, upper = 0.0, _norm(scaled) / radius
    has_full_rank = n_residuals >= right.shape[1] and singular[-1] > _ROUNDING * n_residuals * singular[0]
    if has_full_rank:
        step = -(projection / singular) @ right
        if (length := _norm(step)) <= radius:
            return step, 0.0
        lower = (length - radius) * length / float(np.sum(projection**2 / singular**4))
    elif damping == 0.0:
        damping = _MIN_DAMPING_RATIO * upper
    for _ in range(_MAX_DAMPING_STEPS):
        if not lower <= damping <= upper:
            damping = max(_MIN_DAMPING_RATIO * upper, sqrt(lower * upper))
        divisor = singular**2 + damping
        length = _norm(scaled / divisor)
        excess = length - radius
        newton_step = -excess * length / float(np.sum(scaled**2 / divisor**3))
        if excess < 0.0:
            upper = damping
        lower = max(lower, damping - newton_step)
        damping -= length * newton_step / radius
        if abs(excess) < _LENGTH_TOLERANCE * radius:
            break
    step = -(scaled / (singular**2 + damping)) @ right
    return step * (radius / _norm(step)), damping


def _norm(vector: Array) -> float:
    return sqrt(float(vector @ vector))
