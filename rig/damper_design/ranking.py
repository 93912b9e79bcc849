"""Which of the choices tried is the best: by the worst peak, and among those as good at that by all levels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from rig.damper_design.choice import Trial

#: Choices whose reductions differ by less than this, dB, do alike: grids and averages tell no less apart.
ALIKE = 0.05
#: The same as a ratio of peaks.
AS_GOOD = 10.0 ** (ALIKE / 20.0)
#: The same where part of the motion is irregular, whose averages are good to some percent: a clearance changed by one
#: percent moves them by up to six.
SCATTERED = 1.03
#: Part of a dB at the worst level that a dB of the mean over the levels counts for, on the way to a better choice.
_OTHERS = 0.01


def ranked(trials: Iterable[Trial]) -> list[Trial]:
    """Put the best first.

    The smallest worst peak comes first. Where several are as good at that as can be told, those with the smallest
    peaks on the average of the levels, in dB, do. Where several are as good at that, too, the lightest do, of these the
    fewest dampers, and of these the one in the middle of their clearances: at the ends it would do so just about.
    Fewer dampers that irregular motion does not tell from the best come before them.
    """
    trials = list(trials)
    worst = AS_GOOD * min(trial.peak.size for trial in trials)
    mean = AS_GOOD * min(trial.mean for trial in trials if trial.peak.size <= worst)

    def merits(trial: Trial) -> tuple[float, ...]:
        choice = trial.choice
        return (
            max(trial.peak.size, worst),
            max(trial.mean, mean),
            round(choice.mass, 9),
            len(choice.bodies),
        )

    best = min(map(merits, trials))
    alike = [np.log(trial.choice.clearances[0]) for trial in trials if merits(trial) == best]
    middle = 0.5 * (min(alike) + max(alike))

    def from_middle(trial: Trial) -> float:
        return abs(float(np.log(trial.choice.clearances[0]) - middle))

    order = sorted(trials, key=lambda trial: (merits(trial), from_middle(trial), trial.choice))
    fewer = [trial for trial in order if _with_fewer_as_good(trial, order[0])]
    first = min(fewer, key=lambda trial: len(trial.choice.bodies), default=order[0])
    order.remove(first)
    return [first, *order]


def _with_fewer_as_good(trial: Trial, best: Trial) -> bool:
    """Tell whether fewer dampers, no heavier, do as well as the best ones as far as their motion tells."""
    one, other = trial.choice, best.choice
    ratio = SCATTERED if any(peak.simulated for peak in (*trial.peaks, *best.peaks)) else AS_GOOD
    return (
        len(one.bodies) < len(other.bodies)
        and round(one.mass, 9) <= round(other.mass, 9)
        and trial.peak.size <= ratio * best.peak.size
        and trial.mean <= ratio * best.mean
    )


def merit(trial: Trial) -> float:
    """Give what is to become small on the way to a better choice; where the worst peak is flat, all levels tell."""
    return float(np.log(trial.peak.size) + _OTHERS * np.log(trial.mean))


def front(trials: Sequence[Trial]) -> list[Trial]:
    """Give the best of all that are no heavier than it, from light to heavy (Pareto's front)."""
    masses = sorted({round(trial.choice.mass, 9) for trial in trials})
    best = [ranked(trial for trial in trials if round(trial.choice.mass, 9) <= mass)[0] for mass in masses]
    return list(dict.fromkeys(best))
