"""Search for all periodic motions of one type of a mode with a damper at one frequency.

For given instants (take-off, ceiling impact, take-off from the ceiling) most conditions of
`rig.studies.single_mode.periodic_motion` are affine in all other unknowns. These unknowns are eliminated, which leaves
one, two or three equations in the same number of instants between 0 and 2 pi. The equations are evaluated on a grid
over the whole range. From each cell in which every equation changes sign, Newton's method is started.
"""

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.studies.single_mode.periodic_motion import INSTANTS, PERIOD, MotionParameters, MotionType, PeriodicMotion

# Grid points per instant. The equations are smooth in the instants, so two solutions in one cell occur only near a
# fold. Continuation from the other side of the fold, or from another frequency, then reaches both.
_GRID: dict[MotionType, int] = {"I": 720, "II": 72, "III": 32}

# The search includes flights of at least this duration, as phase of the drive [rad]. For a shorter flight, take-off and
# landing nearly coincide, and the conditions are nearly singular. The limit corresponds to an acceleration amplitude G
# of 1 + 3e-6 g, from t = 4 sqrt(G^2 - 1).
MIN_FLIGHT_RAD = 0.01
# Reasons for the end of a branch, in the order of `ordering_margins`.
END_REASONS = ("the ride on the floor vanishes", "the flight vanishes", "the stay at the ceiling vanishes")


def ordering_margins(kind: MotionType, instants: Array) -> Array:
    """Return the durations of ride, shortest flight (less its minimum) and stay at the ceiling (Type III only) [rad].

    At least one duration is negative if the instants are out of order.
    """
    durations = np.diff([0.0, *instants, PERIOD])
    flights = np.delete(durations, [0, 2] if kind == "III" else [0])
    stay = [durations[2]] if kind == "III" else []
    return np.array([durations[0], flights.min() - MIN_FLIGHT_RAD, *stay])


def eliminate(kind: MotionType, instants: Array, parameters: MotionParameters) -> tuple[Array, Array]:
    """Solve the first four conditions for given instants, and evaluate the remaining conditions.

    `kind`: type of motion, 'I', 'II' or 'III'; `instants`, shape (instants, batch); complex values are allowed, for
    complex-step derivatives. Returns the unknowns, shape (4 + instants, batch), and the residuals of the remaining
    conditions, shape (instants, batch): contact force per mass at the ceiling (Type III), gap at the ceiling impact
    minus the clearance (II and III), and logarithm of the ratio of required to applied force.
    """
    # The affine conditions are evaluated at zero and at the four unit vectors, to obtain their matrix.
    trials = np.concatenate([np.zeros((4, 1, 1)), np.eye(4)[:, :, None]], axis=1)
    values = PeriodicMotion(kind, [*trials, *instants], parameters).affine_conditions()
    matrix = np.moveaxis(values[:4, 1:] - values[:4, :1], 2, 0)
    with np.errstate(all="ignore"):
        amplitudes = _solve(matrix, -values[:4, 0].T)
        unknowns = np.concatenate([amplitudes.T, instants])
        motion = PeriodicMotion(kind, unknowns, parameters)
        residuals = list(motion.affine_conditions()[4:])
        if kind != "I":
            residuals.append(motion.ceiling_gap() - motion.clearance)
        residuals.append(0.5 * np.log((motion.a**2 + motion.b**2) / parameters.force**2))
    return unknowns, np.array(residuals)


def solutions(kind: MotionType, parameters: MotionParameters) -> Array:
    """Compute all solutions of one type at one frequency, including inadmissible motions.

    `kind`: type of motion, 'I', 'II' or 'III'. Returns shape (solutions, 4 + instants), unknowns as in
    `rig.studies.single_mode.periodic_motion`, to the accuracy of the elimination.
    """
    count, points = INSTANTS[kind], _GRID[kind]
    grid = (np.arange(points) + 0.5) * PERIOD / points
    instants = np.array(np.meshgrid(*[grid] * count, indexing="ij"))
    # Cells across the diagonal are included, so short stays and flights are not missed.
    ordered = (np.diff(instants, axis=0) > -3 * grid[0]).all(axis=0)
    residuals = np.full(instants.shape, np.nan)
    residuals[:, ordered] = eliminate(kind, instants[:, ordered], parameters)[1]
    cells = np.ones([points - 1] * count, dtype=bool)
    corners = list(product((slice(None, -1), slice(1, None)), repeat=count))
    for equation in residuals:
        values = [equation[corner] for corner in corners]
        cells &= (np.min(values, axis=0) < 0) & (np.max(values, axis=0) > 0)
    starts = np.array([grid[index] for index in np.nonzero(cells)]) + grid[0]
    distinct: list[Array] = []
    for candidate in _refine(kind, starts, parameters).T:
        if (ordering_margins(kind, candidate) > 0).all() and not any(
            np.allclose(candidate, solution, rtol=0, atol=1e-6) for solution in distinct
        ):
            distinct.append(candidate)
    if not distinct:
        return np.empty((0, 4 + count))
    return eliminate(kind, np.array(distinct).T, parameters)[0].T


def _refine(kind: MotionType, instants: Array, parameters: MotionParameters) -> Array:
    """Solve the remaining equations from many starts (columns) simultaneously; return the converged instants."""
    count = instants.shape[0]
    max_step = PERIOD / _GRID[kind]  # distance of two starts
    for _ in range(15):
        if not instants.size:
            break
        batch = instants.shape[1]
        shifted = (instants[:, None] + 1e-40j * np.eye(count)[:, :, None]).reshape(count, -1)
        residuals = eliminate(kind, shifted, parameters)[1].reshape(count, count, batch)
        slopes = np.moveaxis(residuals.imag / 1e-40, 2, 0)
        steps = _solve(slopes, -residuals[:, 0].real.T).T
        step_size = np.abs(steps).max(axis=0)
        with np.errstate(invalid="ignore"):
            steps = steps * np.minimum(1.0, max_step / np.maximum(step_size, 1e-300))
        # Discard starts from sign changes through infinity, and starts without a root nearby.
        is_valid = np.isfinite(steps).all(axis=0) & (instants > 0).all(axis=0) & (instants < PERIOD).all(axis=0)
        instants, step_size = (instants + steps)[:, is_valid], step_size[is_valid]
    return instants[:, step_size < 1e-9] if instants.size else instants


def _solve(matrices: Array, right: Array) -> NDArray[Any]:
    """Solve many small linear systems; the result of a singular system is NaN."""
    try:
        return np.linalg.solve(matrices, right[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        solution = np.full(right.shape, np.nan, dtype=np.result_type(matrices, right))
        regular = np.abs(np.linalg.det(matrices)) > 0
        solution[regular] = np.linalg.solve(matrices[regular], right[regular][:, :, None])[:, :, 0]
        return solution
