"""The dampers that a design chooses are as good as any, do what is promised on the rig, and are found again."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import analysis
import daq
import rig
from rig.damper_design.answers import Answers
from rig.damper_design.asked import asked, mass_of
from rig.damper_design.check import check, expected
from rig.damper_design.choice import FINE, Choice, Question, Space, Trial
from rig.damper_design.design import chart_levels
from rig.damper_design.figure import _clearance_label, next_step, summary, write
from rig.damper_design.landings import INSTANT, landings_of
from rig.damper_design.ranking import front, ranked
from rig.damper_design.search import _refine, _row, search
from rig.damper_design.worst_peak import Peak, curve
from rig.errors import RunError, SceneError
from rig.orbits.problem import OrbitProblem
from rig.scene.excitation import SteppedSine
from rig.system.open_loop_drive import with_ideal_force
from rig.system.receptance import receptance
from rig.workers import Workers


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("design") / "table.csv"


@pytest.fixture(scope="module")
def chosen(table: Path) -> rig.Design:
    return rig.design("fig9", bodies=[2], levels=[3.3], watched=[2], table=table)


@pytest.mark.thorough
def test_given_one_place_when_designed_then_no_clearance_of_a_fine_grid_is_a_percent_better(
    chosen: rig.Design,
) -> None:
    question = replace(chosen.question, density=FINE)
    clearances = np.geomspace(0.5, 2.0, 25) * chosen.best.choice.clearances[0]
    others = [question.worst(replace(chosen.best.choice, clearances=(c,))).size for c in clearances]
    assert chosen.best.peak.size < 1.01 * min(others)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*no steady state:daq.RunWarning")
def test_given_a_design_when_its_scene_is_recorded_and_analysed_then_steady_motion_is_as_predicted(
    chosen: rig.Design, tmp_path: Path
) -> None:
    daq.record(chosen.scene, tmp_path / "check.mcap")
    with daq.open(tmp_path / "check.mcap") as recording:
        measured = analysis.compliance(recording, "body2")
    problem = OrbitProblem(with_ideal_force(chosen.scene.replace(channels=None)))
    predicted = curve(problem, chosen.best.peak.level, measured.frequency).compliance[1]
    assert measured.unsteady is not None and measured.unsteady.mean() < 0.3
    decibels = 20 * np.log10(np.abs(measured.value / predicted))[~measured.unsteady]
    assert np.abs(decibels).max() < 0.3
    for one in chosen.expected:
        if one.sizes is not None:
            at_peak = int(np.argmin(abs(measured.frequency - one.peak.frequency)))
            size, bound = abs(measured.value[at_peak]), measured.bound()[at_peak]
            assert one.sizes[0] - bound < size < one.sizes[2] + bound


@pytest.mark.thorough
def test_given_the_table_of_a_search_when_designed_again_then_the_same_is_found_and_nothing_computed(
    chosen: rig.Design, table: Path
) -> None:
    written = table.read_bytes()
    # As a kill may leave it.
    table.write_bytes(written + b"3dfa,2,0.1")
    again = rig.design("fig9", bodies=[2], levels=[3.3], watched=[2], table=table)
    assert again.best == chosen.best and again.chart == chosen.chart
    assert again.trials == chosen.trials and table.read_bytes() == written


@pytest.mark.thorough
def test_given_a_design_when_written_then_its_scene_loads_and_its_summary_says_the_choice(
    chosen: rig.Design, tmp_path: Path
) -> None:
    scene, picture, drawing = write(chosen, tmp_path)
    assert rig.load(str(scene)).dampers == chosen.scene.dampers
    assert picture.stat().st_size > 10_000 and drawing.stat().st_size > 10_000
    assert repr(chosen).startswith("<Design: ") and chosen.plot().get_legend() is not None
    assert f"clearance {1e3 * chosen.best.choice.clearances[0]:.3g} mm" in summary(chosen)
    commands = [shlex.split(line) for line in next_step(chosen, scene).splitlines() if line.startswith("daq")]
    assert [each[:3] for each in commands] == [["daq", "record", str(scene)]] * 2
    assert "dampers=null" in commands[0] and "dampers=null" not in commands[1]
    unsteady = replace(chosen, expected=tuple(replace(one, sizes=None) for one in chosen.expected))
    assert "no steady motion found" in next_step(unsteady, scene)


@pytest.mark.thorough
def test_given_one_level_or_several_when_told_then_every_level_has_its_column(chosen: rig.Design) -> None:
    two = replace(chosen.question, levels=(3.3, 6.6))
    trials = tuple(replace(each, peaks=(each.peak, replace(each.peak, size=1e-5))) for each in chosen.trials)
    told = summary(replace(chosen, question=two, trials=trials, best=trials[0])).splitlines()
    heading = next(line for line in told if "added mass" in line)
    assert heading.split()[3:7] == ["3.3", "N", "6.6", "N"]


def test_given_a_table_that_a_kill_left_torn_when_gone_on_with_then_no_answer_is_lost(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    question, _ = asked(rig.load("fig9"), None, [2], 1, None, [0.5], (49.0, 50.0), [2], (0.0, 0.0))
    choices = [Choice((2,), (0.05,), (clearance,)) for clearance in (1e-3, 2e-3)]
    with Workers() as workers:
        first = Answers(workers, table, None, 1).of(question, choices[:1])
        with table.open("a") as file:
            # What open quotes hold is no longer than their line, and no line too long to be read.
            file.write('"' + "x" * 200_000 + "\n" + '"torn,2,0.1')
        second = Answers(workers, table, None, 1).of(question, choices[1:])
        read = Answers(workers, table, None, 1)
    assert [read.trial(question, choice) for choice in choices] == first + second


@dataclass(frozen=True)
class Bowl(Question):
    """Answers at once: the best damper is one of 60 g in body 2 with 1 mm, or the like of two."""

    def worst(self, choice: Choice) -> Peak:
        away = [
            (np.log(c / 1e-3) - 0.1 * level) ** 2 + (m / 0.06 - 1.0) ** 2 + 0.1 * (b - 2) ** 2
            for b, m, c in zip(choice.bodies, choice.masses, choice.clearances, strict=True)
            for level in self.levels
        ]
        return Peak(float(1.0 + max(away)), 10.0, max(self.levels), 1, 1.0, 0.0)


@dataclass(frozen=True)
class Flat(Question):
    """Answers at once: the first level has the worst peak whatever the clearance, the second likes one of 2 mm best."""

    def worst(self, choice: Choice) -> Peak:
        away = np.log(choice.clearances[0] / 2e-3) ** 2
        return max(
            Peak(2.0 / choice.mass if level == 1.0 else 0.5 + 0.1 * away, 10.0, level, 1, 1.0, 0.0)
            for level in self.levels
        )


def test_given_a_worst_level_that_any_clearance_suits_when_searched_then_the_other_level_decides() -> None:
    question = Flat((rig.load("fig9"),), (1.0, 2.0), (40.0, 60.0), (1,))
    answers = Answers(Shuffled(0), None, None, 1)  # type: ignore[arg-type]
    best, _ = search(question, Space(((1,),), 0.1, (1e-4, 1e-2)), answers)
    assert best.choice.clearances[0] == pytest.approx(2e-3, rel=0.1)


@dataclass(frozen=True)
class Lone(Question):
    """Answers at once: only the damper in body 2 does anything, best with all mass and 1 mm."""

    def worst(self, choice: Choice) -> Peak:
        each = zip(choice.bodies, choice.masses, choice.clearances, strict=True)
        away = [(m / 0.1 - 1.0) ** 2 + 0.1 * np.log(c / 1e-3) ** 2 for b, m, c in each if b == 2]
        return Peak(float(1.0 + min(away, default=9.0)), 10.0, max(self.levels), 1, 1.0, 0.0)


def test_given_two_dampers_of_which_one_does_as_well_when_searched_then_the_one_is_named() -> None:
    question = Lone((rig.load("fig9"),), (1.0,), (40.0, 60.0), (1,))
    answers = Answers(Shuffled(0), None, None, 1)  # type: ignore[arg-type]
    best, _ = search(question, Space(((1, 2),), 0.1, (1e-4, 1e-2)), answers)
    assert best.choice.bodies == (2,) and best.choice.masses == pytest.approx((0.1,))
    assert best.choice.clearances[0] == pytest.approx(1e-3, rel=0.5)


@pytest.mark.parametrize(("irregular", "bodies"), [(0.0, (1, 2)), (0.3, (2,))])
def test_given_one_damper_a_percent_behind_two_when_ranked_then_it_is_first_only_if_motion_is_irregular(
    irregular: float, bodies: tuple[int, ...]
) -> None:
    def trial(size: float, *choice: Any) -> Trial:
        return Trial(Choice(*choice), (Peak(size, 10.0, 1.0, 1, 1.0, irregular),))

    two = trial(1.0, (1, 2), (0.001, 0.099), (1e-3, 1e-3))
    one = trial(1.01, (2,), (0.1,), (1e-3,))
    far = trial(1.05, (1,), (0.1,), (1e-3,))
    order = ranked([two, far, one])
    assert order[0].choice.bodies == bodies and len(order) == 3 and order[-1] == far


def test_given_two_dampers_when_drawn_then_the_clearance_is_that_of_the_heavier() -> None:
    assert "in body 4 / mm" in _clearance_label(Choice((3, 4), (0.01, 0.06), (8e-3, 7e-3)))


LASTING = {"contact": {"duration": "4 ms"}, "restitution": 0.2}


def with_dampers(*each: dict[str, Any]) -> rig.Scene:
    return rig.load(
        "fig9", {"dampers": [{"body": 2, "mass": "50 g", "clearance": "1 mm"} | one for one in each]}
    )


def test_given_a_scene_whose_dampers_land_lastingly_when_asked_then_new_ones_land_as_they_do() -> None:
    scene = with_dampers(LASTING, LASTING)
    question, _ = asked(scene, None, [2], 1, None, [3.3], (48.5, 50.5), [2], (0.0, 0.0))
    assert str(question.landings) == "new dampers land in 4 ms, restitution 0.2: as the scene's"
    choice = Choice((2,), (0.1,), (1e-3,))
    peak = question.worst(choice)
    trial = Trial(choice, (peak,))
    checked = check(scene, trial, question)
    assert [(one.restitution, one.contact) for one in checked.dampers] == [(0.2, scene.dampers[0].contact)]
    instant = replace(question, landings=INSTANT)
    assert instant.digest != question.digest and instant.worst(choice).size != pytest.approx(
        peak.size, rel=1e-3
    )


def test_given_dampers_that_land_differently_when_asked_then_the_first_is_taken_and_it_says_so() -> None:
    landings = landings_of(with_dampers(LASTING, {}).dampers)
    assert (landings.restitution, landings.taken) == (0.2, "as the scene's first; others of it differ")
    walls = {"contact": {"floor": {"duration": "4 ms"}, "ceiling": {"duration": "1 ms"}}}
    assert "in 4 ms on floors and 1 ms on ceilings" in str(landings_of(with_dampers(walls).dampers))
    assert landings_of(()) == INSTANT and "at once, restitution 0" in str(INSTANT)


def test_given_contact_by_stiffness_when_asked_then_it_is_refused_as_that_of_one_mass() -> None:
    scene = with_dampers({"contact": {"stiffness": "100 kN/m", "damping": "5 N s/m"}})
    with pytest.raises(SceneError, match=r"dampers\[1\]\.contact: .* expected contact: \{duration"):
        landings_of(scene.dampers)


def test_given_reductions_alike_at_the_worst_level_when_ranked_then_the_mean_of_all_levels_decides() -> None:
    best_at_worst, as_good, poorer = (
        tried(0.1, 1e-3, 2.000, 1.5),
        tried(0.1, 2e-3, 2.010, 1.0),
        tried(0.1, 3e-3, 2.020, 0.1),
    )
    assert ranked([best_at_worst, poorer, as_good]) == [as_good, best_at_worst, poorer]


def test_given_as_good_at_every_level_when_ranked_then_the_middle_of_the_clearances_comes_first() -> None:
    low, middle, tall = (tried(0.1, clearance, 2.0, 1.001) for clearance in (1e-3, 3e-3, 1e-2))
    wider = tried(0.1, 3e-2, 2.0, 1.2)
    assert ranked([wider, tall, low, middle])[0] == middle and ranked([wider, middle])[1] == wider


@given(levels=st.lists(st.floats(0.1, 50.0), min_size=1, max_size=5, unique=True).map(sorted))
def test_given_any_levels_when_charted_then_they_are_among_others_that_are_no_farther_apart_than_told(
    levels: list[float],
) -> None:
    charted = chart_levels(levels)
    assert set(levels) <= set(charted.tolist())
    assert charted[0] <= levels[0] / 2 * (1 + 1e-12) and charted[-1] >= levels[-1] * 2 * (1 - 1e-12)
    assert np.all(charted[1:] / charted[:-1] < 2.0**0.76)


def test_given_peaks_at_two_levels_when_a_check_is_made_then_it_has_both_levels_and_all_peaks() -> None:
    scene = rig.load("fig9")
    question, _ = asked(scene, None, None, 1, None, [2.0, 4.0], (30.0, 55.0), None, (0.0, 0.0))
    choice = Choice((2,), (0.1,), (1e-3,))
    peaks = tuple(Peak(1e-4, f, level, 1, 1.0, 0.0) for f, level in ((34.1, 2.0), (48.7, 4.0)))
    test = check(scene, Trial(choice, peaks), question).test
    assert isinstance(test, SteppedSine) and test.frequencies is not None
    assert test.levels == (2.0, 4.0)
    assert {34.1, 48.7, question.bare.frequency} <= set(test.frequencies)
    apart = np.diff(test.frequencies)
    # Two ranges, the upper one about two peaks, each as close as about one peak.
    assert len(test.frequencies) < 70 and np.sum(apart > 0.005 * 48.7) == 1


def test_given_a_table_behind_a_spring_when_expected_then_its_harmonics_and_the_held_force_count() -> None:
    scene = rig.load("fig9", {"shaker": {"kind": "table", "body": 1, "spring": "6.6 kN/m"}})
    question, _ = asked(scene, None, [2], 1, None, [1.5], None, None, (0.0, 0.0))
    choice = Choice((2,), (0.1,), (0.969e-3,))
    peak = question.worst(choice)
    (one,) = expected(check(scene, Trial(choice, (peak,)), question), Trial(choice, (peak,)))
    assert one.sizes is not None
    low, size, high = one.sizes
    assert low < size < high < 1.01 * low
    plain = scene.replace(channels=None, dampers=choice.dampers(INSTANT))
    for force, bound in ((1.5 * 1.005, low), (1.5, size), (1.5 * 0.995, high)):
        there = plain.replace(test={"kind": "sine", "frequency": peak.frequency, "force": force})
        steady = abs(rig.frequency_response(there, [peak.frequency]).compliance[peak.body - 1, 0])
        assert bound == pytest.approx(steady, rel=1.1e-3)


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
def test_given_workers_that_answer_in_any_order_and_are_killed_when_searched_on_then_all_is_as_in_order(
    dampers: int, seed: int, until: int, tmp_path: Path
) -> None:
    question = Bowl((rig.load("fig9"),), (1.0, 2.0), (40.0, 60.0), (1,))
    space = Space(Space.places_of((1, 2, 3), dampers), 0.1, (1e-4, 1e-2))

    def searched(workers: Any, table: Path) -> tuple[Trial, list[Trial]]:
        answers = Answers(workers, table, None, 1)
        found = search(question, space, answers)
        answers.put_in_order()
        return found

    one, other = tmp_path / "one.csv", tmp_path / "other.csv"
    in_order = searched(Shuffled(0), one)
    with pytest.raises(RunError, match="killed"):
        searched(Shuffled(seed, until), other)
    assert searched(Shuffled(seed + 1), other) == in_order
    assert other.read_bytes() == one.read_bytes()


def test_given_the_table_of_a_larger_budget_when_searched_then_no_choice_of_it_is_above_the_smaller_one(
    tmp_path: Path,
) -> None:
    question = Bowl((rig.load("fig9"),), (1.0, 2.0), (40.0, 60.0), (1,))
    for mass in (0.06, 0.03):
        answers = Answers(Shuffled(0), tmp_path / "table.csv", None, 1)  # type: ignore[arg-type]
        best, trials = search(question, Space(((1,), (2,)), mass, (1e-4, 1e-2)), answers)
        assert best.choice.mass == pytest.approx(mass)
        assert max(trial.choice.mass for trial in trials) <= mass * (1 + 1e-12)


def test_given_a_test_that_gives_a_drive_when_asked_then_levels_are_forces_on_the_body() -> None:
    drive = {"kind": "stepped_sine", "from": "46 Hz", "to": "54 Hz", "points": 9, "drive": "1 mm"}
    changes = {"shaker": {"kind": "table", "body": 1, "spring": "6.6 kN/m"}, "test": drive}
    driven, told = rig.load("fig9", changes), (None, [2], 1, None, ["3.3 N"], None, None, (0.0, 0.0))
    question, _ = asked(driven, *told)
    choice = Choice((2,), (0.1,), (1e-3,))
    assert question.worst(choice) == asked(rig.load("fig9"), *told)[0].worst(choice)
    with pytest.raises(SceneError, match="levels: not given, and the test of the scene gives a drive"):
        asked(driven, None, None, 1, None, None, None, None, (0.0, 0.0))


def test_given_several_shakers_when_a_check_is_made_then_the_same_one_is_driven() -> None:
    shakers = [{"kind": "force", "body": 1}, {"kind": "force", "body": 3}]
    drive = {"kind": "sine", "frequency": "49 Hz", "force": "3 N", "shaker": 2}
    scene = rig.load("fig9", {"shaker": shakers, "test": drive, "channels": None})
    question, _ = asked(scene, None, None, 1, None, None, (45.0, 55.0), None, (0.0, 0.0))
    trial = Trial(Choice((2,), (0.1,), (1e-3,)), (Peak(1e-4, 48.7, 3.0, 1, 1.0, 0.0),))
    assert check(scene, trial, question).driven == 2


def test_given_no_dampers_when_asked_then_the_worst_peak_is_that_of_the_receptance() -> None:
    question, _ = asked(rig.load("fig9"), None, None, 1, None, None, None, None, (0.0, 0.0))
    fine = np.linspace(49.4, 49.9, 2001)
    exact = np.abs(receptance(rig.load("fig9"), fine)).max()
    assert question.bare.size == pytest.approx(exact, rel=1e-5)


def test_given_uncertain_damping_when_asked_then_the_structure_with_the_least_counts() -> None:
    question, _ = asked(rig.load("fig9"), None, None, 1, None, None, None, None, (0.2, 0.0))
    sure, _ = asked(rig.load("fig9"), None, None, 1, None, None, None, None, (0.0, 0.0))
    assert len(question.scenes) == 3
    assert question.bare.size == pytest.approx(sure.bare.size / 0.8, rel=1e-2)


def tried(mass: float, clearance: float, *sizes: float) -> Trial:
    peaks = [Peak(size, 10.0, float(level), 1, 1.0, 0.0) for level, size in enumerate(sizes, 1)]
    return Trial(Choice((1,), (mass,), (clearance,)), tuple(peaks))


def test_given_trials_when_their_front_is_taken_then_none_as_light_is_better() -> None:
    sizes = [(0.1, 3.0), (0.1, 2.0), (0.2, 2.5), (0.3, 1.0), (0.05, 4.0)]
    trials = [tried(m, 1e-3, size) for m, size in sizes]
    assert [(t.choice.mass, t.peak.size) for t in front(trials)] == [(0.05, 4.0), (0.1, 2.0), (0.3, 1.0)]


def test_given_a_body_named_twice_when_asked_then_it_may_carry_two_and_counts_once() -> None:
    question, space = asked(rig.load("fig9"), None, [2, 1, 2], 2, None, [3.3], None, [2, 2], (0.0, 0.0))
    assert (space.places, question.bodies) == (((1, 2), (2, 2)), (2,))


def test_given_two_dampers_in_a_body_when_asked_then_the_peak_is_that_of_their_settled_motion() -> None:
    question, _ = asked(rig.load("fig9"), None, None, 1, None, [3.3], (48.5, 50.5), [2], (0.0, 0.0))
    choice = Choice((2, 2), (0.06, 0.04), (1e-3, 1.1e-3))
    peak = question.worst(choice)
    scene = question.scenes[0].replace(dampers=choice.dampers(INSTANT))
    settled = np.abs(rig.frequency_response(scene, np.linspace(48.5, 50.5, 31)).compliance[1])
    assert peak.size == pytest.approx(settled.max(), rel=0.01)


@given(
    place=st.lists(st.integers(1, 3), min_size=1, max_size=3).map(sorted).map(tuple),
    start=st.integers(0, 9),
    step=st.floats(0.1, 0.9),
)
def test_given_any_place_when_tried_then_clearances_are_allowed_and_no_two_of_a_body_are_equal(
    place: tuple[int, ...], start: int, step: float
) -> None:
    def seen(choice: Choice) -> float:
        assert min(choice.clearances) >= 1e-4 and max(choice.clearances) <= 1e-2 * (1 + 1e-12)
        each = [*zip(choice.bodies, choice.clearances, strict=True)]
        assert len(set(each)) == len(each) and choice.mass == pytest.approx(0.1)
        return sum(choice.clearances)

    row = _row(Space((place,), 0.1, (1e-4, 1e-2)), place, 1.0)
    for choice in row:
        seen(choice)
    _refine(row[start], seen, step, (1e-4, 1e-2))


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"budget": 5.0}, "expected more than nothing and less than the structure's 2.09 kg"),
        ({"bodies": [7]}, "numbers of bodies, from 1 to 3"),
        ({"dampers": 4}, "expected 1 to 3, one for each body .* named twice"),
        ({"band": (2.0, 3.0)}, "nothing resonates"),
        ({"levels": [-1.0]}, r"levels: got -1\.0; expected a list of positive"),
        ({"clearance": (2e-3, 1e-3)}, "the smaller one first"),
        ({"uncertain": (2.0, 0.0)}, "two shares"),
        ({"cluster": "nonsense://"}, "no Dask scheduler answers"),
    ],
)
def test_given_what_makes_no_sense_when_designed_then_it_says_what_was_expected(
    told: dict, message: str
) -> None:
    with pytest.raises(SceneError, match=message):
        rig.design("fig9", **told)


def test_given_quantities_in_words_when_asked_then_they_are_understood() -> None:
    scene = rig.load("fig9")
    question, space = asked(
        scene, "5 %", ["1", "3"], 1, ["1 mm", 2e-3], ["3 N", "1 N"], None, None, ["20 %", 0.0]
    )
    assert space.mass == pytest.approx(0.1045) and mass_of("50 g", scene) == pytest.approx(0.05)
    assert (space.places, space.clearance, question.levels) == (((1,), (3,)), (1e-3, 2e-3), (1.0, 3.0))
    with pytest.raises(SceneError, match="band: got 40 Hz; expected two"):
        asked(scene, None, None, 1, None, None, ["40 Hz"], None, (0.0, 0.0))
