"""Steps of the gain or the delay of a channel during a sweep, from the response curves.

Near each frequency, a response is a rational function [1]_. The function is fitted to the points before and after an
instant of the sweep. The fit is repeated with one more unknown: the ratio of the gains after and before, or the change
of the delay. A step is reported if it explains nearly all of the residual, and the other curves have no step at this
frequency. A change of the motion to another branch changes all curves, and their phases; a single curve of a nonlinear
structure is not checked, because a fault is distinguished from such a change by the other curves.

References
----------
.. [1] C. K. Sanathanan, J. Koerner, Transfer function synthesis as a ratio of two complex polynomials, IEEE
   Transactions on Automatic Control 8 (1963) 56-58.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.responses.checks.channel_changes import MAX_COMMON, MIN_CHANGE, describe_change, describe_delay
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results import format_number
from rig.core.results.response import Response

# Number of points on either side of a step: more points would reach into the next resonance.
_POINTS_PER_SIDE = 8
# Degree of the polynomials on both sides.
_DEGREE = 3
# Number of iterations of the weighted linear fit.
_ITERATIONS = 3
# Number of omitted lines on either side of a possible step if neighboring lines have common errors.
_BLURRED_SIDE = 5
# If neighboring lines have common errors, the gain ratio of a step at a resonance cannot be fitted. A channel then has
# a step if its relative residual exceeds this limit, ...
_MIN_BLURRED_RESIDUAL = 0.03
# ... the residuals of the other channels are below this fraction of its residual, ...
_MAX_OTHER_RESIDUAL = 0.2
# ... and the relative standard uncertainty of its points, as at an antiresonance, is below this fraction.
_MAX_NOISE_RATIO = 0.2
# A step is sought where the relative residual of a fit with equal gains has an rms above this limit.
_MIN_RESIDUAL = 0.01
# A fit with a gain ratio must reduce the rms residual to at most this fraction of the residual with equal gains, ...
_MAX_REMAINING_FRACTION = 0.2
# ... and below this limit.
_MAX_REMAINING = 0.1
# Smallest reported magnitude of the logarithm of the ratio for nonlinear structures, about 30 %, instead of
# `MIN_CHANGE`: curves with moving dampers are not rational. Of 32 intact sweeps, three had ratios up to 0.21.
_MIN_NONLINEAR_CHANGE = 0.3
# Logarithms of the trial ratios: changes of the gain, and changes of the phase at the step due to delays.
_TRIALS: tuple[Array, ComplexArray] = (
    np.linspace(-5.0, 5.0, 101),
    np.asarray(1j * np.pi * np.linspace(-1.0, 1.0, 101), dtype=np.complex128),
)
# Number of positions that are fitted together: their matrices take 7 MB.
_BATCH = 32
# Factors by which their spacing is reduced around the best ratio.
_REFINEMENTS = (0.02, 0.004, 0.0008)


class _Step(NamedTuple):
    """Change of the gain or the delay of a curve around a position of the sweep."""

    position: int
    # logarithm of the gain after the step over that before it; imaginary: phase at the position due to a delay
    log_ratio: complex
    residual: float  # relative residual with equal gains
    remaining: float  # relative residual with this ratio


def step_warnings(response: Response, is_linear: bool) -> list[str]:
    """Return a warning for each channel whose gain or delay changes during a sweep.

    `response`: lines in the order of measurement. If not `is_linear`, all curves may change by the same ratio without a
    fault of the reference.
    """
    stride = max(round(response.uncertainty.shared), 1)
    excluded = _BLURRED_SIDE if stride > 1 else 0
    frequency, curves = response.frequency[::stride], response.value[::stride, :, 0].T
    valid = (np.isfinite(curves) & (abs(curves) > 0.0)).all(axis=0)
    frequency, curves = frequency[valid], curves[:, valid]
    noise = response.error[::stride, :, 0].T[:, valid] / abs(curves)
    positions = np.arange(_POINTS_PER_SIDE + excluded, frequency.size - _POINTS_PER_SIDE - excluded)
    if not positions.size or (len(curves) == 1 and not is_linear):
        return []
    min_change = MIN_CHANGE if is_linear else _MIN_NONLINEAR_CHANGE
    residuals = np.array([_residuals(frequency, curve, positions, excluded, 0.0) for curve in curves])
    steps = [_best_step(frequency, *curve, positions, excluded) for curve in zip(curves, residuals, strict=True)]
    names, reference, warnings = [point.name for point in response.outputs], response.inputs[0].name, []
    for k, (name, step) in enumerate(zip(names, steps, strict=True)):
        if step is None or abs(step.log_ratio) < min_change:
            others = np.delete(residuals, k, axis=0).max(axis=0, initial=0.0)
            largest = int(np.argmax(residuals[k] - others))
            # Lines of unknown uncertainty are assumed to have that of the other lines.
            noise_there = noise[k, _points(positions[largest], excluded)]
            known = noise_there[np.isfinite(noise_there)]
            noise_ratio = np.sqrt(np.mean(known**2)) if known.size else np.inf
            limit = max(_MIN_BLURRED_RESIDUAL, others[largest] / _MAX_OTHER_RESIDUAL, noise_ratio / _MAX_NOISE_RATIO)
            if is_linear and excluded and len(names) > 1 and residuals[k, largest] > limit:
                warnings.append(describe_step(name, complex(np.nan), frequency[positions[largest]]))
            continue
        trials = _TRIALS[1] if step.log_ratio.imag else _TRIALS[0]
        others = [
            _fit_ratios(frequency, curve, np.array([step.position]), excluded, trials)[0].item()
            for curve in np.delete(curves, k, axis=0)
        ]
        if all(abs(other) < MAX_COMMON * abs(step.log_ratio) for other in others):
            warnings.append(describe_step(name, step.log_ratio, frequency[step.position], "" if others else reference))
        elif is_linear and all(abs(other - step.log_ratio) < MAX_COMMON * abs(step.log_ratio) for other in others):
            warnings.append(describe_step(reference, -step.log_ratio, frequency[step.position]))
            break
    return warnings


def describe_step(name: str, log_ratio: complex, frequency: float, reference: str = "", time: str = "") -> str:
    """Describe a step of a channel: `log_ratio` is ln(gain after / gain before), imaginary for a change of the delay.

    `frequency`: Hz; `reference`: the other channel that may be the cause; `time`: text after the frequency.
    """
    place = f"{format_number(float(f'{frequency:.3g}'))} Hz{time}"
    if log_ratio.imag:
        delay = -log_ratio.imag / (2.0 * np.pi * frequency)
        return describe_delay(name, delay, place, reference, period=1.0 / frequency)
    blamed = f"{name} or {reference}" if reference else name
    return describe_change(blamed, float(np.exp(log_ratio.real)), place)


def _best_step(
    frequency: Array, curve: ComplexArray, residuals: Array, positions: NDArray[np.int64], excluded: int
) -> _Step | None:
    """Return the step with the smallest remaining residual; None if the residual remains too large."""
    candidates = np.flatnonzero(residuals > _MIN_RESIDUAL)
    steps = []
    for rows in (candidates[first : first + _BATCH] for first in range(0, candidates.size, _BATCH)):
        for trials in _TRIALS:
            log_ratio, remaining = _fit_ratios(frequency, curve, positions[rows], excluded, trials)
            best = int(np.argmin(remaining))
            row = rows[best]
            steps.append(
                _Step(int(positions[row]), log_ratio[best].item(), float(residuals[row]), float(remaining[best]))
            )
    step = min(steps, key=lambda step: step.remaining, default=None)
    is_significant = step and step.remaining < min(_MAX_REMAINING_FRACTION * step.residual, _MAX_REMAINING)
    return step if is_significant else None


def _fit_ratios(
    frequency: Array, curve: ComplexArray, positions: NDArray[np.int64], excluded: int, trials: Array | ComplexArray
) -> tuple[Array | ComplexArray, Array]:
    """Fit the ratio of the gains after and before each position of the sweep, or the change of the delay.

    Returns the logarithms of the ratios, and the remaining residuals.
    """
    unit, rows = 1j if np.iscomplexobj(trials) else 1.0, np.arange(positions.size)
    log_ratios: Any = np.tile(trials, (positions.size, 1))  # real or complex
    for spacing in (*_REFINEMENTS, 0.0):
        repeated = np.repeat(positions, log_ratios.shape[1])
        remaining = _residuals(frequency, curve, repeated, excluded, log_ratios).reshape(log_ratios.shape)
        best = np.argmin(remaining, axis=1)
        log_ratio, smallest = log_ratios[rows, best], remaining[rows, best]
        log_ratios = log_ratio[:, None] + spacing * unit * np.arange(-5, 6)
    return log_ratio, smallest


def _points(position: NDArray[np.int64], excluded: int) -> NDArray[np.int64]:
    """Return the points on both sides of a position to which a function is fitted."""
    offsets = np.arange(excluded + 1, excluded + 1 + _POINTS_PER_SIDE)
    return np.asarray(position + np.concatenate([-offsets[::-1], offsets]))


def _residuals(
    frequency: Array,
    curve: ComplexArray,
    positions: NDArray[np.int64],
    excluded: int,
    log_ratio: float | Array | ComplexArray,
) -> Array:
    """Return the relative residual of a rational function around each position, for a ratio of the gains."""
    # The points at a position, and `excluded` points on either side of it, are omitted: they may contain the step.
    points = np.clip(_points(positions[:, None], excluded), 0, frequency.size - 1)
    f = frequency[points]
    # The phase of a delay is proportional to frequency.
    ratios = np.reshape(log_ratio, (-1, 1))
    ratios = ratios.real + 1j * ratios.imag * f / frequency[positions][:, None]
    values = curve[points] / np.exp(np.where(np.arange(2 * _POINTS_PER_SIDE) < _POINTS_PER_SIDE, 0.0, ratios))
    centered = f - f.mean(axis=1, keepdims=True)
    powers = (centered / abs(centered).max(axis=1, keepdims=True)) ** np.arange(_DEGREE + 1)[:, None, None]
    # Unknowns are the coefficients of numerator and denominator (constant term 1); residuals are relative.
    relative = 1.0 / abs(values)
    right = values * relative
    terms = np.asarray(np.concatenate([powers * relative, -right * powers[1:], right[None]]), dtype=np.complex128)
    weight = np.ones(values.shape)
    for _ in range(_ITERATIONS):
        columns: ComplexArray = terms * weight
        triangle = _orthogonalize(columns)[-_DEGREE:]
        # Back substitution of the coefficients of the denominator.
        coefficients = np.zeros((0, len(values)), dtype=np.complex128)
        for length, *products, right_product in reversed(triangle):
            known = np.sum(np.array(products).reshape(coefficients.shape) * coefficients, axis=0)
            coefficients = np.concatenate([[(right_product - known) / length], coefficients])
        denominator = 1.0 + np.sum(coefficients[:, :, None] * powers[1:], axis=0)
        size = abs(denominator)
        residual = columns[-1] / (weight * denominator)
        weight = 1.0 / np.maximum(size, 1e-3 * size.max(axis=1, keepdims=True))
    return np.asarray(np.sqrt(np.mean(abs(residual) ** 2, axis=1)))


def _orthogonalize(columns: ComplexArray) -> list[ComplexArray]:
    """Orthogonalize columns by the modified Gram-Schmidt method; all but the last get the length 1.

    `columns`: shape (columns, systems, rows). numpy's QR decomposition of many small systems takes twice as long.
    Returns the rows of the triangular matrix, each of the shape (columns from the diagonal on, systems).
    """
    triangle = []
    largest = np.linalg.norm(columns[:-1], axis=2).max(axis=0)
    for k in range(len(columns) - 1):
        # The added term keeps functions of a lower degree solvable.
        length = np.linalg.norm(columns[k], axis=1) + 1e-13 * largest
        columns[k] /= length[:, None]
        products = np.einsum("sr,csr->cs", columns[k].conj(), columns[k + 1 :])
        columns[k + 1 :] -= products[:, :, None] * columns[k]
        triangle.append(np.concatenate([length[None], products]))
    return triangle
