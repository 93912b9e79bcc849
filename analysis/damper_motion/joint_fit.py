"""Joint least-squares fit of velocity jumps whose readings overlap; their times are refined by Gauss-Newton steps.

Steps and kinks of the acceleration have Gaussian priors (ridge regression), because closely spaced jumps hardly
determine them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from analysis.damper_motion.impact_model import MAX_SHIFT, ImpactModel
from rig.arrays import Array

# Number of Gauss-Newton iterations.
ITERATIONS = 4
# Maximum change of a time in one iteration.
_MAX_CHANGE_SAMPLES = 0.5
# Added to the diagonal of the normalized normal equations, so that they stay positive definite despite rounding.
_DIAGONAL_LOADING = 1e-11
# Maximum distance of a fitted jump from its start, samples: a larger one would merge it with a neighbor.
_MAX_DISTANCE_SAMPLES = 2.0


@dataclass(frozen=True, eq=False)
class Jump:
    """Fitted velocity jump with the step and kink of the acceleration at the same time."""

    time: float
    """Time of the jump, in samples."""
    sizes: Array
    """Jump [m/s], step [m/s²], kink [m/s³]; shape (3,)."""
    error: float
    """Standard deviation of the jump, including its covariance with the jointly fitted quantities, m/s."""
    explained: float
    """Reduction of the sum of squares by this jump, in units of the noise variance."""
    time_error: float = np.inf
    """Standard deviation of `time`, samples."""


class Deviations(NamedTuple):
    """Standard deviations of the noise of a reading, and of the Gaussian priors of steps and kinks."""

    reading: float
    step: float
    """m/s²."""
    kink: float
    """m/s³."""


def add_jump(residual: Array, model: ImpactModel, jump: Jump, factor: float) -> None:
    """Add a multiple of a jump to the differenced readings."""
    placed = model.placed(jump.time)
    _add_row(residual, placed.begin, factor * (jump.sizes @ placed.units))


def fit_group(
    residual: Array, model: ImpactModel, group: Sequence[Jump], noise: Deviations
) -> tuple[list[Jump], float]:
    """Fit jumps jointly to the differenced readings around them; return them with the residual sum of squares.

    `residual`: differenced readings, with all other jumps subtracted.
    """
    first, last = _difference_range(model, [jump.time for jump in group])
    return fit_within(residual, model, group, (max(first, 0), min(last, residual.size)), noise)


def fit_within(
    residual: Array,
    model: ImpactModel,
    group: Sequence[Jump],
    difference_range: tuple[int, int],
    noise: Deviations,
    iterations: int = ITERATIONS,
) -> tuple[list[Jump], float]:
    """Fit jumps as `fit_group` does, to a range of differences; a single iteration keeps their times fixed."""
    first, last = difference_range
    readings = model.readings(residual[first:last])
    times = start = np.array([jump.time for jump in group])
    sizes = np.zeros((len(group), 3))
    for iteration in range(iterations):
        matrix = model.readings(_columns(model, times, sizes if iteration else None, first, last))
        fit = _least_squares(matrix, readings, _ridge(len(matrix), len(group), noise))
        solution = fit.solution.reshape(len(group), -1)
        sizes = solution[:, :3]
        if 0 < iteration < iterations - 1:
            changed = times + np.clip(solution[:, 3], -_MAX_CHANGE_SAMPLES, _MAX_CHANGE_SAMPLES)
            times = np.where(abs(changed - start) < _MAX_DISTANCE_SAMPLES, changed, times)
    error = noise.reading * fit.error.reshape(len(group), -1)
    fitted = []
    for k, time in enumerate(times):
        time_error = float(error[k, 3]) if iterations > 1 else np.inf
        explained = float((sizes[k, 0] / error[k, 0]) ** 2) if error[k, 0] else 0.0
        fitted.append(Jump(float(time), sizes[k], float(error[k, 0]), explained, time_error))
    return fitted, float(fit.remaining)


def estimate_errors(
    residual: Array, model: ImpactModel, jumps: Sequence[Jump], noise: Array, prior: tuple[float, float]
) -> list[Jump]:
    """Estimate the standard deviations of jumps from the noise, or from the residual if that is larger.

    `residual`: differenced readings, with all jumps subtracted; `noise`, shape (jumps,): standard deviation of the
    readings at each jump; `prior`: prior standard deviations of steps and kinks.
    """
    if not jumps:
        return []
    sample, row, weight = model.locate(np.array([jump.time for jump in jumps]))
    sizes = np.array([jump.sizes for jump in jumps])
    windows = np.lib.stride_tricks.sliding_window_view(residual, model.window)
    residual_windows = windows[np.clip(sample + model.window_start - model.difference, 0, len(windows) - 1)]
    change = model.templates[row + 1] - model.templates[row]
    units = model.templates[row] + weight[:, None, None] * change
    readings = model.readings(residual_windows, model.order) + np.einsum("ji,jil->jl", sizes, units)
    ridge = np.zeros((len(jumps), 4))
    ridge[:, 1], ridge[:, 2] = noise / prior[0], noise / prior[1]
    first_estimate = _least_squares(units, readings, ridge[:, :3]).solution
    slopes = np.einsum("ji,jil->jl", first_estimate, change) * model.instants
    fit = _least_squares(np.concatenate([units, slopes[:, None]], axis=1), readings, ridge)
    degrees = model.window - model.order - 5
    error = (np.maximum(noise, np.sqrt(fit.remaining / degrees))[:, None]) * fit.error
    return [replace(jump, error=float(error[k, 0]), time_error=float(error[k, 3])) for k, jump in enumerate(jumps)]


def jump_error(model: ImpactModel, distance: int | None, noise: Deviations) -> float:
    """Return the standard deviation of a 1 m/s jump `distance` samples after an equal jump (None: isolated), m/s."""
    matrix = _equal_jumps(model, distance)
    fit = _least_squares(matrix, matrix[0], _ridge(len(matrix), len(matrix) // 4, noise))
    return noise.reading * float(fit.error[-4])


@lru_cache(maxsize=1024)
def _equal_jumps(model: ImpactModel, distance: int | None) -> Array:
    """Compute the readings of one jump of 1 m/s, or of two."""
    times = np.array([0.5] if distance is None else [0.5, 0.5 + distance])
    sizes = np.tile([1.0, 0.0, 0.0], (times.size, 1))
    return model.readings(_columns(model, times, sizes, *_difference_range(model, times)))


class _Fit(NamedTuple):
    solution: Array
    error: Array
    """Standard deviations for a noise standard deviation of 1."""
    remaining: Array
    """Residual sum of squares, including the prior terms."""


def _least_squares(rows: Array, readings: Array, ridge: Array) -> _Fit:
    """Fit readings (..., length) by rows (..., unknowns, length) with prior standard deviations of noise / ridge."""
    scale = np.sqrt(np.sum(np.square(rows), axis=-1) + np.square(ridge))
    scale[scale == 0.0] = 1.0
    unit = rows / scale[..., None]
    normal = unit @ np.swapaxes(unit, -1, -2)
    diagonal = np.arange(normal.shape[-1])
    normal[..., diagonal, diagonal] += np.square(ridge / scale) + _DIAGONAL_LOADING
    inner = np.linalg.solve(normal, unit @ readings[..., None])
    remaining = np.sum(np.square(readings - (np.swapaxes(inner, -1, -2) @ unit)[..., 0, :]), axis=-1)
    solution = inner[..., 0] / scale
    error = np.linalg.norm(np.linalg.inv(np.linalg.cholesky(normal)), axis=-2) / scale
    return _Fit(solution, error, remaining + np.sum(np.square(ridge * solution), axis=-1))


def _columns(model: ImpactModel, times: Array, sizes: Array | None, first: int, last: int) -> Array:
    """Return the differenced jump, step and kink at each time, and their time derivative: (unknowns, differences)."""
    count = 3 if sizes is None else 4
    out = np.zeros((count * times.size, last - first))
    for k, time in enumerate(times):
        placed = model.placed(time)
        for row, unit in enumerate(placed.units):
            _add_row(out[count * k + row], placed.begin - first, unit)
        if sizes is not None:
            _add_row(out[count * k + 3], placed.begin - first, sizes[k] @ placed.slopes)
    return out


def _ridge(unknowns: int, jumps: int, noise: Deviations) -> Array:
    prior = [0.0, noise.reading / noise.step, noise.reading / noise.kink, 0.0]
    return np.tile(prior[: unknowns // jumps], jumps)


def _difference_range(model: ImpactModel, times: Sequence[float] | Array) -> tuple[int, int]:
    """Return first and one-past-last difference of the windows of jumps, with a margin for changes of their times."""
    first = int(min(times)) + model.window_start - model.difference + MAX_SHIFT
    last = int(max(times)) + model.window_start - model.difference + model.window - MAX_SHIFT
    return first, last


def _add_row(row: Array, begin: int, part: Array) -> None:
    low, high = max(0, -begin), min(part.size, row.size - begin)
    if high > low:
        row[begin + low : begin + high] += part[low:high]
