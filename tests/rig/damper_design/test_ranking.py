"""Choices of dampers are ranked over all levels, and lighter choices with equal performance are listed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rig.damper_design.choice import Choice, Trial
from rig.damper_design.ranking import pareto_front, rank_trials
from rig.damper_design.worst_peak import Peak


@pytest.mark.parametrize(("irregular", "bodies"), [(0.0, (1, 2)), (0.3, (2,))])
def test_one_damper_wins_against_irregular_motion(irregular: float, bodies: tuple[int, ...]) -> None:
    def trial(size: float, *choice: Any) -> Trial:
        return Trial(Choice(*choice), (Peak(size, 10.0, 1.0, 1, 1.0, irregular),))

    two_dampers = trial(1.0, (1, 2), (0.001, 0.099), (1e-3, 1e-3))
    one_damper = trial(1.01, (2,), (0.1,), (1e-3,))
    larger_peak = trial(1.05, (1,), (0.1,), (1e-3,))
    order = rank_trials([two_dampers, larger_peak, one_damper])
    assert order[0].choice.bodies == bodies and len(order) == 3 and order[-1] == larger_peak


def test_mean_reduction_decides_equal_worst_levels() -> None:
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


def test_middle_clearance_wins_among_equals() -> None:
    low_ceiling, middle_ceiling, high_ceiling = (
        trial_of(0.1, clearance, 2.0, 1.001) for clearance in (1e-3, 3e-3, 1e-2)
    )
    higher_mean = trial_of(0.1, 3e-2, 2.0, 1.2)
    assert (
        rank_trials([higher_mean, high_ceiling, low_ceiling, middle_ceiling])[0] == middle_ceiling
        and rank_trials([higher_mean, middle_ceiling])[1] == higher_mean
    )


def test_equals_rank_no_ceiling_first_unbuildable_last() -> None:
    unbuildable, usual, no_ceiling = (trial_of(0.1, clearance, 2.0) for clearance in (1.4e-5, 1e-3, np.inf))
    assert rank_trials([unbuildable, usual, no_ceiling]) == [no_ceiling, usual, unbuildable]


def trial_of(mass: float, clearance: float, *sizes: float) -> Trial:
    """Return a trial with the sizes of its peaks at levels of 1 N, 2 N, ..."""
    peaks = [Peak(size, 10.0, float(level), 1, 1.0, 0.0) for level, size in enumerate(sizes, 1)]
    return Trial(Choice((1,), (mass,), (clearance,)), tuple(peaks))


def test_no_lighter_choice_beats_the_front() -> None:
    masses_and_sizes = [(0.1, 3.0), (0.1, 2.0), (0.2, 2.5), (0.3, 1.0), (0.05, 4.0)]
    trials = [trial_of(mass, 1e-3, size) for mass, size in masses_and_sizes]
    assert [(trial.choice.mass, trial.peak.size) for trial in pareto_front(trials)] == [
        (0.05, 4.0),
        (0.1, 2.0),
        (0.3, 1.0),
    ]
