"""Newton's iteration for the unknowns of an orbit, and the monodromy matrix of the orbit."""

from typing import NamedTuple

import numpy as np

from rig.core.base.arrays import Array
from rig.core.numerics.jit import cached_njit
from rig.core.orbits.orbit_equations import EquationDerivatives, Equations, Sequence
from rig.core.orbits.shooting import ShootingResult, shoot

# A solution is accepted if the last correction and the residual are at most this fraction of the motion.
CONVERGENCE_TOLERANCE = 3e-13


class IterationLimits(NamedTuple):
    """Limits beyond which `newton_solve` ends without a solution; the size of a correction is its largest entry.

    The default sizes only prevent instants of events from becoming arbitrarily large.
    """

    corrections: int  # largest number of corrections
    first_size: float = 1e3  # largest size of the first correction
    growth: float = 1e3  # largest ratio of the sizes of successive corrections


@cached_njit
def newton_solve(
    equations: Equations,
    derivatives: EquationDerivatives,
    sequence: Sequence,
    unknowns: Array,
    scale: Array,
    residual_scale: Array,
    limits: IterationLimits,
) -> tuple[Array, Array, ShootingResult, float, int]:
    """Solve the equations of an orbit by Newton's iteration, the parameter fixed.

    `scale`, `residual_scale`, shape (unknowns,): scales of the unknowns and of the residuals.

    Returns the unknowns, their derivative with respect to the parameter, the shooting result at the solution, the
    largest scaled element of the last correction, and the number of corrections, which is -1 without convergence.
    """
    x, slope, last_correction = unknowns.copy(), np.zeros(unknowns.size), np.inf
    max_correction = limits.first_size
    shooting = shoot(equations, derivatives, sequence, x)
    for corrections in range(limits.corrections):
        system = shooting.jacobian[:, : x.size].copy()
        rhs = np.empty((x.size, 2))
        for i in range(x.size):
            rhs[i, 0] = -shooting.residual[i] / residual_scale[i]
            rhs[i, 1] = -shooting.jacobian[i, x.size] / residual_scale[i]
            for j in range(x.size):
                system[i, j] *= scale[j] / residual_scale[i]
        if not (np.isfinite(system).all() and np.isfinite(rhs).all()):
            return x, slope, shooting, last_correction, -1
        solution = np.linalg.solve(system, rhs)
        correction, slope = solution[:, 0], solution[:, 1] * scale
        largest_correction = np.abs(correction).max()
        residual = np.abs(rhs[:, 0]).max()
        # The iteration has converged, or the correction is small and no longer decreases because of rounding.
        is_converged = largest_correction < CONVERGENCE_TOLERANCE and residual < CONVERGENCE_TOLERANCE
        if is_converged or (largest_correction < 1e-9 and largest_correction > 0.3 * last_correction):
            return x, slope, shooting, largest_correction, corrections
        if not largest_correction < max_correction:
            return x, slope, shooting, largest_correction, -1
        x += correction * scale
        last_correction, max_correction = largest_correction, limits.growth * min(1.0, max(largest_correction, 1e-3))
        shooting = shoot(equations, derivatives, sequence, x)
    return x, slope, shooting, last_correction, -1


@cached_njit
def distance(first: Array, second: Array, scale: Array) -> float:
    """Return the largest scaled difference between two sets of unknowns."""
    return float(np.abs((first - second) / scale).max())


@cached_njit
def monodromy(shooting: ShootingResult, events: int, scale: Array, residual_scale: Array) -> Array:
    """Compute the scaled monodromy matrix: the derivative of the state after a period with respect to its start.

    The event conditions are solved for the instants of the events.
    """
    n_unknowns = scale.size
    initial = n_unknowns - events
    jacobian = shooting.jacobian[:, :n_unknowns].copy()
    for i in range(n_unknowns):
        for j in range(n_unknowns):
            jacobian[i, j] *= scale[j] / residual_scale[i]
    period_map = jacobian[:initial, :initial].copy()
    for i in range(initial):
        period_map[i, i] += 1.0
    if events > 0:
        instants = np.linalg.solve(jacobian[initial:, initial:].copy(), jacobian[initial:, :initial].copy())
        period_map -= jacobian[:initial, initial:].copy() @ instants
    return period_map
