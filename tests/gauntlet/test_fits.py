"""A fit to one random scene; `make fits` draws dozens."""

from __future__ import annotations

import pytest

from tests.gauntlet.fits import draw_scene, run_trial


@pytest.mark.thorough
def test_determined_values_of_random_scene_are_right():
    # A scene with one damper whose mass ratio is determined.
    trial = run_trial(1, 12)
    determined = [value for value in trial.values if value.status == "determined"]
    assert len(draw_scene(1, 12).dampers) == 1
    assert {"frequency", "mass_ratio"} <= {value.name for value in determined}
    assert sum(abs(value.error) <= value.bound for value in determined) >= 0.9 * len(determined)
    assert max(abs(value.error) for value in determined) < 0.02
