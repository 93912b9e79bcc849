"""Candidate dampers are ranked by their peaks over all levels, and the best candidate of each mass is listed.

A trial is a choice of dampers with its computed peak (largest |X| / F) at each level, a force amplitude. Peaks within
0.05 dB (0.6 %) are equal; within 3 % if part of the motion is irregular.
"""

from typing import Any

import numpy as np
import pytest

from rig.studies.design.choice import Choice, Trial
from rig.studies.design.ranking import pareto_front, rank_trials
from rig.studies.design.worst_peak import Peak


@pytest.mark.parametrize(("irregular", "bodies"), [(0.0, (1, 2)), (0.3, (2,))])
def test_one_damper_precedes_two_with_irregular_motion(irregular: float, bodies: tuple[int, ...]) -> None:
    # `irregular`: share of the frequencies with irregular motion; `bodies`: those of the first choice in the ranking.
    def trial(magnitude: float, *choice: Any) -> Trial:
        peak = Peak(magnitude=magnitude, frequency=10.0, level=1.0, body=1, acceleration=1.0, irregular_share=irregular)
        return Trial(Choice(*choice), (peak,))

    # Bodies, masses and clearances.
    two_dampers = trial(1.0, (1, 2), (0.001, 0.099), (1e-3, 1e-3))
    one_damper = trial(1.01, (2,), (0.1,), (1e-3,))
    larger_peak = trial(1.05, (1,), (0.1,), (1e-3,))
    order = rank_trials([two_dampers, larger_peak, one_damper])
    assert order[0].choice.bodies == bodies and len(order) == 3 and order[-1] == larger_peak


def test_mean_peak_decides_if_worst_peaks_agree() -> None:
    # The worst peaks 2.000 and 2.010 are equal within 0.05 dB; 2.020 is larger.
    lowest_worst_peak, lowest_mean, higher_worst_peak = (
        trial_of(0.1, 1e-3, 2.000, 1.5),
        trial_of(0.1, 2e-3, 2.010, 1.0),
        trial_of(0.1, 3e-3, 2.020, 0.1),
    )
    assert rank_trials([lowest_worst_peak, higher_worst_peak, lowest_mean]) == [
        lowest_mean,
        lowest_worst_peak,
        higher_worst_peak,
    ]


def test_middle_of_equal_clearances_is_first() -> None:
    low_ceiling, middle_ceiling, high_ceiling = (
        trial_of(0.1, clearance, 2.0, 1.001) for clearance in (1e-3, 3e-3, 1e-2)
    )
    higher_mean = trial_of(0.1, 3e-2, 2.0, 1.2)
    assert (
        rank_trials([higher_mean, high_ceiling, low_ceiling, middle_ceiling])[0] == middle_ceiling
        and rank_trials([higher_mean, middle_ceiling])[1] == higher_mean
    )


def test_equal_peaks_rank_no_ceiling_first() -> None:
    # A clearance below 0.1 mm cannot be built.
    unbuildable, usual, no_ceiling = (trial_of(0.1, clearance, 2.0) for clearance in (1.4e-5, 1e-3, np.inf))
    assert rank_trials([unbuildable, usual, no_ceiling]) == [no_ceiling, usual, unbuildable]


def trial_of(mass: float, clearance: float, *magnitudes: float) -> Trial:
    """Return the trial of one damper [kg, m], with peaks of these magnitudes at force amplitudes of 1 N, 2 N, ..."""
    peaks = [
        Peak(magnitude=magnitude, frequency=10.0, level=float(force), body=1, acceleration=1.0, irregular_share=0.0)
        for force, magnitude in enumerate(magnitudes, 1)
    ]
    return Trial(Choice((1,), (mass,), (clearance,)), tuple(peaks))


def test_no_choice_beats_a_pareto_choice() -> None:
    # A Pareto choice: no other choice is both lighter and better.
    masses_and_peaks = [(0.1, 3.0), (0.1, 2.0), (0.2, 2.5), (0.3, 1.0), (0.05, 4.0)]
    trials = [trial_of(mass, 1e-3, magnitude) for mass, magnitude in masses_and_peaks]
    assert [(trial.choice.mass, trial.peak.magnitude) for trial in pareto_front(trials)] == [
        (0.05, 4.0),
        (0.1, 2.0),
        (0.3, 1.0),
    ]
