"""Newton's iteration for the unknowns of an orbit, and its monodromy matrix."""

from __future__ import annotations

import numpy as np

from rig.arrays import Array
from rig.numerics.jit import cached_njit
from rig.orbits.orbit_equations import EquationDerivatives, Equations, Sequence
from rig.orbits.shooting import ShootingResult, shoot

# Largest correction and residual, relative to the motion, of an accepted solution.
CONVERGENCE_TOLERANCE = 3e-13


@cached_njit
def newton_solve(
    equations: Equations,
    derivatives: EquationDerivatives,
    sequence: Sequence,
    unknowns: Array,
    scale: Array,
    residual_scale: Array,
    max_corrections: int,
) -> tuple[Array, Array, ShootingResult, float, int]:
    """Solve the equations of an orbit by Newton's iteration, the parameter fixed.

    `scale`, `residual_scale`, shape (unknowns,): scales of the unknowns and of the residuals.

    Returns the unknowns, their derivative with respect to the parameter, the evaluation at the solution, the size of
    the last correction, and the number of corrections. This number is -1 if the iteration did not converge.
    """
    x, slope, last_size = unknowns.copy(), np.zeros(unknowns.size), np.inf
    shooting = shoot(equations, derivatives, sequence, x)
    for corrections in range(max_corrections):
        system = shooting.jacobian[:, : x.size].copy()
        rhs = np.empty((x.size, 2))
        for i in range(x.size):
            rhs[i, 0] = -shooting.residual[i] / residual_scale[i]
            rhs[i, 1] = -shooting.jacobian[i, x.size] / residual_scale[i]
            for j in range(x.size):
                system[i, j] *= scale[j] / residual_scale[i]
        if not (np.isfinite(system).all() and np.isfinite(rhs).all()):
            return x, slope, shooting, last_size, -1
        solution = np.linalg.solve(system, rhs)
        correction, slope = solution[:, 0], solution[:, 1] * scale
        size = np.abs(correction).max()
        residual = np.abs(rhs[:, 0]).max()
        is_converged = size < CONVERGENCE_TOLERANCE and residual < CONVERGENCE_TOLERANCE
        if is_converged or (size < 1e-9 and size > 0.3 * last_size):
            return x, slope, shooting, size, corrections
        # A divergent iteration stops before its instants become arbitrarily large.
        if not size < 1e3 * min(1.0, max(last_size, 1e-3)):
            return x, slope, shooting, size, -1
        x += correction * scale
        last_size = size
        shooting = shoot(equations, derivatives, sequence, x)
    return x, slope, shooting, last_size, -1


@cached_njit
def distance(first: Array, second: Array, scale: Array) -> float:
    """Return the largest scaled difference between two sets of unknowns."""
    return float(np.abs((first - second) / scale).max())


@cached_njit
def monodromy(shooting: ShootingResult, events: int, scale: Array, residual_scale: Array) -> Array:
    """Compute the scaled monodromy matrix: the derivative of the state after a period with respect to its start.

    The event conditions are solved for the instants of the events.
    """
    size = scale.size
    initial = size - events
    jacobian = shooting.jacobian[:, :size].copy()
    for i in range(size):
        for j in range(size):
            jacobian[i, j] *= scale[j] / residual_scale[i]
    period_map = jacobian[:initial, :initial].copy()
    for i in range(initial):
        period_map[i, i] += 1.0
    if events > 0:
        instants = np.linalg.solve(jacobian[initial:, initial:].copy(), jacobian[initial:, :initial].copy())
        period_map -= jacobian[:initial, initial:].copy() @ instants
    return period_map
