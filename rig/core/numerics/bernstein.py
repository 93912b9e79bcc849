"""First downward zero crossing of a function, isolated in Bernstein form so that no root can be stepped over.

The function is called a *guard* (in the engine a gap or a contact force). Over one step of length h it is a power
series in tau = t/h, which has converged to rounding error at degree `DEGREE`. The smallest and largest Bernstein
coefficients on an interval are bounds of the guard there. Repeated halving from the left either proves an interval free
of zeros, or ends at the first zero. A *dip* is a minimum of the guard that is zero within rounding error.

References
----------
Farouki, R. T., "The Bernstein polynomial basis: a centennial retrospective", Computer Aided Geometric
Design 29 (2012) 379-419: conversion, subdivision, and the variation-diminishing property used here.
"""

from math import comb

import numpy as np

from rig.core.base.arrays import Array
from rig.core.numerics.jit import inlined_kernel, kernel
from rig.core.numerics.simd import affine_product, minimum, negative_bits

#: Degree at which the power series of a guard over one step has converged to rounding error.
DEGREE = 15
#: Number of coefficients of this series.
N_COEFFICIENTS = DEGREE + 1
#: Maximum number of halvings of an interval; after these it is shorter than the rounding of tau.
MAX_HALVINGS = 56
#: Result without a crossing: a tau outside the step.
NO_CROSSING = 2.0


def _bernstein_matrices() -> np.ndarray:
    """Return matrices [start, power, coefficient] from power to Bernstein basis; a series is divided by tau^start."""
    matrices = np.zeros((N_COEFFICIENTS, N_COEFFICIENTS, N_COEFFICIENTS))
    for start in range(N_COEFFICIENTS):
        degree = DEGREE - start
        for i in range(degree + 1):
            for k in range(i + 1):
                matrices[start, start + k, i] = comb(i, k) / comb(degree, k)
    return matrices


BERNSTEIN = _bernstein_matrices()
#: Added to the coefficients [start]: infinity after the last coefficient of a deflated series, 0 elsewhere. A series is
#: deflated by division by tau^start, which removes its zero at tau = 0.
PADDING = np.where(np.add.outer(np.arange(N_COEFFICIENTS), np.arange(N_COEFFICIENTS)) > DEGREE, np.inf, 0.0)


@inlined_kernel
def _value_and_derivatives(series: Array, start: int, tau: float) -> tuple[float, float, float]:
    """Return value, slope and half the second derivative of series[start:] at tau.

    Even and odd powers are two polynomials in tau^2, E + tau O, which the processor evaluates in parallel.
    """
    square = tau * tau
    even, even_slope, even_half_curvature = 0.0, 0.0, 0.0
    odd, odd_slope, odd_half_curvature = 0.0, 0.0, 0.0
    highest_power = DEGREE
    if (DEGREE - start) % 2 == 0:
        even = series[DEGREE]
        highest_power = DEGREE - 1
    for k in range(highest_power, start, -2):
        odd_half_curvature = odd_half_curvature * square + odd_slope
        even_half_curvature = even_half_curvature * square + even_slope
        odd_slope = odd_slope * square + odd
        even_slope = even_slope * square + even
        odd = odd * square + series[k]
        even = even * square + series[k - 1]
    value = even + tau * odd
    slope = odd + 2.0 * tau * (even_slope + tau * odd_slope)
    half_curvature = (
        even_slope + 3.0 * tau * odd_slope + 4.0 * square * (even_half_curvature + tau * odd_half_curvature)
    )
    return value, slope, half_curvature


@inlined_kernel
def _refine_root(series: Array, start: int, left: float, right: float, tau: float) -> float:
    """Return the only root in a bracket (positive at left, negative at right), by Halley's method or bisection."""
    for _ in range(200):
        value, slope, half_curvature = _value_and_derivatives(series, start, tau)
        if value > 0.0:
            left = tau
        else:
            right = tau
        # Where the slope is too small for Halley's step, the bracket is halved.
        product = value * half_curvature
        next_tau = right
        if slope < 0.0 and abs(product) < 0.5 * slope * slope:
            change = -value * slope / (slope * slope - product)
            next_tau = tau + change
            if left <= next_tau <= right:
                tau = next_tau
                # Convergence is cubic: the remaining error is about (half_curvature / slope)^2 change^3.
                if (half_curvature * change) ** 2 * abs(change) <= 1e-17 * tau * slope * slope:
                    break
                continue
        tau = 0.5 * (left + right)
        if right - left <= 4e-16 * right:
            break
    return tau


@inlined_kernel
def _estimate_single_root(coefficients: Array, degree: int) -> float:
    """Return the root of the control polygon on [0, 1] if the coefficients change sign once, else `NO_CROSSING`."""
    positive = ~negative_bits(coefficients) & ((1 << (degree + 1)) - 1)
    if positive & (positive + 1) != 0:
        return NO_CROSSING
    last_positive = -1
    while positive > 0:
        positive >>= 1
        last_positive += 1
    above, below = coefficients[last_positive], coefficients[last_positive + 1]
    return (last_positive + above / (above - below)) / degree


@kernel
def _split(subdivision: Array, level: int, degree: int) -> None:
    """Halve an interval by de Casteljau's algorithm: left half in row level + 1, right half in row level."""
    right = subdivision[level]
    left = subdivision[level + 1]
    left[0] = right[0]
    for i in range(1, degree + 1):
        for k in range(degree - i + 1):
            right[k] = 0.5 * (right[k] + right[k + 1])
        left[i] = right[0]
    for i in range(degree + 1, N_COEFFICIENTS):
        left[i] = np.inf
    # Now right[k] = b_k^(degree - k), which is the k-th coefficient of the right half.


@kernel
def first_crossing(
    series: Array, start: int, rounding: float, subdivision: Array, spans: Array, bernstein: Array
) -> tuple[float, int]:
    """Locate the first instant on (0, 1] at which a guard falls below zero.

    `series`: power-series coefficients of the guard in tau; `start`: number of leading coefficients known to be exactly
    zero (multiplicity of the zero at tau = 0); `rounding`: largest value of the guard that is a rounding error of zero;
    `bernstein`: the conversion matrices `BERNSTEIN`. `subdivision`, `spans`: scratch arrays; row k of `subdivision`
    contains the Bernstein coefficients on the interval of level k, and row k of `spans` its ends.

    Returns (tau, ambiguous). `tau`: the crossing; 0 if the guard is zero within rounding error at tau = 0 and falling;
    `NO_CROSSING` if there is none. `ambiguous`: number of dips before it, which are not counted as crossings.
    """
    while start < N_COEFFICIENTS and abs(series[start]) <= rounding:
        start += 1
    if start == N_COEFFICIENTS:
        return NO_CROSSING, 0
    if series[start] < 0.0:
        return 0.0, 0
    degree = DEGREE - start
    affine_product(bernstein, PADDING, start, series, N_COEFFICIENTS, subdivision[0])
    if minimum(subdivision[0]) > rounding:
        return NO_CROSSING, 0
    ambiguous = 0
    previous_dip_end = -1.0
    spans[0, 0] = 0.0
    spans[0, 1] = 1.0
    level = 0
    while level >= 0:
        coefficients = subdivision[level]
        left = spans[level, 0]
        right = spans[level, 1]
        lower_bound = minimum(coefficients)
        # The guard is tau^start times the deflated guard, so its rounding error is divided by tau^start.
        deflated_rounding = rounding / right**start
        if lower_bound >= -deflated_rounding:
            # The guard does not fall below zero here. A dip that extends over two intervals is counted once.
            if lower_bound <= rounding and right < 1.0:
                if left != previous_dip_end:
                    ambiguous += 1
                previous_dip_end = right
            level -= 1
            continue
        if coefficients[degree] < -deflated_rounding and coefficients[0] > rounding:
            fraction = _estimate_single_root(coefficients, degree)
            if fraction != NO_CROSSING:
                estimate = left + (right - left) * fraction
                return _refine_root(series, start, left, right, estimate), ambiguous
        if level >= MAX_HALVINGS or right - left < 1e-15 * max(right, 1e-3):
            return left, ambiguous
        middle = 0.5 * (left + right)
        _split(subdivision, level, degree)
        spans[level, 0] = middle
        spans[level + 1, 0] = left
        spans[level + 1, 1] = middle
        level += 1
    return NO_CROSSING, ambiguous
