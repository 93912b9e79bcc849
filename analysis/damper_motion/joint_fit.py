"""Jumps that ring into each other, fitted together: least squares in the readings, instants included."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.jump_signature import SHIFT, Signature

Array = NDArray[np.float64]

# Rounds of Gauss and Newton, and the largest change of an instant in one, samples.
_ROUNDS, _STRIDE = 4, 0.5
_ROUNDING = 1e-11
# A jump that would leave its place by more than this, samples, stays: it would take its neighbour's.
_FARTHEST = 2.0


@dataclass(frozen=True, eq=False)
class Jump:
    """A jump, or a mere kink, as fitted."""

    place: float
    """Samples."""
    sizes: Array
    """Jump [m/s], step [m/s²], kink [m/s³]; shape (3,)."""
    error: float
    """Standard deviation of the jump, m/s, all else fitted beside it."""
    explains: float
    """Part of the squares that it alone explains, in variances of the noise."""
    adrift: float = np.inf
    """Standard deviation of the place, samples."""


def shape(of: Signature, place: float) -> tuple[int, Array, Array]:
    """Differences of unit jump, step and kink at a place, the place of the first, and their slopes per sample."""
    whole = int(np.floor(place))
    at = (place - whole) * of.instants - 0.5 + SHIFT * of.instants
    row = int(np.clip(np.floor(at), 0, len(of.shapes) - 2))
    left, right = of.shapes[row], of.shapes[row + 1]
    return (
        whole + of.shape_start - of.difference,
        left + (at - row) * (right - left),
        (right - left) * of.instants,
    )


def put(rest: Array, of: Signature, jump: Jump, share: float) -> None:
    """Add a share of a jump to differences."""
    begin, parts, _ = shape(of, jump.place)
    _lay(rest, begin, share * (jump.sizes @ parts))


def fit_together(
    rest: Array, of: Signature, group: list[Jump], noise: float, typical: tuple[float, float]
) -> tuple[list[Jump], float]:
    """Fit jumps anew, all at once; with the squares that are left.

    Parameters
    ----------
    rest : ndarray
        Differences with all other jumps taken out.
    noise : float
        Standard deviation of the readings.
    typical : tuple of float
        What steps [m/s²] and kinks [m/s³] are like: jumps near to each other hardly determine theirs.
    """
    first = int(min(one.place for one in group)) + of.window_start - of.difference + SHIFT
    last = int(max(one.place for one in group)) + of.window_start - of.difference + of.window - SHIFT
    return fit_within(rest, of, group, (max(first, 0), min(last, rest.size)), noise, typical)


def fit_within(
    rest: Array,
    of: Signature,
    group: list[Jump],
    within: tuple[int, int],
    noise: float,
    typical: tuple[float, float],
    rounds: int = _ROUNDS,
) -> tuple[list[Jump], float]:
    """Fit jumps as `fit_together` does, to the differences from one to before another; where they are in one round."""
    first, last = within
    smooth = _smooth(last - first, of.background(last - first))
    seen = _readings(rest[None, first:last], of.difference, smooth)[0]
    ridge = np.tile([0.0, noise / typical[0], noise / typical[1], 0.0], len(group))
    places, sizes = np.array([one.place for one in group]), np.zeros((len(group), 3))
    for turn in range(rounds):
        columns = np.zeros((4 * len(group), last - first))
        for k, place in enumerate(places):
            begin, parts, slopes = shape(of, place)
            for row, part in enumerate(parts):
                _lay(columns[4 * k + row], begin - first, part)
            if turn:
                _lay(columns[4 * k + 3], begin - first, sizes[k] @ slopes)
        matrix = _readings(columns, of.difference, smooth).T
        scale = np.sqrt(np.sum(matrix**2, axis=0) + ridge**2)
        scale[scale == 0.0] = 1.0
        matrix /= scale
        # Columns of unit length, so that what rounding leaves of the least of them is known.
        normal = matrix.T @ matrix + np.diag((ridge / scale) ** 2 + _ROUNDING)
        solution = np.linalg.solve(normal, matrix.T @ seen) / scale
        sizes = solution.reshape(-1, 4)[:, :3]
        if turn and turn < rounds - 1:
            moved = places + np.clip(solution[3::4], -_STRIDE, _STRIDE)
            places = np.where(abs(moved - [one.place for one in group]) < _FARTHEST, moved, places)
    error = noise * np.linalg.norm(np.linalg.inv(np.linalg.cholesky(normal)), axis=0) / scale
    left = float(np.sum((seen - matrix @ (solution * scale)) ** 2) + np.sum((ridge * solution) ** 2))
    fitted = [
        replace(
            one,
            place=float(places[k]),
            sizes=sizes[k],
            error=float(error[4 * k]),
            adrift=float(error[4 * k + 3]) if rounds > 1 else np.inf,
            explains=float((sizes[k, 0] / error[4 * k]) ** 2) if error[4 * k] else 0.0,
        )
        for k, one in enumerate(group)
    ]
    return fitted, left


def with_errors(rest: Array, of: Signature, one: Jump, noise: float, typical: tuple[float, float]) -> Jump:
    """Estimate the errors of a jump from the residual around it, if that exceeds the noise.

    Parameters
    ----------
    rest : ndarray
        Differences with all jumps taken out.
    noise, typical
        As for `fit_together`.
    """
    first = max(int(np.floor(one.place)) + of.window_start - of.difference, 0)
    last = min(first + of.window, rest.size)
    put(rest, of, one, 1.0)
    [known], left = fit_within(rest, of, [one], (first, last), noise, typical, rounds=2)
    put(rest, of, one, -1.0)
    more = max(1.0, (left / (last - first - of.curvature - 5)) ** 0.5 / noise)
    return replace(one, error=more * known.error, adrift=more * known.adrift)


def error_beside(of: Signature, apart: int | None, noise: float, typical: tuple[float, float]) -> float:
    """Return the standard deviation of a jump so many samples after an equal one; None: of a single jump, m/s.

    Parameters
    ----------
    noise : float
        Standard deviation of the readings.
    typical : tuple of float
        As for `fit_together`.
    """
    rest = np.zeros(2 * of.ring + 2 * of.window + (apart or 0))
    first = Jump(of.ring + 0.5, np.array([1.0, 0.0, 0.0]), noise, 0.0)
    group = [first] if apart is None else [first, replace(first, place=first.place + apart)]
    for one in group:
        put(rest, of, one, 1.0)
    return fit_together(rest, of, group, noise, typical)[0][-1].error


def readings(windows: Array, of: Signature, length: int) -> Array:
    """Sum windows of so many differences up to readings and take off what is smooth; shape (windows, length)."""
    return _readings(windows, of.difference, _smooth(length, of.background(length)))


def _lay(row: Array, begin: int, part: Array) -> None:
    low, high = max(0, -begin), min(part.size, row.size - begin)
    if high > low:
        row[begin + low : begin + high] += part[low:high]


def _readings(differences: Array, order: int, smooth: Array) -> Array:
    """Sum differences up to readings and take off what is smooth; shape (rows, differences)."""
    for _ in range(order):
        differences = np.cumsum(differences, axis=-1)
    # Twice: once leaves rounding of the polynomials, which are much larger than what is looked for.
    for _ in range(2):
        differences = differences - (differences @ smooth) @ smooth.T
    return differences


@lru_cache(maxsize=256)
def _smooth(length: int, degree: int) -> Array:
    basis = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, length), degree)
    return np.asarray(np.linalg.qr(basis)[0], dtype=np.float64)
