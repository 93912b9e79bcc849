"""The interval of clearances with nearly optimal performance, the choice among equal designs, and their flight.

An objective returns the worst peak of a choice of dampers; some tests replace it with closed forms. A trial is a choice
with its peaks. Arguments are positional: Objective(scenes, levels, band, bodies), Peak(compliance, frequency, level,
body, acceleration, irregular share), SearchSpace(locations, largest mass, clearance limits).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import rig
from rig.core.system.structural_model import receptance
from rig.studies.design.choice import Choice, Objective, SearchSpace, Trial
from rig.studies.design.evaluator import Evaluator
from rig.studies.design.flight import Flight, compute_flight, describe_shortfall, ineffective_levels
from rig.studies.design.other_modes import mode_objectives, mode_peaks, select_outside_band
from rig.studies.design.request import parse_request
from rig.studies.design.tolerance import clearance_tolerance
from rig.studies.design.worst_peak import Peak

SPACE = SearchSpace(((1,),), 0.1, (1e-4, 1e-2))


class WorkersInThisProcess:
    """Workers in this process, which also compute pieces added during the computation."""

    def compute(self, function: Callable[[Any], Any], pieces: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        yield from ((number, function(piece)) for number, piece in enumerate(pieces))


@dataclass(frozen=True)
class LowPlateau(Objective):
    """Objective with a low peak from 3.5 to 4.62 mm in the band; outside the band the peak rises with the clearance."""

    def worst(self, choice: Choice) -> Peak:
        clearance = choice.clearances[0]
        compliance = 1.0 if 3.5e-3 <= clearance <= 4.62e-3 else 2.0
        if self.band[1] < 40.0:
            compliance = 1.0 + min(clearance, 1.0)
        return Peak(compliance, 49.0, max(self.levels), 1, 1.0, 0.0)


@dataclass(frozen=True)
class UnreachedCeiling(Objective):
    """Objective whose peak does not depend on clearances above 7 micrometers, because no damper reaches its ceiling."""

    def worst(self, choice: Choice) -> Peak:
        return Peak(2.0 if choice.clearances[0] < 7e-6 else 1.0, 49.0, max(self.levels), 1, 1.0, 0.0)


def _objective(objective_class: type[Objective]) -> Objective:
    return objective_class((rig.load("fig9"),), (1.0,), (40.0, 60.0), (1,))


def _evaluator() -> Evaluator:
    return Evaluator(WorkersInThisProcess(), None, None, 1)  # type: ignore[arg-type]


def _trial(objective: Objective, clearance: float) -> Trial:
    choice = Choice((1,), (0.1,), (clearance,))
    return Trial(choice, (objective.worst(choice),))


def test_tolerance_has_both_ends_of_a_plateau() -> None:
    objective = _objective(LowPlateau)
    trials = [_trial(objective, clearance) for clearance in np.geomspace(1e-4, 1e-2, 10)]
    result = clearance_tolerance(objective, SPACE, _trial(objective, 4.6e-3), trials, _evaluator())
    assert result.low == pytest.approx(3.5e-3, rel=0.06) and result.high == pytest.approx(4.62e-3, rel=0.06)
    assert not any(result.at_limit) and "Build to the middle" in str(result)


@pytest.mark.parametrize("clearance", [1e-3, np.inf])
def test_tolerance_is_open_if_no_ceiling_is_reached(clearance: float) -> None:
    objective = _objective(UnreachedCeiling)
    space = SearchSpace(((1,),), 0.1, (1e-6, 1e-2))
    result = clearance_tolerance(objective, space, _trial(objective, clearance), [], _evaluator())
    assert result.low == pytest.approx(7e-6, rel=0.06) and np.isinf(result.high)
    assert "for every clearance above" in str(result)


def test_modes_outside_the_band_decide_between_equals() -> None:
    objective = _objective(LowPlateau)
    trials = [_trial(objective, clearance) for clearance in (3.6e-3, 4e-3, 4.6e-3)]
    # In the band the peaks are equal; outside the band they differ.
    best_trial = select_outside_band(_objective(SteepOutsideBand), trials, trials[-1], _evaluator())
    assert best_trial.choice.clearances == (3.6e-3,)


@dataclass(frozen=True)
class SteepOutsideBand(LowPlateau):
    """Objective like `LowPlateau`, with a steep rise of the peak outside the band."""

    def worst(self, choice: Choice) -> Peak:
        peak = super().worst(choice)
        if self.band[1] >= 40.0:
            return peak
        return Peak(choice.clearances[0], 30.0, peak.level, 1, 1.0, 0.0)


def test_modes_inside_and_outside_the_band_are_listed() -> None:
    objective, _ = parse_request(rig.load("fig9"), bodies=[2], levels=[0.01], band=(46.0, 54.0))
    choice = Choice((2,), (1e-6,), (1e-3,))
    trial = Trial(choice, (objective.worst(choice),))
    modes = mode_peaks(objective, trial, _evaluator())
    assert [mode.in_band for mode in modes] == [False, False, True]
    assert [frequency for frequency, _ in mode_objectives(objective)] == [mode.frequency for mode in modes]
    for mode in modes:
        # The damper is too light and too weakly driven to have an effect.
        assert mode.damped[0].magnitude == pytest.approx(mode.undamped.magnitude, rel=1e-3)


def test_largest_peak_of_modes_is_the_worst_peak() -> None:
    objective, _ = parse_request(rig.load("fig9"), bodies=[2], levels=[0.01], band=(30.0, 54.0))
    choice = Choice((2,), (1e-6,), (1e-3,))
    worst = objective.worst(choice)
    # Irregular motion has other averages in other evaluations.
    trial = Trial(choice, (replace(worst, magnitude=1.01 * worst.magnitude),))
    modes = mode_peaks(objective, trial, _evaluator())
    assert max(mode.damped[0].magnitude for mode in modes if mode.in_band) == trial.peak.magnitude


def test_flight_height_equals_the_simulated_motion() -> None:
    objective, _ = parse_request(rig.load("fig9"), bodies=[2], levels=[0.25], band=(47.0, 52.0))
    choice = Choice((2,), (0.04,), (np.inf,))
    trial = Trial(choice, (objective.worst(choice),))
    result = compute_flight(objective, trial, is_ceiling_unreached=True)
    assert result.body == 2 and 1.0 < result.acceleration_g(0.25) < 3.0
    scene = objective.scenes[0].replace(dampers=choice.dampers(objective.impact_law))
    scene = scene.replace(test=scene.test.replace(force=0.25))
    frequency = trial.peak.frequency
    motion = rig.simulate(scene, 600.0 / frequency, rate=64.0 * frequency, frequency=frequency)
    simulated_height = motion.gap[0, -640:].max()  # over the last 10 periods, m
    # The result is the largest height in the band, at least the height at the peak.
    assert 0.9 * simulated_height < result.height < 5.0 * simulated_height


def test_take_off_includes_the_mass_of_all_dampers() -> None:
    objective, _ = parse_request(rig.load("fig9"), bodies=[1, 2, 3], dampers=3, levels=[0.25], band=(28.0, 40.0))
    # Each mass is about 30 % of its body's mass.
    choice = Choice((1, 2, 3), (0.2, 0.2, 0.2), (1e-3,) * 3)
    peak = Peak(1e-4, 34.0, 0.25, 1, 1.0, 0.0)
    flight = compute_flight(objective, Trial(choice, (peak,)), is_ceiling_unreached=False)
    scene, frequency = (
        objective.scenes[0].replace(dampers=choice.dampers(objective.impact_law)),
        np.linspace(28, 40, 2001),
    )
    acceleration = (2 * np.pi * frequency) ** 2 * abs(receptance(scene, frequency, riding=(1, 2, 3)))
    take_off = scene.gravity / acceleration.max(axis=1)
    assert flight.body == 1 + take_off.argmin() and flight.take_off == pytest.approx(take_off.min(), rel=1e-2)


def test_levels_below_take_off_are_reported() -> None:
    # The dampers take off at 0.8 N. At 0.5 N they do not reduce the peak without dampers, at 4 N they halve it.
    bare = Peak(1e-4, 62.0, 0.5, 2, 1.0, 0.0)
    peaks = tuple(Peak(compliance, 61.0, level, 2, 1.0, 0.0) for compliance, level in ((1.01e-4, 0.5), (5e-5, 4.0)))
    trial = Trial(Choice((1,), (0.1,), (1e-3,)), peaks)
    charted = {level: Peak(compliance, 61.0, level, 2, 1.0, 0.0) for level, compliance in ((1.0, 9.5e-5), (1.41, 8e-5))}
    lines = describe_shortfall(trial, bare, Flight(0.8, 1, np.nan), charted, [trial], "N")
    assert "at 0.5 N the dampers cannot fly" in lines[0] and "body 1 reaches 0.625 g" in lines[0]
    assert lines[1].endswith("Give `levels` 4N.")
    weak_trial = Trial(trial.choice, peaks[:1])
    lines = describe_shortfall(weak_trial, bare, Flight(0.8, 1, np.nan), charted, [weak_trial], "N")
    assert "at levels of 1.41 N and more" in lines[1]
    lines = describe_shortfall(weak_trial, bare, Flight(0.4, 1, np.nan), charted, [weak_trial], "N")
    assert "the dampers are not effective" in lines[0] and "1.25 g, above 1 g, at which they take off" in lines[0]
    assert not describe_shortfall(Trial(trial.choice, peaks[1:]), bare, Flight(0.8, 1, np.nan), charted, [], "N")


def test_level_below_take_off_is_ineffective() -> None:
    # Take-off at 1.2 N. At 1 N the mass, at rest on its floor, lowers the peak only by detuning the structure.
    trial = Trial(Choice((1,), (0.3,), (np.inf,)), (Peak(0.9e-4, 61.0, 1.0, 2, 1.0, 0.0),))
    assert ineffective_levels(trial, Peak(1e-4, 62.0, 1.0, 2, 1.0, 0.0), Flight(1.2, 1, 0.0)) == [1.0]
