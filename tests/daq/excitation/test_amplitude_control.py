"""Control of the force amplitude: convergence, stability, and response to force jumps."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from daq.excitation.steady_tone import AmplitudeControl
from rig.scene.excitation import FORCE_TOLERANCE

LEVEL = 2.6


def approach(force: Callable[[float], float], drive: float, steps: int = 30) -> list[float]:
    """Number of drives until the level is reached."""
    control = AmplitudeControl(LEVEL)
    drives = [drive]
    while len(drives) < steps and not control.is_at_level(force(drives[-1])):
        drives.append(control.next(drives[-1], force(drives[-1])))
    return drives


@pytest.mark.parametrize("exponent", [0.4, 0.7, 1.0, 1.5, 3.0])
@pytest.mark.parametrize("start", [1e-4, 0.3, 20.0])
def test_power_law_reaches_level_quickly(exponent: float, start: float) -> None:
    drives = approach(lambda drive: 5.0 * drive**exponent, start)
    assert 5.0 * drives[-1] ** exponent == pytest.approx(LEVEL, rel=FORCE_TOLERANCE)
    assert len(drives) <= 20


@pytest.mark.parametrize("start", [1e-3, 50.0])
def test_no_step_exceeds_longest(start: float) -> None:
    drives = approach(lambda drive: 5.0 * drive, start)
    ratios = [after / before for before, after in itertools.pairwise(drives)]
    assert max(max(ratios), 1 / min(ratios)) <= 3.0 * (1 + 1e-12)


def test_falling_force_range_is_crossed() -> None:
    def force(drive: float) -> float:
        return drive if drive < 1.0 else 1.0 - 0.8 * (drive - 1.0) if drive < 1.5 else 0.6 + 2 * (drive - 1.5)

    drives = approach(force, 0.05)
    assert force(drives[-1]) == pytest.approx(LEVEL, rel=FORCE_TOLERANCE)


def test_jump_over_level_holds_drive() -> None:
    drives = approach(lambda drive: 2.0 * drive if drive < 1.0 else 4.0 * drive, 0.5, steps=40)
    assert len(drives) == 40
    assert np.all(np.abs(np.log(drives[15:])) < np.log(3.0))


def test_amplifier_limit_is_respected() -> None:
    control = AmplitudeControl(LEVEL, limit=1.2)
    assert control.next(1.0, 0.5) == 1.2
    assert control.next(1.2, 0.6) == 1.2


def test_excessive_force_cuts_drive() -> None:
    control = AmplitudeControl(LEVEL)
    assert control.cut(9.0, 100.0) == pytest.approx(3.0)
    assert control.cut(9.0, 2 * LEVEL) == pytest.approx(4.5)
    assert control.next(1.0, LEVEL / 2) == pytest.approx(2.0)


def test_scattering_force_holds_within_its_error() -> None:
    control = AmplitudeControl(100.0)
    assert not control.is_at_level(101.0)
    assert control.is_at_level(101.0, standard_error=0.006)
    assert not control.is_at_level(105.0, standard_error=0.1)


def test_unrelated_force_ends_control():
    control, drive = AmplitudeControl(LEVEL), 1.0
    for _ in range(1000):
        less = control.cut(drive, 100 * LEVEL)
        if less is None:
            break
        assert 0.0 < less < drive
        drive = less
    assert 1e-5 < drive < 1e-4
