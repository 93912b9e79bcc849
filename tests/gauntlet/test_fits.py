"""A fit to one random scene; `make fits` draws dozens."""

import pytest

from tests.gauntlet.fits import Trial, draw_scene, run_trial

SEED, NUMBER = 1, 23  # a scene with one damper, whose mass ratio is determined


@pytest.fixture(scope="module")
def trial() -> Trial:
    return run_trial(SEED, NUMBER)


@pytest.mark.thorough
def test_determined_values_of_random_scene_are_correct(trial: Trial) -> None:
    determined = [value for value in trial.values if value.status == "determined"]
    assert len(draw_scene(SEED, NUMBER).dampers) == 1
    assert {"frequency", "mass_ratio", "clearance"} <= {value.name for value in determined}
    assert sum(abs(value.error) <= value.bound for value in determined) >= 0.9 * len(determined)
    assert max(abs(value.error) for value in determined) < 0.02


@pytest.mark.thorough
def test_masses_are_as_uncertain_as_the_force_sensor(trial: Trial) -> None:
    # A common factor of masses, springs and force changes no motion, and gravity calibrates the accelerometers.
    channels = draw_scene(SEED, NUMBER).channels
    tolerance = next(channel.hammer.sensitivity_tolerance for channel in channels if channel.hammer is not None)
    assert tolerance is not None
    bounds = [value.bound for value in trial.values if value.name in ("masses", "springs")]
    # The tolerance is a limit of error, to which the other uncertainties add little.
    assert bounds and all(tolerance <= bound < 1.05 * tolerance for bound in bounds)
