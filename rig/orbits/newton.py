"""Newton's iteration for the unknowns of an orbit, and its monodromy matrix."""

from __future__ import annotations

import numpy as np

from rig.arrays import Array
from rig.numerics.jit import cached_njit
from rig.orbits.orbit_equations import Change, Equations, Sequence
from rig.orbits.shooting import Shot, shoot

# Largest correction and residual, relative to the motion, of an accepted solution.
CONVERGED = 3e-13


@cached_njit
def newton_solve(
    equations: Equations,
    change: Change,
    sequence: Sequence,
    unknowns: Array,
    scale: Array,
    rows: Array,
    max_corrections: int,
) -> tuple[Array, Array, Shot, float, int]:
    """Solve the equations of an orbit by Newton's iteration, the parameter fixed.

    `scale`, `rows`, shape (unknowns,): sizes of the unknowns and of the residuals.

    Returns the unknowns, their derivative with respect to the parameter, the evaluation at the solution, the size of
    the last correction, and the number of corrections. This number is -1 if the iteration did not converge.
    """
    x, slope, last_size = unknowns.copy(), np.zeros(unknowns.size), np.inf
    shot = shoot(equations, change, sequence, x)
    for corrections in range(max_corrections):
        system = shot.jacobian[:, : x.size].copy()
        rhs = np.empty((x.size, 2))
        for i in range(x.size):
            rhs[i, 0], rhs[i, 1] = -shot.residual[i] / rows[i], -shot.jacobian[i, x.size] / rows[i]
            for j in range(x.size):
                system[i, j] *= scale[j] / rows[i]
        if not (np.isfinite(system).all() and np.isfinite(rhs).all()):
            return x, slope, shot, last_size, -1
        solution = np.linalg.solve(system, rhs)
        correction, slope = solution[:, 0], solution[:, 1] * scale
        size = np.abs(correction).max()
        residual = np.abs(rhs[:, 0]).max()
        if (size < CONVERGED and residual < CONVERGED) or (size < 1e-9 and size > 0.3 * last_size):
            return x, slope, shot, size, corrections
        # A divergent iteration stops before its instants become arbitrarily large.
        if not size < 1e3 * min(1.0, max(last_size, 1e-3)):
            return x, slope, shot, size, -1
        x += correction * scale
        last_size = size
        shot = shoot(equations, change, sequence, x)
    return x, slope, shot, last_size, -1


@cached_njit
def distance(first: Array, second: Array, scale: Array) -> float:
    """Return the largest scaled difference between two sets of unknowns."""
    return float(np.abs((first - second) / scale).max())


@cached_njit
def monodromy(shot: Shot, events: int, scale: Array, rows: Array) -> Array:
    """Compute the scaled monodromy matrix; the event conditions are solved for the instants."""
    size = scale.size
    initial = size - events
    jacobian = shot.jacobian[:, :size].copy()
    for i in range(size):
        for j in range(size):
            jacobian[i, j] *= scale[j] / rows[i]
    period_map = jacobian[:initial, :initial].copy()
    for i in range(initial):
        period_map[i, i] += 1.0
    if events > 0:
        instants = np.linalg.solve(jacobian[initial:, initial:].copy(), jacobian[initial:, :initial].copy())
        period_map -= jacobian[:initial, initial:].copy() @ instants
    return period_map
