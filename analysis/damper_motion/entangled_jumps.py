"""Jumps so near to each other that a search for one at a time goes astray: sets of them, grown together.

A jump taken out at a wrong place leaves what looks like others, and no later fit of those that were found comes back
from there. Here the few best sets are kept at every size, until one of them explains a stretch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.joint_fit import Jump, fit_within
from analysis.damper_motion.jump_signature import Signature

Array = NDArray[np.float64]

# Sets kept at each size, jumps tried as the next one of each, and jumps in a set.
_KEPT, _TRIED, _MOST = 3, 4, 8
# A jump more must leave so many times less, in squares.
_PAYS = 5.0
# Places tried are so many samples apart; a fit moves each of them half as far, either way.
_STEP = 2.0


def grow(
    rest: Array,
    of: Signature,
    within: tuple[int, int],
    places: tuple[float, float],
    apart: float,
    enough: float,
    noise: float,
    typical: tuple[float, float],
) -> tuple[list[Jump], float]:
    """Find the jumps that best explain a stretch of differences, few rather than many; with the squares that are left.

    Parameters
    ----------
    rest : ndarray
        Differences with all jumps taken out that lie elsewhere.
    within : tuple of int
        First and one-past-last difference of the stretch.
    places : tuple of float
        Between which jumps may lie, samples.
    apart : float
        Least distance of two, samples.
    enough : float
        Squares that may be left.
    noise, typical
        As for `fit_together`.
    """
    best: list[tuple[list[Jump], float]] = []
    sets: list[list[Jump]] = [[]]
    for _ in range(_MOST):
        larger = [
            fit_within(rest, of, [*known, _blank(place)], within, noise, typical)
            for known in sets
            for place in _next(rest, of, within, places, apart, known, noise, typical)
        ]
        larger.sort(key=lambda fit: fit[1])
        distinct: list[tuple[list[Jump], float]] = []
        for fit in larger:
            if not any(_same(fit[0], other[0]) for other in distinct):
                distinct.append(fit)
        best, sets = best + distinct[:1], [fit[0] for fit in distinct[:_KEPT]]
        if not distinct or distinct[0][1] < enough:
            break
    return min(best, key=lambda fit: cost(*fit), default=([], np.inf))


def cost(jumps: list[Jump], left: float) -> float:
    """By how little a set of jumps explains what there is with how many: the logarithm of what is left, and a share."""
    return float(np.log(max(left, 1e-300))) + len(jumps) * np.log(_PAYS)


def _next(
    rest: Array,
    of: Signature,
    within: tuple[int, int],
    places: tuple[float, float],
    apart: float,
    known: list[Jump],
    noise: float,
    typical: tuple[float, float],
) -> list[float]:
    """Places at which one more jump leaves least, by fits that move none."""
    tried = [
        float(place)
        for place in np.arange(*places, _STEP)
        if all(abs(place - one.place) >= apart for one in known)
    ]
    left = [
        fit_within(rest, of, [*known, _blank(place)], within, noise, typical, rounds=1)[1] for place in tried
    ]
    return [tried[k] for k in np.argsort(left, kind="stable")[:_TRIED]]


def _blank(place: float) -> Jump:
    return Jump(place, np.zeros(3), 1.0, 0.0)


def _same(one: list[Jump], other: list[Jump]) -> bool:
    places = [np.sort([jump.place for jump in jumps]) for jumps in (one, other)]
    return bool(np.all(abs(places[0] - places[1]) < _STEP))
