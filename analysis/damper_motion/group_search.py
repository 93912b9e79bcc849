"""Beam search for sets of jumps so near to each other that matching pursuit fails.

A jump subtracted at a wrong place leaves a residual that looks like others, and no later fit corrects that. Here the
few best sets of each size are kept, until a set explains the stretch. The number of jumps is the least that pays
(a penalty for each, as in G. Schwarz, Ann. Stat. 6 (1978) 461).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.impact_model import ImpactModel
from analysis.damper_motion.joint_fit import Jump, Noise, fit_within

Array = NDArray[np.float64]

# Sets kept at each size, and places tried for the next jump of each.
_BEAM_WIDTH = 3
_PLACES_TRIED = 4
MAX_GROUP = 8
# One more jump must reduce the remaining squares by this factor.
_MIN_REDUCTION = 5.0
# Distance of the places tried, samples; a fit moves each of them by at most half of it.
_PLACE_STEP = 2.0


@dataclass(frozen=True, eq=False)
class Stretch:
    """Differences in which jumps are searched together, without those elsewhere."""

    residual: Array
    model: ImpactModel
    within: tuple[int, int]
    """First and one-past-last difference."""
    noise: Noise

    def fit(self, jumps: list[Jump]) -> tuple[list[Jump], float]:
        """Fit jumps jointly; return them with the remaining squares."""
        return fit_within(self.residual, self.model, jumps, self.within, self.noise)

    def search(
        self, places: tuple[float, float], min_distance: float, sufficient: float
    ) -> tuple[list[Jump], float]:
        """Find the few jumps that best explain the stretch; return them with the remaining squares.

        Parameters
        ----------
        places : tuple of float
            Between which jumps may lie, samples.
        min_distance : float
            Between two jumps, samples.
        sufficient : float
            Remaining squares at which the search ends.
        """
        best: list[tuple[list[Jump], float]] = []
        sets: list[list[Jump]] = [[]]
        for _ in range(MAX_GROUP):
            larger = [
                self.fit([*known, _empty(place)])
                for known in sets
                for place in self._next_places(places, min_distance, known)
            ]
            larger.sort(key=lambda fit: fit[1])
            distinct: list[tuple[list[Jump], float]] = []
            for fit in larger:
                if not any(_same(fit[0], other[0]) for other in distinct):
                    distinct.append(fit)
            best, sets = best + distinct[:1], [fit[0] for fit in distinct[:_BEAM_WIDTH]]
            if not distinct or distinct[0][1] < sufficient:
                break
        return min(best, key=lambda fit: cost(*fit), default=([], np.inf))

    def _next_places(
        self, places: tuple[float, float], min_distance: float, known: list[Jump]
    ) -> list[float]:
        """Places at which one more jump leaves the least squares, by fits that move none."""
        tried = [
            float(place)
            for place in np.arange(*places, _PLACE_STEP)
            if all(abs(place - jump.place) >= min_distance for jump in known)
        ]
        remaining = [
            fit_within(
                self.residual, self.model, [*known, _empty(place)], self.within, self.noise, iterations=1
            )[1]
            for place in tried
        ]
        return [tried[k] for k in np.argsort(remaining, kind="stable")[:_PLACES_TRIED]]


def cost(jumps: list[Jump], remaining: float) -> float:
    """Logarithm of the remaining squares, plus a penalty for each jump."""
    return float(np.log(max(remaining, 1e-300))) + len(jumps) * np.log(_MIN_REDUCTION)


def _empty(place: float) -> Jump:
    return Jump(place, np.zeros(3), 1.0, 0.0)


def _same(left: list[Jump], right: list[Jump]) -> bool:
    places = [np.sort([jump.place for jump in jumps]) for jumps in (left, right)]
    return bool(np.all(abs(places[0] - places[1]) < _PLACE_STEP))
