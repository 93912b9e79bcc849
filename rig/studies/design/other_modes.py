"""Effect of the dampers on every mode of a structure, inside and outside the band of the design."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rig.core.system.structural_model import structural_model
from rig.studies.design.choice import Objective, Trial
from rig.studies.design.evaluator import Evaluator
from rig.studies.design.ranking import EQUAL_DB, MIN_MACHINABLE_CLEARANCE, equal_trials
from rig.studies.design.worst_peak import Peak

#: A peak is assigned to a mode up to this relative distance from the natural frequency: the largest shift by dampers in
#: common studies.
MAX_PEAK_OFFSET = 0.15
#: Maximum number of evaluated modes: those nearest to the band. Each requires a frequency response.
_MAX_MODES = 6
#: Maximum number of equally good designs that are compared outside the band. Each requires a frequency response.
_MAX_COMPARED = 5


@dataclass(frozen=True)
class ModePeaks:
    """Largest peaks near a natural frequency."""

    frequency: float  # natural frequency with the masses of locked dampers, without the other dampers [Hz]
    in_band: bool  # whether the natural frequency lies in the band of the objective
    undamped: Peak  # without dampers
    damped: tuple[Peak, ...]  # with dampers, at each level


def mode_objectives(objective: Objective) -> list[tuple[float, Objective]]:
    """Return natural frequencies in and next to the band [Hz], each with the objective restricted to its mode."""
    nominal = objective.scenes[0]
    natural = structural_model(nominal).with_damper_masses().modes.frequency
    natural = natural[natural > 0.0]
    low, high = objective.band
    # Logarithmic distance from the band; negative inside.
    distance = np.maximum(np.log(low / natural), np.log(natural / high))
    nearest = np.sort(np.argsort(distance, kind="stable")[:_MAX_MODES])
    midpoints = np.sqrt(natural[1:] * natural[:-1])
    lower_ends = np.maximum(natural * (1.0 - MAX_PEAK_OFFSET), np.concatenate([[0.0], midpoints]))
    upper_ends = np.minimum(natural * (1.0 + MAX_PEAK_OFFSET), np.concatenate([midpoints, [np.inf]]))
    objectives = []
    for k in nearest.tolist():
        in_band = low < natural[k] < high
        limits = (max(lower_ends[k], low), min(upper_ends[k], high)) if in_band else (lower_ends[k], upper_ends[k])
        band = float(limits[0]), float(limits[1])
        if band[0] < natural[k] < band[1]:
            objectives.append((float(natural[k]), replace(objective, scenes=(nominal,), band=band)))
    return objectives


def mode_peaks(objective: Objective, trial: Trial, evaluator: Evaluator) -> tuple[ModePeaks, ...]:
    """Compute the peaks of each mode in and next to the band, with the dampers of a trial and without dampers."""
    low, high = objective.band
    modes = mode_objectives(objective)
    is_single_mode = sum(low < frequency < high for frequency, _ in modes) == 1 and len(objective.scenes) == 1
    peaks = []
    for frequency, mode_objective in modes:
        in_band = low < frequency < high
        # If the band contains a single mode, its peaks are the peaks of the trial.
        if in_band and is_single_mode:
            peaks.append(ModePeaks(frequency, True, objective.bare_peak, trial.peaks))
        else:
            (damped,) = evaluator.compute(mode_objective, [trial.choice])
            mode_low, mode_high = mode_objective.band
            # Averages of irregular motion depend on the grid of frequencies, so the largest peak is not computed again.
            is_same = in_band and len(objective.scenes) == 1
            damped_peaks = tuple(
                whole if is_same and mode_low <= whole.frequency <= mode_high else own
                for whole, own in zip(trial.peaks, damped.peaks, strict=True)
            )
            peaks.append(ModePeaks(frequency, in_band, mode_objective.bare_peak, damped_peaks))
    return tuple(peaks)


def select_outside_band(objective: Objective, trials: Sequence[Trial], best: Trial, evaluator: Evaluator) -> Trial:
    """Select the design with the smallest peaks outside the band, among the designs that are equal in the band.

    The criterion is the mean peak over modes and levels in dB; in a tie, `best`, the best design in the band, is
    selected. Designs with clearances that are too small to build are compared only if there are no others.
    """
    low, high = objective.band
    outside = [mode_objective for frequency, mode_objective in mode_objectives(objective) if not low < frequency < high]
    equal = equal_trials(trials, best)
    buildable = [trial for trial in equal if min(trial.choice.clearances) >= MIN_MACHINABLE_CLEARANCE] or equal
    if not outside or len(buildable) < 2:
        return best
    indices = np.linspace(0, len(buildable) - 1, min(_MAX_COMPARED, len(buildable))).round().astype(int)
    candidates = list(dict.fromkeys([best, *(buildable[k] for k in indices)]))
    candidate_choices = [trial.choice for trial in candidates]
    mean_peaks_db = np.zeros(len(candidates))
    for mode_objective in outside:
        mean_peaks_db += [
            20.0 * np.log10(trial.mean_peak) for trial in evaluator.compute(mode_objective, candidate_choices)
        ]
    mean_peaks_db /= len(outside)
    is_best_equal = mean_peaks_db[0] <= mean_peaks_db.min() + EQUAL_DB
    return best if is_best_equal else candidates[int(mean_peaks_db.argmin())]
