"""The matrix exponential, and the derivative of its product with a state with respect to the matrix."""

import numpy as np

from rig.core.base.arrays import Array
from rig.core.numerics.jit import cached_njit


@cached_njit
def exponential(matrix: Array, time: float, norm_bound: float) -> Array:
    """Compute the exponential of `matrix` times `time` by a Taylor series with scaling and squaring.

    `norm_bound`: upper bound of the norm of the matrix after balancing of its rows and columns [1/s].
    """
    norm, halvings = norm_bound * abs(time), 0
    while norm > 0.25 and halvings < 60:
        norm *= 0.5
        halvings += 1
    x = matrix * (time * 0.5**halvings)
    # Series to degree 12, in groups of three powers, by Horner's method in the cube. The sum s excludes the identity,
    # to avoid cancellation at small times; the square of 1 + s is 1 + (2 s + s s).
    square = x @ x
    cube = square @ x
    total = x / 3628800.0 + square / 39916800.0 + cube / 479001600.0
    total = cube @ total + (x / 5040.0 + square / 40320.0 + cube / 362880.0)
    total = cube @ total + (x / 24.0 + square / 120.0 + cube / 720.0)
    total = cube @ total + (x + square / 2.0 + cube / 6.0)
    for _ in range(halvings):
        total = 2.0 * total + total @ total
    for i in range(matrix.shape[0]):
        total[i, i] += 1.0
    return total


@cached_njit
def exponential_derivative(
    matrix: Array, matrix_derivative: Array, start: Array, start_derivative: Array, time: float, norm_bound: float
) -> Array:
    """Differentiate exp(A t) z(0) with respect to a parameter on which both A and z(0) depend.

    `matrix`, `start`: A and z(0); `time`: t [s]; `norm_bound`: as in `exponential`. The derivative s of z obeys
    s' = A s + (dA) z, which is integrated by Taylor series over substeps.
    """
    n = matrix.shape[0]
    entries, row, column = 0, np.empty(n * n, dtype=np.int64), np.empty(n * n, dtype=np.int64)
    matrix_values, derivative_values = np.empty(n * n), np.empty(n * n)
    for i in range(n):
        for j in range(n):
            if matrix[i, j] != 0.0 or matrix_derivative[i, j] != 0.0:
                row[entries], column[entries] = i, j
                matrix_values[entries], derivative_values[entries] = matrix[i, j], matrix_derivative[i, j]
                entries += 1
    z, s = start.copy(), start_derivative.copy()
    substeps = max(1, int(np.ceil(0.5 * norm_bound * abs(time))))
    h = time / substeps
    z_term, s_term, next_z_term, next_s_term = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for _ in range(substeps):
        z_term[:], s_term[:] = z, s
        # The truncation error 2^20 / 20! = 4e-13 is sufficient for a derivative.
        for k in range(1, 21):
            next_z_term[:], next_s_term[:] = 0.0, 0.0
            for m in range(entries):
                i, j = row[m], column[m]
                next_z_term[i] += matrix_values[m] * z_term[j]
                next_s_term[i] += matrix_values[m] * s_term[j] + derivative_values[m] * z_term[j]
            for i in range(n):
                z_term[i], s_term[i] = h / k * next_z_term[i], h / k * next_s_term[i]
                z[i] += z_term[i]
                s[i] += s_term[i]
    return s
