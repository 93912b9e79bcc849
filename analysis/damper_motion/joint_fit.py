"""Joint fit of velocity jumps whose readings overlap: least squares, with the instants by Gauss-Newton.

Steps and kinks have Gaussian priors, because jumps near to each other hardly determine theirs (ridge regression).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.impact_model import SHIFT, ImpactModel

Array = NDArray[np.float64]

# Gauss-Newton iterations, and the largest change of an instant in one of them, samples.
_ITERATIONS = 4
_MAX_CHANGE = 0.5
# Added to the normal equations of columns of unit length, so that rounding leaves them positive definite.
_ROUNDING = 1e-11
# A jump moves no farther than this from its start, samples: it would take the place of its neighbour.
_MAX_DISTANCE = 2.0


@dataclass(frozen=True, eq=False)
class Jump:
    """A velocity jump, or a kink without one, as fitted."""

    place: float
    """Samples."""
    sizes: Array
    """Jump [m/s], step [m/s²], kink [m/s³]; shape (3,)."""
    error: float
    """Standard deviation of the jump, given all that is fitted with it, m/s."""
    explained: float
    """Squares that it alone explains, in variances of the noise."""
    place_error: float = np.inf
    """Standard deviation of the place, samples."""


class Noise(NamedTuple):
    """Standard deviations of what a fit does not know beforehand."""

    readings: float
    step: float
    """m/s²."""
    kink: float
    """m/s³."""


def add(residual: Array, model: ImpactModel, jump: Jump, factor: float) -> None:
    """Add a multiple of a jump to differences."""
    placed = model.placed(jump.place)
    _add_row(residual, placed.begin, factor * (jump.sizes @ placed.units))


def fit_group(
    residual: Array, model: ImpactModel, group: Sequence[Jump], noise: Noise
) -> tuple[list[Jump], float]:
    """Fit jumps jointly in the differences around them; return them with the remaining squares.

    Parameters
    ----------
    residual : ndarray
        Differences without all other jumps.
    """
    first, last = _around(model, [jump.place for jump in group])
    return fit_within(residual, model, group, (max(first, 0), min(last, residual.size)), noise)


def fit_within(
    residual: Array,
    model: ImpactModel,
    group: Sequence[Jump],
    within: tuple[int, int],
    noise: Noise,
    iterations: int = _ITERATIONS,
) -> tuple[list[Jump], float]:
    """Fit jumps as `fit_group` does, to the differences `within`; a single iteration moves none."""
    first, last = within
    seen = model.readings(residual[first:last])
    places = start = np.array([jump.place for jump in group])
    sizes = np.zeros((len(group), 3))
    for iteration in range(iterations):
        matrix = model.readings(_columns(model, places, sizes if iteration else None, first, last))
        fit = _least_squares(matrix, seen, _ridge(len(matrix), len(group), noise))
        each = fit.solution.reshape(len(group), -1)
        sizes = each[:, :3]
        if 0 < iteration < iterations - 1:
            moved = places + np.clip(each[:, 3], -_MAX_CHANGE, _MAX_CHANGE)
            places = np.where(abs(moved - start) < _MAX_DISTANCE, moved, places)
    error = noise.readings * fit.error.reshape(len(group), -1)
    fitted = [
        replace(
            jump,
            place=float(places[k]),
            sizes=sizes[k],
            error=float(error[k, 0]),
            place_error=float(error[k, 3]) if iterations > 1 else np.inf,
            explained=float((sizes[k, 0] / error[k, 0]) ** 2) if error[k, 0] else 0.0,
        )
        for k, jump in enumerate(group)
    ]
    return fitted, float(fit.remaining)


def with_errors(
    residual: Array, model: ImpactModel, jumps: Sequence[Jump], noise: Array, usual: tuple[float, float]
) -> list[Jump]:
    """Estimate the errors of jumps, each from the residual of its window if that exceeds the noise.

    Parameters
    ----------
    residual : ndarray
        Differences without any jump.
    noise : ndarray, shape (jumps,)
        Standard deviation of the readings at each.
    usual : tuple of float
        Standard deviations of steps and kinks.
    """
    if not jumps:
        return []
    whole, row, share = model.locate(np.array([jump.place for jump in jumps]))
    sizes = np.array([jump.sizes for jump in jumps])
    windows = np.lib.stride_tricks.sliding_window_view(residual, model.window)
    left = windows[np.clip(whole + model.window_start - model.difference, 0, len(windows) - 1)]
    change = model.templates[row + 1] - model.templates[row]
    units = model.templates[row] + share[:, None, None] * change
    seen = model.readings(left, model.order) + np.einsum("ji,jil->jl", sizes, units)
    ridge = np.zeros((len(jumps), 4))
    ridge[:, 1], ridge[:, 2] = noise / usual[0], noise / usual[1]
    known = _least_squares(units, seen, ridge[:, :3]).solution
    slopes = np.einsum("ji,jil->jl", known, change) * model.instants
    fit = _least_squares(np.concatenate([units, slopes[:, None]], axis=1), seen, ridge)
    degrees = model.window - model.order - 5
    error = (np.maximum(noise, np.sqrt(fit.remaining / degrees))[:, None]) * fit.error
    return [
        replace(jump, error=float(error[k, 0]), place_error=float(error[k, 3]))
        for k, jump in enumerate(jumps)
    ]


def jump_error(model: ImpactModel, distance: int | None, noise: Noise) -> float:
    """Return the standard deviation of a jump of 1 m/s, so many samples after an equal jump (None: alone), m/s."""
    matrix = model.equal_jumps.get(distance)
    if matrix is None:
        places = np.array([0.5] if distance is None else [0.5, 0.5 + distance])
        first, last = _around(model, places)
        sizes = np.tile([1.0, 0.0, 0.0], (places.size, 1))
        matrix = model.equal_jumps[distance] = model.readings(_columns(model, places, sizes, first, last))
    fit = _least_squares(matrix, matrix[0], _ridge(len(matrix), len(matrix) // 4, noise))
    return noise.readings * float(fit.error[-4])


class _Fit(NamedTuple):
    solution: Array
    error: Array
    """Standard deviations for noise of 1."""
    remaining: Array
    """Squares that remain, those of the priors included."""


def _least_squares(rows: Array, seen: Array, ridge: Array) -> _Fit:
    """Fit readings (..., length) by rows (..., unknowns, length), each with a prior of 1 / ridge times the noise."""
    scale = np.sqrt(np.sum(np.square(rows), axis=-1) + np.square(ridge))
    scale[scale == 0.0] = 1.0
    unit = rows / scale[..., None]
    normal = unit @ np.swapaxes(unit, -1, -2)
    diagonal = np.arange(normal.shape[-1])
    normal[..., diagonal, diagonal] += np.square(ridge / scale) + _ROUNDING
    inner = np.linalg.solve(normal, unit @ seen[..., None])
    remaining = np.sum(np.square(seen - (np.swapaxes(inner, -1, -2) @ unit)[..., 0, :]), axis=-1)
    solution = inner[..., 0] / scale
    error = np.linalg.norm(np.linalg.inv(np.linalg.cholesky(normal)), axis=-2) / scale
    return _Fit(solution, error, remaining + np.sum(np.square(ridge * solution), axis=-1))


def _columns(model: ImpactModel, places: Array, sizes: Array | None, first: int, last: int) -> Array:
    """Differences of jump, step and kink at each place, and with sizes their slope; shape (unknowns, differences)."""
    count = 3 if sizes is None else 4
    out = np.zeros((count * places.size, last - first))
    for k, place in enumerate(places):
        placed = model.placed(place)
        for row, unit in enumerate(placed.units):
            _add_row(out[count * k + row], placed.begin - first, unit)
        if sizes is not None:
            _add_row(out[count * k + 3], placed.begin - first, sizes[k] @ placed.slopes)
    return out


def _ridge(unknowns: int, jumps: int, noise: Noise) -> Array:
    prior = [0.0, noise.readings / noise.step, noise.readings / noise.kink, 0.0]
    return np.tile(prior[: unknowns // jumps], jumps)


def _around(model: ImpactModel, places: Sequence[float] | Array) -> tuple[int, int]:
    """First and one-past-last difference of the windows of jumps, whose instants may move."""
    first = int(min(places)) + model.window_start - model.difference + SHIFT
    last = int(max(places)) + model.window_start - model.difference + model.window - SHIFT
    return first, last


def _add_row(row: Array, begin: int, part: Array) -> None:
    low, high = max(0, -begin), min(part.size, row.size - begin)
    if high > low:
        row[begin + low : begin + high] += part[low:high]
