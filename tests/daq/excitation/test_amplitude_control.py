"""Control of the force amplitude: convergence, caution, and what it does where the force jumps."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from daq.excitation.amplitude_control import AmplitudeControl
from rig.scene.excitation import FORCE_HELD

LEVEL = 2.6


def approach(force: Callable[[float], float], drive: float, steps: int = 30) -> list[float]:
    """Drives until the level is held."""
    control = AmplitudeControl(LEVEL)
    drives = [drive]
    while len(drives) < steps and not control.holds(force(drives[-1])):
        drives.append(control.next(drives[-1], force(drives[-1])))
    return drives


@pytest.mark.parametrize("exponent", [0.4, 0.7, 1.0, 1.5, 3.0])
@pytest.mark.parametrize("start", [1e-4, 0.3, 20.0])
def test_given_a_power_law_when_controlled_then_the_level_is_reached_in_a_few_steps(
    exponent: float, start: float
) -> None:
    drives = approach(lambda drive: 5.0 * drive**exponent, start)
    assert 5.0 * drives[-1] ** exponent == pytest.approx(LEVEL, rel=FORCE_HELD)
    assert len(drives) <= 20


@pytest.mark.parametrize("start", [1e-3, 50.0])
def test_given_any_force_when_controlled_then_no_step_is_longer_than_the_longest(start: float) -> None:
    drives = approach(lambda drive: 5.0 * drive, start)
    ratios = [after / before for before, after in itertools.pairwise(drives)]
    assert max(max(ratios), 1 / min(ratios)) <= 3.0 * (1 + 1e-12)


def test_given_a_force_that_falls_over_a_stretch_when_controlled_then_the_level_beyond_is_reached() -> None:
    def force(drive: float) -> float:
        return drive if drive < 1.0 else 1.0 - 0.8 * (drive - 1.0) if drive < 1.5 else 0.6 + 2 * (drive - 1.5)

    drives = approach(force, 0.05)
    assert force(drives[-1]) == pytest.approx(LEVEL, rel=FORCE_HELD)


def test_given_a_force_that_jumps_over_the_level_when_controlled_then_the_drive_stays_at_the_jump() -> None:
    drives = approach(lambda drive: 2.0 * drive if drive < 1.0 else 4.0 * drive, 0.5, steps=40)
    assert len(drives) == 40
    assert np.all(np.abs(np.log(drives[15:])) < np.log(3.0))


def test_given_an_amplifier_limit_when_more_is_wanted_then_the_limit_is_what_is_given() -> None:
    control = AmplitudeControl(LEVEL, limit=1.2)
    assert control.next(1.0, 0.5) == 1.2
    assert control.next(1.2, 0.6) == 1.2


def test_given_far_too_much_force_when_cut_then_the_drive_falls_and_nothing_is_learned() -> None:
    control = AmplitudeControl(LEVEL)
    assert control.cut(9.0, 100.0) == pytest.approx(3.0)
    assert control.cut(9.0, 2 * LEVEL) == pytest.approx(4.5)
    assert control.next(1.0, LEVEL / 2) == pytest.approx(2.0)


def test_given_a_scattering_force_when_asked_then_the_level_holds_within_its_error_up_to_a_bound() -> None:
    control = AmplitudeControl(100.0)
    assert not control.holds(101.0)
    assert control.holds(101.0, doubt=0.006)
    assert not control.holds(105.0, doubt=0.1)


def test_given_a_force_that_does_not_come_from_the_drive_when_cut_again_and_again_then_it_ends_before_nothing_is_left():
    control, drive = AmplitudeControl(LEVEL), 1.0
    for _ in range(1000):
        less = control.cut(drive, 100 * LEVEL)
        if less is None:
            break
        assert 0.0 < less < drive
        drive = less
    assert 1e-5 < drive < 1e-4
