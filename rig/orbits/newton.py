"""Newton's iteration for the unknowns of an orbit, and its monodromy matrix."""

from __future__ import annotations

import numpy as np

from rig.arrays import Array
from rig.numerics.jit import stored
from rig.orbits.orbit_equations import Change, Equations, Sequence
from rig.orbits.shooting import Shot, shoot

# A solution is accepted when its next correction and its residuals, relative to the motion, are below this.
SETTLED = 3e-13


@stored
def correct(
    equations: Equations,
    change: Change,
    sequence: Sequence,
    unknowns: Array,
    scale: Array,
    rows: Array,
    most: int,
) -> tuple[Array, Array, Shot, float, int]:
    """Solve the equations of an orbit by Newton's iteration, the parameter fixed.

    `scale`, `rows`, shape (unknowns,): sizes of the unknowns and of the residuals; `most`: maximum number of
    corrections. Returns `slope`, derivative of the unknowns with respect to the parameter; `shot`, evaluation at the
    solution; `last`, size of the last correction; `corrections`, number of corrections; -1 if the iteration did not
    converge.
    """
    x, slope, last = unknowns.copy(), np.zeros(unknowns.size), np.inf
    shot = shoot(equations, change, sequence, x)
    for iteration in range(most):
        system = shot.jacobian[:, : x.size].copy()
        right = np.empty((x.size, 2))
        for i in range(x.size):
            right[i, 0], right[i, 1] = -shot.residual[i] / rows[i], -shot.jacobian[i, x.size] / rows[i]
            for j in range(x.size):
                system[i, j] *= scale[j] / rows[i]
        if not (np.isfinite(system).all() and np.isfinite(right).all()):
            return x, slope, shot, last, -1
        solved = np.linalg.solve(system, right)
        move, slope = solved[:, 0], solved[:, 1] * scale
        size = np.abs(move).max()
        missed = np.abs(right[:, 0]).max()
        if (size < SETTLED and missed < SETTLED) or (size < 1e-9 and size > 0.3 * last):
            return x, slope, shot, size, iteration
        # A divergent iteration stops before its instants become arbitrarily large.
        if not size < 1e3 * min(1.0, max(last, 1e-3)):
            return x, slope, shot, size, -1
        x += move * scale
        last = size
        shot = shoot(equations, change, sequence, x)
    return x, slope, shot, last, -1


@stored
def distance(one: Array, other: Array, scale: Array) -> float:
    """Return the largest scaled difference between two sets of unknowns."""
    return float(np.abs((one - other) / scale).max())


@stored
def monodromy(shot: Shot, events: int, scale: Array, rows: Array) -> Array:
    """Compute the scaled monodromy matrix; the event conditions are solved for the instants."""
    size = scale.size
    cut = size - events
    jacobian = shot.jacobian[:, :size].copy()
    for i in range(size):
        for j in range(size):
            jacobian[i, j] *= scale[j] / rows[i]
    period_map = jacobian[:cut, :cut].copy()
    for i in range(cut):
        period_map[i, i] += 1.0
    if events > 0:
        moved = np.linalg.solve(jacobian[cut:, cut:].copy(), jacobian[cut:, :cut].copy())
        period_map -= jacobian[:cut, cut:].copy() @ moved
    return period_map
