"""The search over choices returns the best in any order of evaluation, and one damper where one suffices."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rig
from rig.damper_design.answers import Answers
from rig.damper_design.choice import Choice, Question, Space, Trial
from rig.damper_design.ranking import pareto_front
from rig.damper_design.search import _grid_row, _refine, search
from rig.damper_design.worst_peak import Peak
from rig.errors import RunError


@dataclass(frozen=True)
class Bowl(Question):
    """Question with a quadratic peak: smallest for dampers of 60 g in body 2 with a clearance of 1 mm."""

    def worst(self, choice: Choice) -> Peak:
        away = [
            (np.log(c / 1e-3) - 0.1 * level) ** 2 + (m / 0.06 - 1.0) ** 2 + 0.1 * (b - 2) ** 2
            for b, m, c in zip(choice.bodies, choice.masses, choice.clearances, strict=True)
            for level in self.levels
        ]
        return Peak(float(1.0 + max(away)), 10.0, max(self.levels), 1, 1.0, 0.0)


@dataclass(frozen=True)
class Flat(Question):
    """Question whose worst peak, at the first level, is constant; at the second level, 2 mm is the best clearance."""

    def worst(self, choice: Choice) -> Peak:
        away = np.log(choice.clearances[0] / 2e-3) ** 2
        return max(
            Peak(2.0 / choice.mass if level == 1.0 else 0.5 + 0.1 * away, 10.0, level, 1, 1.0, 0.0)
            for level in self.levels
        )


def search_at_once(question: Question, space: Space) -> tuple[Trial, list[Trial]]:
    return search(question, space, Answers(Shuffled(0), None, None, 1))  # type: ignore[arg-type]


def test_second_level_decides_where_worst_is_indifferent() -> None:
    question = Flat((rig.load("fig9"),), (1.0, 2.0), (40.0, 60.0), (1,))
    best, _ = search_at_once(question, Space(((1,),), 0.1, (1e-4, 1e-2)))
    assert best.choice.clearances[0] == pytest.approx(2e-3, rel=0.1)


@dataclass(frozen=True)
class Lone(Question):
    """Answers at once: only the damper in body 2 does anything, best with all mass and 1 mm."""

    def worst(self, choice: Choice) -> Peak:
        each = zip(choice.bodies, choice.masses, choice.clearances, strict=True)
        away = [(m / 0.1 - 1.0) ** 2 + 0.1 * np.log(c / 1e-3) ** 2 for b, m, c in each if b == 2]
        return Peak(float(1.0 + min(away, default=9.0)), 10.0, max(self.levels), 1, 1.0, 0.0)


def test_equal_single_damper_is_named() -> None:
    question = Lone((rig.load("fig9"),), (1.0,), (40.0, 60.0), (1,))
    best, _ = search_at_once(question, Space(((1, 2),), 0.1, (1e-4, 1e-2)))
    assert best.choice.bodies == (2,) and best.choice.masses == pytest.approx((0.1,))
    assert best.choice.clearances[0] == pytest.approx(1e-3, rel=0.5)


def test_search_finds_the_best_number_of_dampers() -> None:
    question = Lone((rig.load("fig9"),), (1.0,), (40.0, 60.0), (1,))
    _, trials = search_at_once(question, Space(Space.locations_of((1, 2), 2), 0.1, (1e-4, 1e-2)))
    for row in pareto_front(trials):
        alone = Choice((2,), (row.choice.mass,), (1e-3,))
        assert row.peak.size <= 1.005 * question.worst(alone).size


def test_dampers_without_a_ceiling_are_tried() -> None:
    question = Tall((rig.load("fig9"),), (1.0,), (40.0, 60.0), (1,))
    best, trials = search_at_once(question, Space(((1,),), 0.1, (1e-4, 1e-2)))
    assert best.choice == Choice((1,), (0.1,), (np.inf,))
    assert sum(not trial.choice.has_ceiling for trial in trials) == 3


@dataclass(frozen=True)
class Tall(Question):
    """Answers at once: the higher the ceiling, the better."""

    def worst(self, choice: Choice) -> Peak:
        return Peak(1.0 / choice.mass + 1e-3 / choice.clearances[0], 10.0, max(self.levels), 1, 1.0, 0.0)


class Shuffled:
    """Workers that answer in a random order, and stop after some pieces as if they were killed."""

    def __init__(self, seed: int, until: float = np.inf) -> None:
        self.dice, self.left = np.random.default_rng(seed), until

    def compute(self, function: Callable[[Any], Any], pieces: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        done: set[int] = set()
        while waiting := sorted(set(range(len(pieces))) - done):
            if self.left == 0:
                raise RunError("killed")
            self.left -= 1
            number = int(self.dice.choice(waiting))
            done.add(number)
            yield number, function(pieces[number])


@pytest.mark.parametrize(("dampers", "seed", "until"), [(1, 1, 30), (1, 2, 120), (2, 3, 300)])
def test_killed_search_continues_in_order(dampers: int, seed: int, until: int, tmp_path: Path) -> None:
    question = Bowl((rig.load("fig9"),), (1.0, 2.0), (40.0, 60.0), (1,))
    space = Space(Space.locations_of((1, 2, 3), dampers), 0.1, (1e-4, 1e-2))

    def searched(workers: Any, table: Path) -> tuple[Trial, list[Trial]]:
        answers = Answers(workers, table, None, 1)
        found = search(question, space, answers)
        answers.sort()
        return found

    one, other = tmp_path / "one.csv", tmp_path / "other.csv"
    in_order = searched(Shuffled(0), one)
    with pytest.raises(RunError, match="killed"):
        searched(Shuffled(seed, until), other)
    assert searched(Shuffled(seed + 1), other) == in_order
    assert other.read_bytes() == one.read_bytes()


def test_larger_budget_table_respects_the_smaller(tmp_path: Path) -> None:
    question = Bowl((rig.load("fig9"),), (1.0, 2.0), (40.0, 60.0), (1,))
    for mass in (0.06, 0.03):
        answers = Answers(Shuffled(0), tmp_path / "table.csv", None, 1)  # type: ignore[arg-type]
        best, trials = search(question, Space(((1,), (2,)), mass, (1e-4, 1e-2)), answers)
        assert best.choice.mass == pytest.approx(mass)
        assert max(trial.choice.mass for trial in trials) <= mass * (1 + 1e-12)


@given(
    place=st.lists(st.integers(1, 3), min_size=1, max_size=3).map(sorted).map(tuple),
    start=st.integers(0, 9),
    step=st.floats(0.1, 0.9),
)
def test_tried_clearances_are_allowed_and_distinct(place: tuple[int, ...], start: int, step: float) -> None:
    def seen(choice: Choice) -> float:
        assert min(choice.clearances) >= 1e-4 and max(choice.clearances) <= 1e-2 * (1 + 1e-12)
        each = [*zip(choice.bodies, choice.clearances, strict=True)]
        assert len(set(each)) == len(each) and choice.mass == pytest.approx(0.1)
        return sum(choice.clearances)

    row = _grid_row(Space((place,), 0.1, (1e-4, 1e-2), without_ceiling=False), place, 1.0)
    for choice in row:
        seen(choice)
    _refine(row[start], seen, step, (1e-4, 1e-2))
