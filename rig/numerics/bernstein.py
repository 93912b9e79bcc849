"""First downward crossing of a guard, isolated in Bernstein form so that no root can be stepped over.

A guard (gap, contact force) is, over one step, a power series in tau = t/h that has converged to rounding at
degree `DEGREE`. Its Bernstein coefficients on an interval bound it from below and above there; repeated
halving from the left either proves an interval free of zeros or ends at the first one.

References
----------
Farouki, R. T., "The Bernstein polynomial basis: a centennial retrospective", Computer Aided Geometric
Design 29 (2012) 379-419: conversion, subdivision, and the variation-diminishing property used here.
"""

from __future__ import annotations

from math import comb

import numpy as np

from rig.arrays import Array
from rig.numerics.jit import compiled, inlined
from rig.numerics.simd import combine, lowest, negatives

DEGREE = 15
LENGTH = DEGREE + 1
#: Intervals are halved at most this often; by then they are shorter than the rounding of tau.
DEEPEST = 56
NONE = 2.0


def _bernstein_matrices() -> np.ndarray:
    """Power to Bernstein basis on [0, 1] after division by tau^start, stored [start, power, coefficient]."""
    matrices = np.zeros((LENGTH, LENGTH, LENGTH))
    for start in range(LENGTH):
        degree = DEGREE - start
        for i in range(degree + 1):
            for k in range(i + 1):
                matrices[start, start + k, i] = comb(i, k) / comb(degree, k)
    return matrices


BERNSTEIN = _bernstein_matrices()
#: Infinity after the coefficients of a deflated series.
BEYOND = np.where(np.add.outer(np.arange(LENGTH), np.arange(LENGTH)) > DEGREE, np.inf, 0.0)


@inlined
def _value_slope_bend(series: Array, start: int, tau: float) -> tuple[float, float, float]:
    """Value, slope and half the second derivative of series[start:] at tau.

    Even and odd powers are two polynomials in tau^2, E + tau O, so that the additions wait half as often.
    """
    square = tau * tau
    even, even_slope, even_bend = 0.0, 0.0, 0.0
    odd, odd_slope, odd_bend = 0.0, 0.0, 0.0
    top = DEGREE
    if (DEGREE - start) % 2 == 0:
        even = series[DEGREE]
        top = DEGREE - 1
    for k in range(top, start, -2):
        odd_bend = odd_bend * square + odd_slope
        even_bend = even_bend * square + even_slope
        odd_slope = odd_slope * square + odd
        even_slope = even_slope * square + even
        odd = odd * square + series[k]
        even = even * square + series[k - 1]
    value = even + tau * odd
    slope = odd + 2.0 * tau * (even_slope + tau * odd_slope)
    bend = even_slope + 3.0 * tau * odd_slope + 4.0 * square * (even_bend + tau * odd_bend)
    return value, slope, bend


@inlined
def _polish(series: Array, start: int, left: float, right: float, tau: float) -> float:
    """Root in a bracket that holds exactly one (positive at left, negative at right): Halley, else bisection."""
    for _ in range(200):
        value, slope, bend = _value_slope_bend(series, start, tau)
        if value > 0.0:
            left = tau
        else:
            right = tau
        # Between two neighbouring roots the slope vanishes, and Halley's step with it: there the bracket is halved.
        curved = value * bend
        following = right
        if slope < 0.0 and abs(curved) < 0.5 * slope * slope:
            change = -value * slope / (slope * slope - curved)
            following = tau + change
            if left <= following <= right:
                tau = following
                # Convergence is cubic: what is left is about (bend / slope)^2 change^3.
                if (bend * change) ** 2 * abs(change) <= 1e-17 * tau * slope * slope:
                    break
                continue
        tau = 0.5 * (left + right)
        if right - left <= 4e-16 * right:
            break
    return tau


@inlined
def _only_crossing(coefficients: Array, degree: int) -> float:
    """Guess at the only root, where the coefficients change sign once: their polygon's, on [0, 1]; else `NONE`."""
    positive = ~negatives(coefficients) & ((1 << (degree + 1)) - 1)
    if positive & (positive + 1) != 0:
        return NONE
    last = -1
    while positive > 0:
        positive >>= 1
        last += 1
    before, after = coefficients[last], coefficients[last + 1]
    return (last + before / (before - after)) / degree


@compiled
def _split(work: Array, level: int, degree: int) -> None:
    """De Casteljau at the middle: the right half stays in work[level], the left half goes to work[level + 1]."""
    right = work[level]
    left = work[level + 1]
    left[0] = right[0]
    for i in range(1, degree + 1):
        for k in range(degree - i + 1):
            right[k] = 0.5 * (right[k] + right[k + 1])
        left[i] = right[0]
    for i in range(degree + 1, LENGTH):
        left[i] = np.inf
    # The triangle leaves right[k] = b_k^(degree - k), which is the k-th coefficient of the right half.


@compiled
def first_crossing(
    series: Array, start: int, allowance: float, work: Array, spans: Array, bernstein: Array
) -> tuple[float, int]:
    """Find where a guard first falls below zero on (0, 1].

    `series`: power-series coefficients in tau of a guard that should stay positive; `start`: number of leading
    coefficients known to be exactly zero (multiplicity of the root at tau = 0); `allowance`: rounding of the guard:
    values within it are rounding errors of zero; `work`: scratch space; `bernstein`: the conversion matrices
    `BERNSTEIN`. Returns `tau`, the crossing; 0 when the guard is at zero within rounding and falling; `NONE` when
    there is none; `ambiguous`, number of dips whose depth lies within the allowance; they are decided as no event.
    """
    while start < LENGTH and abs(series[start]) <= allowance:
        start += 1
    if start == LENGTH:
        return NONE, 0
    if series[start] < 0.0:
        return 0.0, 0
    degree = DEGREE - start
    combine(bernstein, BEYOND, start, series, LENGTH, work[0])
    if lowest(work[0]) > allowance:
        return NONE, 0
    ambiguous = 0
    touched = -1.0
    spans[0, 0] = 0.0
    spans[0, 1] = 1.0
    level = 0
    while level >= 0:
        coefficients = work[level]
        left = spans[level, 0]
        right = spans[level, 1]
        deepest = lowest(coefficients)
        # A dip of the deflated guard counts when it is one of the guard itself, tau^start times larger.
        rounding = allowance / right**start
        if deepest >= -rounding:
            # No dip deeper than rounding here; what touches zero within rounding is counted, once for a dip.
            if deepest <= allowance and right < 1.0:
                if left != touched:
                    ambiguous += 1
                touched = right
            level -= 1
            continue
        if coefficients[degree] < -rounding and coefficients[0] > allowance:
            part = _only_crossing(coefficients, degree)
            if part != NONE:
                guess = left + (right - left) * part
                return _polish(series, start, left, right, guess), ambiguous
        if level >= DEEPEST or right - left < 1e-15 * max(right, 1e-3):
            return left, ambiguous
        middle = 0.5 * (left + right)
        _split(work, level, degree)
        spans[level, 0] = middle
        spans[level + 1, 0] = left
        spans[level + 1, 1] = middle
        level += 1
    return NONE, ambiguous
