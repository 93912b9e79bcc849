"""Beam search for velocity jumps that are too closely spaced for matching pursuit.

Matching pursuit can subtract a jump at a wrong time. The residual then resembles further jumps, and later fits cannot
correct this. The beam search extends the few best sets of jumps by one jump at a time, until a set explains the
segment. The number of jumps is chosen by a penalty for each jump. The form is that of the Bayesian information
criterion (G. Schwarz, Ann. Stat. 6 (1978) 461), with an empirical penalty of ln 5.
"""

from collections.abc import Callable

import numpy as np

from analysis.core.damper_motion.simultaneous_fit import ITERATIONS, Jump

# Number of groups of jumps that are extended by a further jump; the computing time is proportional to it.
_BEAM_WIDTH = 3
# Number of candidates for the further jump of a group that are fitted completely, which takes most of the time.
_EXTENSIONS = 4
# Maximum number of jumps in a group; the computing time increases with its cube.
MAX_GROUP = 8
# An additional jump must reduce the residual sum of squares by this factor, more than noise does by chance.
_MIN_REDUCTION = 5.0
# Spacing of the times that are tried for the next jump; the joint fit then refines the times.
_TIME_STEP_SAMPLES = 2.0


def search_group(
    fit: Callable[[list[Jump], int], tuple[list[Jump], float]],
    times: tuple[float, float],
    min_distance: float,
    sufficient_square: float,
) -> tuple[list[Jump], float]:
    """Search for the velocity jumps that best explain a segment; return them with the residual sum of squares.

    `fit`: joint fit of jumps to the segment with a number of iterations (1: fixed times), which returns the jumps and
    the residual sum of squares; `times`: limits of the times of the jumps [samples]; `min_distance`: minimum distance
    between two jumps [samples]; `sufficient_square`: residual sum of squares at which the search ends.
    """
    best_of_each_size: list[tuple[list[Jump], float]] = []
    beam: list[list[Jump]] = [[]]
    for _ in range(MAX_GROUP):
        fits = []
        for jumps in beam:
            candidates = [
                [*jumps, Jump(float(time), np.zeros(3), 1.0, 0.0)]
                for time in np.arange(*times, _TIME_STEP_SAMPLES)
                if all(abs(time - jump.time) >= min_distance for jump in jumps)
            ]
            # The candidates are ranked by fits with fixed times; only the best are fitted completely.
            residual_squares = [fit(candidate, 1)[1] for candidate in candidates]
            ranking = np.argsort(residual_squares, kind="stable")[:_EXTENSIONS]
            fits += [fit(candidates[k], ITERATIONS) for k in ranking]
        fits.sort(key=lambda fitted: fitted[1])
        distinct: list[tuple[list[Jump], float]] = []
        for fitted in fits:
            if not any(_have_same_times(fitted[0], other[0]) for other in distinct):
                distinct.append(fitted)
        best_of_each_size += distinct[:1]
        beam = [jumps for jumps, _ in distinct[:_BEAM_WIDTH]]
        if not distinct or distinct[0][1] < sufficient_square:
            break
    return min(best_of_each_size, key=lambda fitted: cost(*fitted), default=([], np.inf))


def cost(jumps: list[Jump], residual_square: float) -> float:
    """Return the logarithm of the residual sum of squares, plus a penalty for each jump."""
    return float(np.log(max(residual_square, 1e-300))) + len(jumps) * np.log(_MIN_REDUCTION)


def _have_same_times(first: list[Jump], second: list[Jump]) -> bool:
    first_times, second_times = (np.sort([jump.time for jump in jumps]) for jumps in (first, second))
    return bool(np.all(abs(first_times - second_times) < _TIME_STEP_SAMPLES))
