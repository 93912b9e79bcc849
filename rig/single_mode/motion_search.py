"""Search for all periodic motions of one type of a mode with a damper at one frequency.

For given instants (take-off, ceiling impact, take-off from the ceiling) the conditions of
`rig.single_mode.periodic_motion` are linear in all other unknowns. Those are eliminated, which leaves one, two or three
equations in as many instants between 0 and 2 pi. The equations are evaluated on a grid over the whole range;
cells in which each changes sign are refined by Newton's iteration in the instants alone.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from rig.single_mode.periodic_motion import (
    INSTANTS,
    TURN,
    Array,
    MotionParameters,
    MotionType,
    PeriodicMotion,
)

Floats = NDArray[np.float64]

# Points per instant: the equations are smooth in the instants, so that solutions closer than such a cell are
# a matter of a fold, from whose other side (or from another frequency) the continuation arrives.
_GRID: dict[MotionType, int] = {"I": 720, "II": 72, "III": 32}

# A flight shorter than this [rad] is not looked for: at length 0 take-off and landing are one event and the
# conditions say nothing. A damper thrown for so short was accelerated by 1 + 3e-6 of gravity (t = 4 sqrt(G^2
# - 1)).
SHORTEST_FLIGHT = 0.01


ENDS = ("the ride on the floor vanishes", "the flight vanishes", "the stay at the ceiling vanishes")


def order(kind: MotionType, instants: Floats) -> Floats:
    """Measure the room that is left before a ride, a flight or (Type III) a stay ends; negative if out of order."""
    lengths = np.diff([0.0, *instants, TURN])
    flights = np.delete(lengths, [0, 2] if kind == "III" else [0])
    stay = [lengths[2]] if kind == "III" else []
    return np.array([lengths[0], flights.min() - SHORTEST_FLIGHT, *stay])


def eliminate(kind: MotionType, instants: Array, setting: MotionParameters) -> tuple[Array, Array]:
    """Solve the linear conditions for given instants, and evaluate the others.

    Parameters
    ----------
    kind : {'I', 'II', 'III'}
        Motion type.
    instants : array, shape (instants, batch)
        Given instants; complex ones are allowed, for derivatives by a complex step.

    Returns
    -------
    unknowns : array, shape (4 + instants, batch)
        With the (q_0, q'_0, a, b) that meet the first four conditions.
    left : array, shape (instants, batch)
        What remains: the ceiling contact (Type III), the ceiling's height over the gap there (II and III)
        and, last, half the logarithm of the squared force that the motion needs over the one that acts.
    """
    # None of the four, and each by itself, at the same instants.
    trials = np.concatenate([np.zeros((4, 1, 1)), np.eye(4)[:, :, None]], axis=1)
    values = PeriodicMotion(kind, [*trials, *instants], setting).affine_conditions()
    matrix = np.moveaxis(values[:4, 1:] - values[:4, :1], 2, 0)
    with np.errstate(all="ignore"):
        amplitudes = _solve(matrix, -values[:4, 0].T)
        unknowns = np.concatenate([amplitudes.T, instants])
        motion = PeriodicMotion(kind, unknowns, setting)
        left = list(motion.affine_conditions()[4:])
        if kind != "I":
            left.append(motion.ceiling_gap() - motion.height)
        left.append(0.5 * np.log((motion.a**2 + motion.b**2) / setting.force**2))
    return unknowns, np.array(left)


def solutions(kind: MotionType, setting: MotionParameters) -> Floats:
    """Find all solutions of one type at one frequency; impossible motions are among them.

    Parameters
    ----------
    kind : {'I', 'II', 'III'}
        Motion type.

    Returns
    -------
    ndarray, shape (solutions, 4 + instants)
        Unknowns as in `rig.single_mode.periodic_motion`, to the accuracy of the elimination.
    """
    count, points = INSTANTS[kind], _GRID[kind]
    grid = (np.arange(points) + 0.5) * TURN / points
    instants = np.array(np.meshgrid(*[grid] * count, indexing="ij"))
    # Cells across the diagonal belong to the search too, so that short stays and flights are not lost.
    ordered = (np.diff(instants, axis=0) > -3 * grid[0]).all(axis=0)
    left = np.full(instants.shape, np.nan)
    left[:, ordered] = eliminate(kind, instants[:, ordered], setting)[1]
    cells = np.ones([points - 1] * count, dtype=bool)
    corners = list(product((slice(None, -1), slice(1, None)), repeat=count))
    for equation in left:
        values = [equation[corner] for corner in corners]
        cells &= (np.min(values, axis=0) < 0) & (np.max(values, axis=0) > 0)
    starts = np.array([grid[index] for index in np.nonzero(cells)]) + grid[0]
    found: list[Floats] = []
    for candidate in _refine(kind, starts, setting).T:
        if (order(kind, candidate) > 0).all() and not any(
            np.allclose(candidate, f, rtol=0, atol=1e-6) for f in found
        ):
            found.append(candidate)
    if not found:
        return np.empty((0, 4 + count))
    return eliminate(kind, np.array(found).T, setting)[0].T


def _refine(kind: MotionType, instants: Floats, setting: MotionParameters) -> Floats:
    """Solve the remaining equations from many starts at once; the instants of those that settled."""
    count = instants.shape[0]
    longest = TURN / _GRID[kind]
    for _ in range(15):
        if not instants.size:
            break
        batch = instants.shape[1]
        shifted = (instants[:, None] + 1e-40j * np.eye(count)[:, :, None]).reshape(count, -1)
        left = eliminate(kind, shifted, setting)[1].reshape(count, count, batch)
        slopes = np.moveaxis(left.imag / 1e-40, 2, 0)
        move = _solve(slopes, -left[:, 0].real.T).T
        size = np.abs(move).max(axis=0)
        with np.errstate(invalid="ignore"):
            move = move * np.minimum(1.0, longest / np.maximum(size, 1e-300))
        # Starts of changes of sign through infinity, and of near misses, leave here.
        keep = np.isfinite(move).all(axis=0) & (instants > 0).all(axis=0) & (instants < TURN).all(axis=0)
        instants, size = (instants + move)[:, keep], size[keep]
    return instants[:, size < 1e-9] if instants.size else instants


def _solve(matrices: Array, right: Array) -> Array:
    """Solve many small linear systems; NaN where one is singular."""
    try:
        return np.linalg.solve(matrices, right[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        solved = np.full(right.shape, np.nan, dtype=np.result_type(matrices, right))
        regular = np.abs(np.linalg.det(matrices)) > 0
        solved[regular] = np.linalg.solve(matrices[regular], right[regular][:, :, None])[:, :, 0]
        return solved
