"""Effect of the dampers on every mode of a structure, inside and outside the design band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rig.damper_design.answers import Answers
from rig.damper_design.choice import Question, Trial
from rig.damper_design.ranking import EQUAL_DB, MACHINABLE, equals
from rig.damper_design.worst_peak import Peak
from rig.system.structural_model import structural_model

#: Largest relative distance from a natural frequency at which a peak is assigned to its mode.
REACH = 0.15
#: Largest number of modes evaluated, those nearest to the band.
_MOST_MODES = 6
#: Number of equally good designs that are compared outside the band.
_COMPARED = 5


@dataclass(frozen=True)
class ModePeaks:
    """Peaks of a mode."""

    frequency: float  # natural frequency of the structure without dampers, Hz
    inside: bool  # whether it lies in the band of the question
    bare: Peak  # without dampers
    damped: tuple[Peak, ...]  # with dampers, at each level


def modes_of(question: Question) -> list[tuple[float, Question]]:
    """Return natural frequencies in and next to the band, with the question restricted to each mode."""
    nominal = question.scenes[0]
    natural = structural_model(nominal).with_bed_masses().modes.frequency
    natural = natural[natural > 0.0]
    low, high = question.band
    away = np.maximum(np.log(low / natural), np.log(natural / high))
    near = np.sort(np.argsort(away, kind="stable")[:_MOST_MODES])
    middles = np.sqrt(natural[1:] * natural[:-1])
    below = np.maximum(natural * (1.0 - REACH), np.concatenate([[0.0], middles]))
    above = np.minimum(natural * (1.0 + REACH), np.concatenate([middles, [np.inf]]))
    each = []
    for k in near.tolist():
        inside = low < natural[k] < high
        bounds = (max(below[k], low), min(above[k], high)) if inside else (below[k], above[k])
        band = float(bounds[0]), float(bounds[1])
        if band[0] < natural[k] < band[1]:
            each.append((float(natural[k]), replace(question, scenes=(nominal,), band=band)))
    return each


def mode_peaks(question: Question, trial: Trial, answers: Answers) -> tuple[ModePeaks, ...]:
    """Compute the peaks of every mode with the dampers of a trial.

    If a single mode lies in the band, its peaks are the peaks of the trial.
    """
    low, high = question.band
    modes = modes_of(question)
    alone = sum(low < frequency < high for frequency, _ in modes) == 1 and len(question.scenes) == 1
    found = []
    for frequency, about in modes:
        inside = low < frequency < high
        if inside and alone:
            found.append(ModePeaks(frequency, True, question.bare, trial.peaks))
        else:
            (damped,) = answers.of(about, [trial.choice])
            found.append(ModePeaks(frequency, inside, about.bare, damped.peaks))
    return tuple(found)


def best_outside(question: Question, trials: Sequence[Trial], best: Trial, answers: Answers) -> Trial:
    """Select, among equal designs in the band, the design with the largest reduction outside the band.

    The criterion is the mean over modes and levels in dB; ties keep the order of `rank_trials`. Clearances too small to
    build are compared only if no others are available.
    """
    low, high = question.band
    outside = [about for frequency, about in modes_of(question) if not low < frequency < high]
    alike = equals(trials, best)
    buildable = [trial for trial in alike if min(trial.choice.clearances) >= MACHINABLE] or alike
    if not outside or len(buildable) < 2:
        return best
    spread = np.linspace(0, len(buildable) - 1, min(_COMPARED, len(buildable))).round().astype(int)
    rivals = list(dict.fromkeys([best, *(buildable[k] for k in spread)]))
    sizes = np.zeros(len(rivals))
    for about in outside:
        sizes += [20.0 * np.log10(trial.mean) for trial in answers.of(about, [r.choice for r in rivals])]
    sizes /= len(outside)
    first = 0 if sizes[0] <= sizes.min() + EQUAL_DB else int(sizes.argmin())
    return rivals[first]
