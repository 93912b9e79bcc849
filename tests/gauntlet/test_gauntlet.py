"""One random scene of each kind of test; `make gauntlet` runs hundreds."""

from __future__ import annotations

import pytest

from tests.gauntlet.scenes import KINDS
from tests.gauntlet.trial import run_trial

SEED = 5
# Numbers of scenes whose answers are compared with the truth, not refused, and take a few seconds at most.
NUMBERS = {
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
    "tone_landings": 0,
    "steps_landings": 6,
    "curves_pairs": 0,
    "multisine_pairs": 2,
    "stepped_sine_pairs": 0,
    "random_shakers": 0,
    "multisine_shakers": 0,
}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_random_scene_gives_right_answers(kind: str) -> None:
    verdicts = run_trial(SEED, NUMBERS[kind], kind)
    assert verdicts
    assert {verdict.outcome for verdict in verdicts} == {"right"}
