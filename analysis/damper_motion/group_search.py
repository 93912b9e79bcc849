"""Beam search for jumps that are too closely spaced for matching pursuit.

Matching pursuit can subtract a jump at a wrong time. The residual then resembles further jumps, and later fits cannot
correct this. The beam search keeps the few best sets of each size until one set explains the segment. The number of
jumps is chosen by a penalty for each jump (information criterion: G. Schwarz, Ann. Stat. 6 (1978) 461).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from analysis.damper_motion.joint_fit import ITERATIONS, Jump

# Number of sets that are kept at each number of jumps.
_BEAM_WIDTH = 3
# Number of times that are tried for the next jump.
_TIMES_TRIED = 4
# Maximum number of jumps in a set.
MAX_GROUP = 8
# An additional jump must reduce the residual sum of squares by this factor.
_MIN_REDUCTION = 5.0
# Spacing of the times that are tried.
_TIME_STEP_SAMPLES = 2.0


def search_group(
    fit: Callable[[list[Jump], int], tuple[list[Jump], float]],
    times: tuple[float, float],
    min_distance: float,
    sufficient: float,
) -> tuple[list[Jump], float]:
    """Search for the jumps that best explain a segment; return them with the residual sum of squares.

    `fit`: joint fit of jumps to the segment with a number of iterations (1: fixed times); `times`: limits of the
    times of the jumps, samples; `min_distance`: minimum distance between two jumps, samples; `sufficient`: residual
    sum of squares at which the search ends.
    """
    best_sets: list[tuple[list[Jump], float]] = []
    sets: list[list[Jump]] = [[]]
    for _ in range(MAX_GROUP):
        larger = []
        for jumps_of_set in sets:
            # The times at which one more jump reduces the residual most, from fits with fixed times.
            candidates = [
                [*jumps_of_set, Jump(float(time), np.zeros(3), 1.0, 0.0)]
                for time in np.arange(*times, _TIME_STEP_SAMPLES)
                if all(abs(time - jump.time) >= min_distance for jump in jumps_of_set)
            ]
            residual_squares = [fit(jumps, 1)[1] for jumps in candidates]
            order = np.argsort(residual_squares, kind="stable")[:_TIMES_TRIED]
            larger += [fit(candidates[k], ITERATIONS) for k in order]
        larger.sort(key=lambda candidate: candidate[1])
        distinct: list[tuple[list[Jump], float]] = []
        for candidate in larger:
            if not any(_same_times(candidate[0], other[0]) for other in distinct):
                distinct.append(candidate)
        best_sets, sets = best_sets + distinct[:1], [jumps for jumps, _ in distinct[:_BEAM_WIDTH]]
        if not distinct or distinct[0][1] < sufficient:
            break
    return min(best_sets, key=lambda candidate: cost(*candidate), default=([], np.inf))


def cost(jumps: list[Jump], residual_square: float) -> float:
    """Return the logarithm of the residual sum of squares, plus a penalty for each jump."""
    return float(np.log(max(residual_square, 1e-300))) + len(jumps) * np.log(_MIN_REDUCTION)


def _same_times(first: list[Jump], second: list[Jump]) -> bool:
    times = [np.sort([jump.time for jump in jumps]) for jumps in (first, second)]
    return bool(np.all(abs(times[0] - times[1]) < _TIME_STEP_SAMPLES))
