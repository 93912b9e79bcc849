"""Which of the choices tried is the best: by the worst peak, and among those as good at that by all levels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from rig.damper_design.choice import Trial

#: Choices whose reductions differ by less than this, dB, do alike: grids and averages tell no less apart.
ALIKE = 0.05
#: The same as a ratio of peaks.
AS_GOOD = 10.0 ** (ALIKE / 20.0)
#: Part of a dB at the worst level that a dB of the mean over the levels counts for, on the way to a better choice.
_OTHERS = 0.01


def ranked(trials: Iterable[Trial]) -> list[Trial]:
    """Put the best first.

    The smallest worst peak comes first. Where several are as good at that as can be told, those with the smallest
    peaks on the average of the levels, in dB, do; and of these the lightest, with the smallest clearance.
    """
    trials = list(trials)
    limit = AS_GOOD * min(trial.peak.size for trial in trials)

    def key(trial: Trial) -> tuple[object, ...]:
        # Rounding keeps what the last digits of a peak say out of it, where the beds never reach their ceilings.
        mean = round(20.0 * np.log10(trial.mean), 2)
        return max(trial.peak.size, limit), mean, round(trial.choice.mass, 9), trial.choice

    return sorted(trials, key=key)


def merit(trial: Trial) -> float:
    """Give what is to become small on the way to a better choice; where the worst peak is flat, all levels tell."""
    return float(np.log(trial.peak.size) + _OTHERS * np.log(trial.mean))


def front(trials: Sequence[Trial]) -> list[Trial]:
    """Give the best of all that are no heavier than it, from light to heavy (Pareto's front)."""
    masses = sorted({round(trial.choice.mass, 9) for trial in trials})
    best = [ranked(trial for trial in trials if round(trial.choice.mass, 9) <= mass)[0] for mass in masses]
    return list(dict.fromkeys(best))
