"""Ranking of candidate designs by the worst peak, then by the mean over all levels."""

from collections.abc import Iterable, Sequence

import numpy as np

from rig.studies.design.choice import Trial

#: Largest difference of peaks that are ranked as equal [dB]: grids and averages do not resolve a smaller difference.
EQUAL_DB = 0.05
#: `EQUAL_DB` as a ratio of peaks.
EQUAL_RATIO = 10.0 ** (EQUAL_DB / 20.0)
#: Peaks within this ratio count as equal if part of the motion is irregular. Averages of irregular motion scatter: a
#: change of the clearance by 1 % changes them by up to 6 %.
IRREGULAR_RATIO = 1.03
#: Smallest clearance that can be built [m]: the depth of a bed of shot is uncertain by about as much.
MIN_MACHINABLE_CLEARANCE = 1e-4
#: In the objective of the search, the mean over the levels has this weight relative to the worst level.
_MEAN_WEIGHT = 0.01


def rank_trials(trials: Iterable[Trial]) -> list[Trial]:
    """Sort trials, best first.

    Each criterion decides between trials that are equal by the previous criteria; peaks within `EQUAL_DB` are equal:

    1. smallest worst peak, 2. smallest mean peak over the levels in dB, 3. smallest mass, 4. fewest dampers,
    5. clearances that can be built, 6. no ceiling, 7. clearance nearest to the middle of the remaining clearances,
    because the worst peak changes near their ends.

    A design with fewer dampers becomes the first if it equals the best design within the scatter of irregular motion.
    """
    trials = list(trials)
    worst_limit = EQUAL_RATIO * min(trial.peak.magnitude for trial in trials)
    mean_limit = EQUAL_RATIO * min(trial.mean_peak for trial in trials if trial.peak.magnitude <= worst_limit)

    def criteria(trial: Trial) -> tuple[float, ...]:
        choice = trial.choice
        return (
            max(trial.peak.magnitude, worst_limit),
            max(trial.mean_peak, mean_limit),
            _rounded(choice.mass),
            len(choice.bodies),
            min(choice.clearances) < MIN_MACHINABLE_CLEARANCE,
            choice.has_ceiling,
        )

    best = min(map(criteria, trials))
    equal_clearances = [np.log(trial.choice.clearances[0]) for trial in trials if criteria(trial) == best]
    middle = 0.5 * (min(equal_clearances) + max(equal_clearances))

    def distance_from_middle(trial: Trial) -> float:
        clearance = float(np.log(trial.choice.clearances[0]))
        return 0.0 if clearance == middle else abs(clearance - middle)

    order = sorted(trials, key=lambda trial: (criteria(trial), distance_from_middle(trial), trial.choice))
    fewer_dampers = [trial for trial in order if _is_equal_with_fewer_dampers(trial, order[0])]
    first = min(fewer_dampers, key=lambda trial: len(trial.choice.bodies), default=order[0])
    order.remove(first)
    return [first, *order]


def is_equally_good(trial: Trial, best: Trial) -> bool:
    """Return whether a trial equals the best trial at the worst level and in the mean over levels."""
    return trial.peak.magnitude <= EQUAL_RATIO * best.peak.magnitude and trial.mean_peak <= EQUAL_RATIO * best.mean_peak


def equal_trials(trials: Iterable[Trial], best: Trial) -> list[Trial]:
    """Return equally good trials that differ from the best only in clearance, by rising clearance."""
    equal = {
        trial.choice: trial
        for trial in [*trials, best]
        if (trial.choice.bodies, trial.choice.masses) == (best.choice.bodies, best.choice.masses)
        and is_equally_good(trial, best)
    }
    return sorted(equal.values(), key=lambda trial: trial.choice.clearances)


def _is_equal_with_fewer_dampers(trial: Trial, best: Trial) -> bool:
    """Return whether a design with fewer dampers and no more mass equals the best design within the resolution."""
    choice, best_choice = trial.choice, best.choice
    ratio = IRREGULAR_RATIO if any(peak.irregular_share for peak in (*trial.peaks, *best.peaks)) else EQUAL_RATIO
    return (
        len(choice.bodies) < len(best_choice.bodies)
        and _rounded(choice.mass) <= _rounded(best_choice.mass)
        and trial.peak.magnitude <= ratio * best.peak.magnitude
        and trial.mean_peak <= ratio * best.mean_peak
    )


def _rounded(mass: float) -> float:
    """Round a mass so that the rounding errors of a sum do not distinguish equal masses."""
    return float(f"{mass:.9g}")


def search_cost(trial: Trial) -> float:
    """Return the cost that local searches minimize: the worst peak, with the mean peak to avoid flat regions."""
    return float(np.log(trial.peak.magnitude) + _MEAN_WEIGHT * np.log(trial.mean_peak))


def pareto_front(trials: Sequence[Trial]) -> list[Trial]:
    """Return the Pareto front of worst peak against mass, from light to heavy."""
    masses = sorted({_rounded(trial.choice.mass) for trial in trials})
    best = [rank_trials(trial for trial in trials if _rounded(trial.choice.mass) <= mass)[0] for mass in masses]
    return list(dict.fromkeys(best))
