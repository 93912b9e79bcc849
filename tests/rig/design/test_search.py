"""The search returns the best choice of dampers in any order of evaluation, and one damper where one suffices.

An objective returns the worst peak of a choice of dampers (bodies, masses in kg, clearances in m). These tests replace
the structure by closed forms, so that the best choice is known. A trial is a choice with its peaks. A search
space is the set of choices: bodies, total mass, and the smallest and largest clearance. Arguments are positional:
Objective(scenes, levels, band, bodies), Peak(compliance, frequency, level, body, acceleration, irregular share).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rig
from rig.core.base.errors import RunError
from rig.core.base.output_files import allow_overwriting
from rig.studies.design.choice import Choice, Objective, SearchSpace, Trial
from rig.studies.design.evaluator import Evaluator
from rig.studies.design.ranking import pareto_front
from rig.studies.design.search import _grid_row, _optimize_common_factor, search
from rig.studies.design.worst_peak import Peak


@dataclass(frozen=True)
class QuadraticOptimum(Objective):
    """Objective with a quadratic peak: smallest for dampers of 60 g in body 2 with a clearance of 1 mm."""

    def worst(self, choice: Choice) -> Peak:
        deviations = [
            (np.log(clearance / 1e-3) - 0.1 * level) ** 2 + (mass / 0.06 - 1.0) ** 2 + 0.1 * (body - 2) ** 2
            for body, mass, clearance in zip(choice.bodies, choice.masses, choice.clearances, strict=True)
            for level in self.levels
        ]
        return Peak(float(1.0 + max(deviations)), 10.0, max(self.levels), 1, 1.0, 0.0)


@dataclass(frozen=True)
class TwoLevels(Objective):
    """Objective whose worst peak, at the first level, is constant; at the second level, 2 mm is the best clearance."""

    def worst(self, choice: Choice) -> Peak:
        deviation = np.log(choice.clearances[0] / 2e-3) ** 2
        return max(
            Peak(2.0 / choice.mass if level == 1.0 else 0.5 + 0.1 * deviation, 10.0, level, 1, 1.0, 0.0)
            for level in self.levels
        )


def search_in_this_process(objective: Objective, space: SearchSpace) -> tuple[Trial, list[Trial]]:
    """Return the best trial and all trials."""
    return search(objective, space, Evaluator(ShuffledWorkers(0), None, None, 1))  # type: ignore[arg-type]


def test_equal_worst_peaks_are_ranked_by_next_level() -> None:
    objective = TwoLevels((rig.load("fig9"),), (1.0, 2.0), (40.0, 60.0), (1,))
    best, _ = search_in_this_process(objective, SearchSpace(((1,),), 0.1, (1e-4, 1e-2)))
    assert best.choice.clearances[0] == pytest.approx(2e-3, rel=0.1)


@dataclass(frozen=True)
class SingleBody(Objective):
    """Objective where only the damper in body 2 has an effect, which is largest for the whole mass and 1 mm."""

    def worst(self, choice: Choice) -> Peak:
        dampers = zip(choice.bodies, choice.masses, choice.clearances, strict=True)
        deviations = [
            (mass / 0.1 - 1.0) ** 2 + 0.1 * np.log(clearance / 1e-3) ** 2
            for body, mass, clearance in dampers
            if body == 2
        ]
        return Peak(float(1.0 + min(deviations, default=9.0)), 10.0, max(self.levels), 1, 1.0, 0.0)


def test_second_damper_without_effect_is_not_chosen() -> None:
    objective = SingleBody((rig.load("fig9"),), (1.0,), (40.0, 60.0), (1,))
    best, _ = search_in_this_process(objective, SearchSpace(((1, 2),), 0.1, (1e-4, 1e-2)))
    assert best.choice.bodies == (2,) and best.choice.masses == pytest.approx((0.1,))
    # The peak is nearly constant around the optimal clearance.
    assert best.choice.clearances[0] == pytest.approx(1e-3, rel=0.5)


def test_search_finds_the_best_number_of_dampers() -> None:
    objective = SingleBody((rig.load("fig9"),), (1.0,), (40.0, 60.0), (1,))
    _, trials = search_in_this_process(objective, SearchSpace(SearchSpace.locations_of((1, 2), 2), 0.1, (1e-4, 1e-2)))
    for trial in pareto_front(trials):
        single_damper = Choice((2,), (trial.choice.mass,), (1e-3,))
        assert trial.peak.magnitude <= 1.005 * objective.worst(single_damper).magnitude


def test_dampers_without_a_ceiling_are_tried() -> None:
    objective = HighCeiling((rig.load("fig9"),), (1.0,), (40.0, 60.0), (1,))
    best, trials = search_in_this_process(objective, SearchSpace(((1,),), 0.1, (1e-4, 1e-2)))
    assert best.choice == Choice((1,), (0.1,), (np.inf,))
    assert sum(not trial.choice.has_ceiling for trial in trials) == 3


@dataclass(frozen=True)
class HighCeiling(Objective):
    """Objective where a higher ceiling is always better."""

    def worst(self, choice: Choice) -> Peak:
        return Peak(1.0 / choice.mass + 1e-3 / choice.clearances[0], 10.0, max(self.levels), 1, 1.0, 0.0)


class ShuffledWorkers:
    """Workers in this process that compute in a random order, and fail after `max_tasks` results, as if killed."""

    def __init__(self, seed: int, max_tasks: float = np.inf) -> None:
        self.random, self.tasks_left = np.random.default_rng(seed), max_tasks

    def compute(self, function: Callable[[Any], Any], pieces: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        completed: set[int] = set()
        while remaining := sorted(set(range(len(pieces))) - completed):
            if self.tasks_left == 0:
                raise RunError("killed")
            self.tasks_left -= 1
            number = int(self.random.choice(remaining))
            completed.add(number)
            yield number, function(pieces[number])


@pytest.mark.parametrize(("dampers", "seed", "max_tasks"), [(1, 1, 30), (1, 2, 120), (2, 3, 300)])
def test_killed_search_continues_with_identical_results(dampers, seed, max_tasks, tmp_path):
    objective = QuadraticOptimum((rig.load("fig9"),), (1.0, 2.0), (40.0, 60.0), (1,))
    space = SearchSpace(SearchSpace.locations_of((1, 2, 3), dampers), 0.1, (1e-4, 1e-2))

    def search_with(workers: Any, table: Path) -> tuple[Trial, list[Trial]]:
        evaluator = Evaluator(workers, table, None, 1)
        result = search(objective, space, evaluator)
        evaluator.sort()
        return result

    uninterrupted_table, resumed_table = tmp_path / "one.csv", tmp_path / "other.csv"
    expected = search_with(ShuffledWorkers(0), uninterrupted_table)
    with pytest.raises(RunError, match="killed"):
        search_with(ShuffledWorkers(seed, max_tasks), resumed_table)
    assert search_with(ShuffledWorkers(seed + 1), resumed_table) == expected
    assert resumed_table.read_bytes() == uninterrupted_table.read_bytes()


def test_other_file_remains_until_its_replacement_is_complete(tmp_path: Path) -> None:
    objective = QuadraticOptimum((rig.load("fig9"),), (1.0,), (40.0, 60.0), (1,))
    choices = [Choice((1,), (mass,), (1e-3,)) for mass in (0.03, 0.06)]
    table = tmp_path / "table.csv"
    table.write_bytes(b"mine")
    with pytest.raises(RunError, match="exists"):
        Evaluator(ShuffledWorkers(0), table, None, 1)  # type: ignore[arg-type]
    with allow_overwriting(True):
        killed = Evaluator(ShuffledWorkers(0, 1), table, None, 1)  # type: ignore[arg-type]
        with pytest.raises(RunError, match="killed"):
            killed.compute(objective, choices)
        assert table.read_bytes() == b"mine"
        resumed = Evaluator(ShuffledWorkers(0, 1), table, None, 1)  # type: ignore[arg-type]
        resumed.compute(objective, choices)
        resumed.sort()
    assert len(table.read_text(encoding="utf-8").splitlines()) == 3
    assert [file.name for file in tmp_path.iterdir()] == ["table.csv"]


def test_trials_of_larger_mass_are_not_reused(tmp_path: Path) -> None:
    objective = QuadraticOptimum((rig.load("fig9"),), (1.0, 2.0), (40.0, 60.0), (1,))
    for mass in (0.06, 0.03):
        evaluator = Evaluator(ShuffledWorkers(0), tmp_path / "table.csv", None, 1)  # type: ignore[arg-type]
        best, trials = search(objective, SearchSpace(((1,), (2,)), mass, (1e-4, 1e-2)), evaluator)
        assert best.choice.mass == pytest.approx(mass)
        assert max(trial.choice.mass for trial in trials) <= mass * (1 + 1e-12)


@given(
    bodies=st.lists(st.integers(1, 3), min_size=1, max_size=3).map(sorted).map(tuple),
    start=st.integers(0, 9),
    step=st.floats(0.1, 0.9),
)
def test_tried_clearances_are_allowed_and_distinct(bodies: tuple[int, ...], start: int, step: float) -> None:
    # The search computes a row of clearances at fixed ratios, then optimizes their common factor from a point of it.
    def check_choice(choice: Choice) -> float:
        assert min(choice.clearances) >= 1e-4 and max(choice.clearances) <= 1e-2 * (1 + 1e-12)
        body_clearances = [*zip(choice.bodies, choice.clearances, strict=True)]
        assert len(set(body_clearances)) == len(body_clearances) and choice.mass == pytest.approx(0.1)
        return sum(choice.clearances)

    row = _grid_row(SearchSpace((bodies,), 0.1, (1e-4, 1e-2), allows_no_ceiling=False), bodies, 1.0)
    for choice in row:
        check_choice(choice)
    _optimize_common_factor(row[start], check_choice, step, (1e-4, 1e-2))
