"""Which of the choices tried is the best: by the worst peak, and among those as good at that by all levels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from rig.damper_design.choice import Trial

#: Choices whose reductions differ by less than this, dB, are equal: grids and averages resolve no smaller difference.
ALIKE = 0.05
#: The same as a ratio of peaks.
AS_GOOD = 10.0 ** (ALIKE / 20.0)
#: The same where part of the motion is irregular, whose averages are good to some percent: a clearance changed by one
#: percent moves them by up to six.
SCATTERED = 1.03
#: A clearance below this, m, is not built to: the depth of a bed of shot is uncertain by about as much.
MACHINABLE = 1e-4
#: Part of a dB at the worst level that a dB of the mean over the levels counts for, on the way to a better choice.
_OTHERS = 0.01


def ranked(trials: Iterable[Trial]) -> list[Trial]:
    """Put the best first.

    The smallest worst peak comes first. Where several are equally good at that (`ALIKE`), those with the smallest
    peaks on the average of the levels, in dB, come first. Of equals in that, too, the lightest come first, then the
    fewest dampers, then clearances that can be built, then no ceiling, and last the middle of the clearances: near the
    ends the worst peak is about to change. Fewer dampers that irregular motion does not distinguish from the best come
    before them.
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
            min(choice.clearances) < MACHINABLE,
            choice.has_ceiling,
        )

    best = min(map(merits, trials))
    alike = [np.log(trial.choice.clearances[0]) for trial in trials if merits(trial) == best]
    middle = 0.5 * (min(alike) + max(alike))

    def from_middle(trial: Trial) -> float:
        clearance = float(np.log(trial.choice.clearances[0]))
        return 0.0 if clearance == middle else abs(clearance - middle)

    order = sorted(trials, key=lambda trial: (merits(trial), from_middle(trial), trial.choice))
    fewer = [trial for trial in order if _with_fewer_as_good(trial, order[0])]
    first = min(fewer, key=lambda trial: len(trial.choice.bodies), default=order[0])
    order.remove(first)
    return [first, *order]


def equally_good(trial: Trial, best: Trial) -> bool:
    """Whether a trial does as well as the best one at the worst level, and on the average."""
    return trial.peak.size <= AS_GOOD * best.peak.size and trial.mean <= AS_GOOD * best.mean


def equals(trials: Iterable[Trial], best: Trial) -> list[Trial]:
    """Give the trials with the dampers of the best one that are as good in their other clearances, rising."""
    alike = {
        trial.choice: trial
        for trial in [*trials, best]
        if (trial.choice.bodies, trial.choice.masses) == (best.choice.bodies, best.choice.masses)
        and equally_good(trial, best)
    }
    return sorted(alike.values(), key=lambda trial: trial.choice.clearances)


def _with_fewer_as_good(trial: Trial, best: Trial) -> bool:
    """Return whether fewer dampers, no heavier, do as well as the best ones within the resolution of the search."""
    one, other = trial.choice, best.choice
    ratio = SCATTERED if any(peak.simulated for peak in (*trial.peaks, *best.peaks)) else AS_GOOD
    return (
        len(one.bodies) < len(other.bodies)
        and round(one.mass, 9) <= round(other.mass, 9)
        and trial.peak.size <= ratio * best.peak.size
        and trial.mean <= ratio * best.mean
    )


def merit(trial: Trial) -> float:
    """Give what is to become small on the way to a better choice; where the worst peak is flat, all levels count."""
    return float(np.log(trial.peak.size) + _OTHERS * np.log(trial.mean))


def front(trials: Sequence[Trial]) -> list[Trial]:
    """Give the best of all that are no heavier than it, from light to heavy (Pareto's front)."""
    masses = sorted({round(trial.choice.mass, 9) for trial in trials})
    best = [ranked(trial for trial in trials if round(trial.choice.mass, 9) <= mass)[0] for mass in masses]
    return list(dict.fromkeys(best))
