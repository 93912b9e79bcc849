"""The analysis is correct for one random scene of each kind of test; `make gauntlet` draws hundreds of scenes."""

import pytest

from tests.gauntlet.controlled_tones import FOLDS
from tests.gauntlet.scenes import KINDS
from tests.gauntlet.trial import run_trial

SEED = 5
# Numbers of scenes that take a few seconds at most, with all results compared and none refused.
SCENE_NUMBERS = {
    "random": 1,
    "burst_random": 6,
    "multisine": 0,
    "impulse": 1,
    "stepped_sine": 8,
    "imported_stepped_sine": 14,
    "swept_sine": 0,
    "stepped_sine_dampers": 0,
    "multisine_dampers": 2,
    "swept_sine_dampers": 1,
    "tone_dampers": 0,
    "steps_dampers": 0,
    "decay_dampers": 0,
    "decay_linear": 3,
    "stepped_sine_joints": 3,
    "tone_finite_contact": 0,
    "steps_finite_contact": 6,
    "curves_close_modes": 0,
    "multisine_close_modes": 2,
    "stepped_sine_close_modes": 0,
    "two_shakers_close_modes": 0,
    "random_two_shakers": 23,
    "multisine_two_shakers": 0,
    "constant_response": 0,
    "phase_resonance": 0,
    "continuation": 0,
    "constant_response_dampers": 1,
    "phase_resonance_dampers": 0,
    "continuation_dampers": 1,
    "sine_control": 1,
    "random_control": 1,
}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != FOLDS])
def test_results_of_random_scene_are_correct(kind: str) -> None:
    results = run_trial(SEED, SCENE_NUMBERS[kind], kind)
    assert results
    assert {result.outcome for result in results} == {"correct"}


@pytest.mark.thorough
def test_folds_between_corners_are_measured() -> None:
    results = run_trial(SEED, 1, FOLDS)
    assert {result.outcome for result in results} == {"correct"}
    assert any(result.note.startswith("3 folds") for result in results)


@pytest.mark.thorough
def test_folds_behind_irregular_motion_have_a_named_reason() -> None:
    # Up to a fifth of the band, no motion of this scene is periodic.
    results = {result.check: result for result in run_trial(SEED, 9, FOLDS)}
    assert results["folds"].outcome == "warned"
    assert "missed" in results["folds"].note and "the motion is irregular" in results["folds"].note


@pytest.mark.thorough
def test_chaotic_motions_next_to_corner_are_omitted() -> None:
    # Three points at 66.2 Hz were up to 2.1 % from the orbits: their envelopes were constant within 0.5 %.
    assert {result.outcome for result in run_trial(SEED, 17, FOLDS)} == {"correct"}
