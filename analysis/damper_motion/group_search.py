"""Beam search for jumps that are too closely spaced for matching pursuit.

Matching pursuit can subtract a jump at a wrong time. The residual then resembles further jumps, and later fits cannot
correct this. The beam search keeps the few best sets of each size until one set explains the stretch. The number of
jumps is chosen by a penalty for each jump (information criterion: G. Schwarz, Ann. Stat. 6 (1978) 461).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.damper_motion.impact_model import ImpactModel
from analysis.damper_motion.joint_fit import Jump, Noise, fit_within
from rig.arrays import Array

# Number of sets that are kept at each size, of times that are tried for the next jump, and of jumps in a set.
_BEAM_WIDTH = 3
_PLACES_TRIED = 4
MAX_GROUP = 8
# An additional jump must reduce the residual sum of squares by this factor.
_MIN_REDUCTION = 5.0
# Spacing of the times that are tried, samples.
_PLACE_STEP = 2.0


@dataclass(frozen=True, eq=False)
class Stretch:
    """Differenced readings that are searched for several jumps; all other jumps are subtracted."""

    residual: Array
    model: ImpactModel
    within: tuple[int, int]
    """First and one-past-last difference."""
    noise: Noise

    def fit(self, jumps: list[Jump]) -> tuple[list[Jump], float]:
        """Fit jumps jointly; return them with the residual sum of squares."""
        return fit_within(self.residual, self.model, jumps, self.within, self.noise)

    def search(
        self, places: tuple[float, float], min_distance: float, sufficient: float
    ) -> tuple[list[Jump], float]:
        """Search for the jumps that best explain the stretch; return them with the residual sum of squares.

        `places`: limits of the times of the jumps, samples; `min_distance`: minimum distance between two jumps,
        samples; `sufficient`: residual sum of squares at which the search ends.
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
        """Choose the times at which one more jump reduces the residual most, from fits with fixed times."""
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
    """Return the logarithm of the residual sum of squares, plus a penalty for each jump."""
    return float(np.log(max(remaining, 1e-300))) + len(jumps) * np.log(_MIN_REDUCTION)


def _empty(place: float) -> Jump:
    return Jump(place, np.zeros(3), 1.0, 0.0)


def _same(left: list[Jump], right: list[Jump]) -> bool:
    places = [np.sort([jump.place for jump in jumps]) for jumps in (left, right)]
    return bool(np.all(abs(places[0] - places[1]) < _PLACE_STEP))
