"""Joint least-squares fit of velocity jumps whose responses overlap; their times are refined by Gauss-Newton steps.

The data are the differenced readings of a channel (see `impact_model`). Steps and slope changes of the acceleration
have Gaussian priors (ridge regression), because closely spaced jumps determine them poorly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from analysis.core.damper_motion.impact_model import MAX_SHIFT, ImpactModel
from rig.core.base.arrays import Array

# Number of Gauss-Newton iterations; few suffice, because the initial times are within two samples.
ITERATIONS = 4
# The time of a jump changes by at most this value in one iteration [samples].
_MAX_CHANGE_SAMPLES = 0.5
# Added to the diagonal of the normalized normal equations, which would otherwise be indefinite due to rounding.
_DIAGONAL_LOADING = 1e-11
# Maximum distance of a fitted jump from its initial time [samples]; beyond it, the jump could merge with a neighbor.
_MAX_DISTANCE_SAMPLES = 2.0


@dataclass(frozen=True, eq=False)
class Jump:
    """Fitted velocity jump with the step and slope change of the acceleration at the same time."""

    time: float
    """Time of the jump, in samples."""
    amplitudes: Array
    """Jump [m/s], step [m/s²], slope change [m/s³]; shape (3,)."""
    error: float
    """Standard uncertainty of the jump [m/s] including the uncertainty of the jointly fitted quantities."""
    explained: float
    """Reduction of the sum of squares by this jump, in units of the noise variance."""
    time_std: float = np.inf
    """Standard uncertainty of `time` [samples]."""

    @property
    def velocity_jump(self) -> float:
        """Jump of the velocity [m/s]."""
        return float(self.amplitudes[0])

    @property
    def step(self) -> float:
        """Step of the acceleration [m/s²]."""
        return float(self.amplitudes[1])

    @property
    def slope_change(self) -> float:
        """Change of the slope of the acceleration, m/s³."""
        return float(self.amplitudes[2])


class Deviations(NamedTuple):
    """Standard deviations: noise of a reading, and Gaussian priors of steps and slope changes."""

    reading: float
    step: float
    """m/s²."""
    slope_change: float
    """m/s³."""


def add_jump(residual: Array, model: ImpactModel, jump: Jump, factor: float) -> None:
    """Add a multiple of a jump to the differenced readings."""
    unit = model.unit_responses_at(jump.time)
    _add_row(residual, unit.begin, factor * (jump.amplitudes @ unit.responses))


def fit_group(
    residual: Array, model: ImpactModel, group: Sequence[Jump], noise: Deviations
) -> tuple[list[Jump], float]:
    """Fit jumps jointly to `residual`, the readings minus all other jumps; return them and the sum of squares."""
    return fit_within(residual, model, group, range_of(group, model, residual.size), noise)


def range_of(group: Sequence[Jump], model: ImpactModel, n_differences: int) -> tuple[int, int]:
    """Return the range (first, stop) of the differences in the windows of jumps, in a segment of `n_differences`."""
    first, last = _difference_range(model, [jump.time for jump in group])
    return max(first, 0), min(last, n_differences)


def fit_within(
    residual: Array,
    model: ImpactModel,
    group: Sequence[Jump],
    difference_range: tuple[int, int],
    noise: Deviations,
    iterations: int = ITERATIONS,
) -> tuple[list[Jump], float]:
    """Fit jumps to a range of differences by the method of `fit_group`; a single iteration keeps their times fixed."""
    first, last = difference_range
    readings = model.readings(residual[first:last])
    times = initial_times = np.array([jump.time for jump in group])
    amplitudes = np.zeros((len(group), 3))
    for iteration in range(iterations):
        # The first iteration has no amplitudes from which time derivatives could be computed.
        rows = model.readings(_regressors(model, times, amplitudes if iteration else None, first, last))
        fit = _least_squares(rows, readings, _ridge(len(rows), len(group), noise))
        solution = fit.solution.reshape(len(group), -1)
        amplitudes = solution[:, :3]
        if 0 < iteration < iterations - 1:
            new_times = times + np.clip(solution[:, 3], -_MAX_CHANGE_SAMPLES, _MAX_CHANGE_SAMPLES)
            times = np.where(abs(new_times - initial_times) < _MAX_DISTANCE_SAMPLES, new_times, times)
    error = noise.reading * fit.error.reshape(len(group), -1)
    fitted = []
    for k, time in enumerate(times):
        time_std = float(error[k, 3]) if iterations > 1 else np.inf
        explained = float((amplitudes[k, 0] / error[k, 0]) ** 2) if error[k, 0] else 0.0
        fitted.append(Jump(float(time), amplitudes[k], float(error[k, 0]), explained, time_std))
    return fitted, float(fit.residual_square)


def estimate_errors(
    residual: Array, model: ImpactModel, jumps: Sequence[Jump], noise: Array, prior: tuple[float, float]
) -> list[Jump]:
    """Estimate the standard uncertainties of jumps from the noise, or from the residual if this is larger.

    `residual`: differenced readings, from which all jumps are subtracted; `noise`, shape (jumps,): standard deviation
    of the readings at each jump; `prior`: prior standard deviations of steps and slope changes.
    """
    if not jumps:
        return []
    sample, row, weight = model.locate(np.array([jump.time for jump in jumps]))
    amplitudes = np.array([jump.amplitudes for jump in jumps])
    windows = np.lib.stride_tricks.sliding_window_view(residual, model.window_length)
    residual_windows = windows[np.clip(sample + model.window_start - model.difference_order, 0, len(windows) - 1)]
    responses = model.responses_in_window(row)
    change = model.responses_in_window(row + 1) - responses
    responses = responses + weight[:, None, None] * change
    readings = model.readings(residual_windows, model.polynomial_order) + np.einsum("ji,jil->jl", amplitudes, responses)
    ridge = np.zeros((len(jumps), 4))
    ridge[:, 1], ridge[:, 2] = noise / prior[0], noise / prior[1]
    first_estimate = _least_squares(responses, readings, ridge[:, :3]).solution
    time_derivatives = np.einsum("ji,jil->jl", first_estimate, change) * model.instants_per_sample
    fit = _least_squares(np.concatenate([responses, time_derivatives[:, None]], axis=1), readings, ridge)
    # The polynomial has `polynomial_order` + 1 coefficients, the jump four unknowns.
    degrees_of_freedom = model.window_length - model.polynomial_order - 5
    error = (np.maximum(noise, np.sqrt(fit.residual_square / degrees_of_freedom))[:, None]) * fit.error
    return [replace(jump, error=float(error[k, 0]), time_std=float(error[k, 3])) for k, jump in enumerate(jumps)]


def jump_std(model: ImpactModel, distance: int | None, noise: Deviations) -> float:
    """Return the standard uncertainty of a jump `distance` samples after an equal jump (None: a single jump) [m/s]."""
    rows = _equal_jumps(model, distance)
    fit = _least_squares(rows, rows[0], _ridge(len(rows), len(rows) // 4, noise))
    # The last four unknowns are jump, step, slope change and time of the last jump.
    return noise.reading * float(fit.error[-4])


@lru_cache(maxsize=1024)
def _equal_jumps(model: ImpactModel, distance: int | None) -> Array:
    """Compute the regressors of one jump of 1 m/s, or of two at a distance in samples."""
    times = np.array([0.5] if distance is None else [0.5, 0.5 + distance])
    amplitudes = np.tile([1.0, 0.0, 0.0], (times.size, 1))
    return model.readings(_regressors(model, times, amplitudes, *_difference_range(model, times)))


class _Fit(NamedTuple):
    """Ridge regression."""

    solution: Array
    """Unknowns; shape (..., unknowns)."""
    error: Array
    """Standard deviations of `solution` for a noise standard deviation of 1; shape (..., unknowns)."""
    residual_square: Array
    """Residual sum of squares, including the prior terms; shape (...)."""


def _least_squares(rows: Array, readings: Array, ridge: Array) -> _Fit:
    """Fit readings (..., length) by rows (..., unknowns, length) with prior standard deviations of noise / ridge."""
    scale = np.sqrt(np.sum(np.square(rows), axis=-1) + np.square(ridge))
    scale[scale == 0.0] = 1.0
    unit_rows = rows / scale[..., None]
    normal_matrix = unit_rows @ np.swapaxes(unit_rows, -1, -2)
    diagonal = np.arange(normal_matrix.shape[-1])
    normal_matrix[..., diagonal, diagonal] += np.square(ridge / scale) + _DIAGONAL_LOADING
    scaled_solution = np.linalg.solve(normal_matrix, unit_rows @ readings[..., None])
    residual = readings - (np.swapaxes(scaled_solution, -1, -2) @ unit_rows)[..., 0, :]
    solution = scaled_solution[..., 0] / scale
    error = np.linalg.norm(np.linalg.inv(np.linalg.cholesky(normal_matrix)), axis=-2) / scale
    residual_square = np.sum(np.square(residual), axis=-1) + np.sum(np.square(ridge * solution), axis=-1)
    return _Fit(solution, error, residual_square)


def _regressors(model: ImpactModel, times: Array, amplitudes: Array | None, first: int, last: int) -> Array:
    """Return differences `first` to `last` of unit jump, step, slope change at each time, (unknowns, last - first)."""
    # With `amplitudes`, the time derivative of each jump follows.
    per_jump = 3 if amplitudes is None else 4
    regressors = np.zeros((per_jump * times.size, last - first))
    for k, time in enumerate(times):
        unit = model.unit_responses_at(time)
        for row, response in enumerate(unit.responses):
            _add_row(regressors[per_jump * k + row], unit.begin - first, response)
        if amplitudes is not None:
            _add_row(regressors[per_jump * k + 3], unit.begin - first, amplitudes[k] @ unit.time_derivatives)
    return regressors


def _ridge(unknowns: int, jumps: int, noise: Deviations) -> Array:
    """Return the ridge parameters of `_least_squares`: zero for jumps and times, which have no prior."""
    ridge_of_jump = [0.0, noise.reading / noise.step, noise.reading / noise.slope_change, 0.0]
    return np.tile(ridge_of_jump[: unknowns // jumps], jumps)


def _difference_range(model: ImpactModel, times: Sequence[float] | Array) -> tuple[int, int]:
    """Return first and one-past-last difference of the windows of jumps, with a margin for changes of their times."""
    first = int(min(times)) + model.window_start - model.difference_order + MAX_SHIFT
    last = int(max(times)) + model.window_start - model.difference_order + model.window_length - MAX_SHIFT
    return first, last


def _add_row(row: Array, begin: int, addend: Array) -> None:
    """Add values to a row from index `begin` on; values outside the row are ignored."""
    low, high = max(0, -begin), min(addend.size, row.size - begin)
    if high > low:
        row[begin + low : begin + high] += addend[low:high]
