"""Effect of the dampers on every mode of a structure, inside and outside the band of the design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rig.damper_design.choice import Question, Trial
from rig.damper_design.evaluator import Evaluator
from rig.damper_design.ranking import EQUAL_DB, MIN_MACHINABLE_CLEARANCE, equal_trials
from rig.damper_design.worst_peak import Peak
from rig.system.structural_model import structural_model

#: Largest relative distance from a natural frequency at which a peak is assigned to its mode.
MAX_PEAK_OFFSET = 0.15
#: Largest number of modes evaluated, those nearest to the band.
_MAX_MODES = 6
#: Number of equally good designs that are compared outside the band.
_MAX_COMPARED = 5


@dataclass(frozen=True)
class ModePeaks:
    """Peaks of a mode."""

    frequency: float  # natural frequency of the structure without dampers, Hz
    inside: bool  # whether it lies in the band of the question
    bare: Peak  # without dampers
    damped: tuple[Peak, ...]  # with dampers, at each level


def mode_questions_of(question: Question) -> list[tuple[float, Question]]:
    """Return natural frequencies in and next to the band, with the question restricted to each mode."""
    nominal = question.scenes[0]
    natural = structural_model(nominal).with_bed_masses().modes.frequency
    natural = natural[natural > 0.0]
    low, high = question.band
    distance = np.maximum(np.log(low / natural), np.log(natural / high))
    nearest = np.sort(np.argsort(distance, kind="stable")[:_MAX_MODES])
    midpoints = np.sqrt(natural[1:] * natural[:-1])
    lower_ends = np.maximum(natural * (1.0 - MAX_PEAK_OFFSET), np.concatenate([[0.0], midpoints]))
    upper_ends = np.minimum(natural * (1.0 + MAX_PEAK_OFFSET), np.concatenate([midpoints, [np.inf]]))
    mode_questions = []
    for k in nearest.tolist():
        inside = low < natural[k] < high
        ends = (max(lower_ends[k], low), min(upper_ends[k], high)) if inside else (lower_ends[k], upper_ends[k])
        band = float(ends[0]), float(ends[1])
        if band[0] < natural[k] < band[1]:
            mode_questions.append((float(natural[k]), replace(question, scenes=(nominal,), band=band)))
    return mode_questions


def mode_peaks(question: Question, trial: Trial, evaluator: Evaluator) -> tuple[ModePeaks, ...]:
    """Compute the peaks of every mode with the dampers of a trial.

    If a single mode lies in the band, its peaks are the peaks of the trial.
    """
    low, high = question.band
    modes = mode_questions_of(question)
    is_single_mode = sum(low < frequency < high for frequency, _ in modes) == 1 and len(question.scenes) == 1
    peaks = []
    for frequency, mode_question in modes:
        inside = low < frequency < high
        if inside and is_single_mode:
            peaks.append(ModePeaks(frequency, True, question.bare, trial.peaks))
        else:
            (damped,) = evaluator.compute(mode_question, [trial.choice])
            peaks.append(ModePeaks(frequency, inside, mode_question.bare, damped.peaks))
    return tuple(peaks)


def select_outside_band(question: Question, trials: Sequence[Trial], best: Trial, evaluator: Evaluator) -> Trial:
    """Select, among equal designs in the band, the design with the largest reduction outside the band.

    The criterion is the mean peak over modes and levels in dB; the best design in the band has priority in a tie.
    Clearances that are too small to build are compared only if no others are available.
    """
    low, high = question.band
    outside = [mode_question for frequency, mode_question in mode_questions_of(question) if not low < frequency < high]
    equal = equal_trials(trials, best)
    buildable = [trial for trial in equal if min(trial.choice.clearances) >= MIN_MACHINABLE_CLEARANCE] or equal
    if not outside or len(buildable) < 2:
        return best
    indices = np.linspace(0, len(buildable) - 1, min(_MAX_COMPARED, len(buildable))).round().astype(int)
    rivals = list(dict.fromkeys([best, *(buildable[k] for k in indices)]))
    rival_choices = [trial.choice for trial in rivals]
    mean_peaks_db = np.zeros(len(rivals))
    for mode_question in outside:
        mean_peaks_db += [20.0 * np.log10(trial.mean_peak) for trial in evaluator.compute(mode_question, rival_choices)]
    mean_peaks_db /= len(outside)
    is_best_equal = mean_peaks_db[0] <= mean_peaks_db.min() + EQUAL_DB
    return best if is_best_equal else rivals[int(mean_peaks_db.argmin())]
