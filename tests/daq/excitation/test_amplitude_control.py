"""`AmplitudeControl` determines the drive for a force level: convergence, stability, and jumps of the force."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from daq.core.excitation.tones.steady_tone import AmplitudeControl
from rig.core.scene.excitation import FORCE_TOLERANCE

LEVEL = 2.6  # N


def control_drive(force: Callable[[float], float], drive: float, max_drives: int = 30) -> list[float]:
    """Return the drives of the controller until the level is reached; `force`: steady force in N for a drive."""
    control = AmplitudeControl(LEVEL)
    drives = [drive]
    while len(drives) < max_drives and not control.is_at_level(force(drives[-1])):
        drives.append(control.next_drive(drives[-1], force(drives[-1])))
    return drives


@pytest.mark.parametrize("exponent", [0.4, 0.7, 1.0, 1.5, 3.0])
@pytest.mark.parametrize("start", [1e-4, 0.3, 20.0])
def test_power_law_reaches_level_quickly(exponent: float, start: float) -> None:
    drives = control_drive(lambda drive: 5.0 * drive**exponent, start)
    assert 5.0 * drives[-1] ** exponent == pytest.approx(LEVEL, rel=FORCE_TOLERANCE)
    assert len(drives) <= 20


@pytest.mark.parametrize("start", [1e-3, 50.0])
def test_drive_changes_by_factor_three_at_most(start: float) -> None:
    drives = control_drive(lambda drive: 5.0 * drive, start)
    ratios = [after / before for before, after in itertools.pairwise(drives)]
    assert max(max(ratios), 1 / min(ratios)) <= 3.0 * (1 + 1e-12)


def test_level_beyond_decreasing_force_is_reached() -> None:
    def force(drive: float) -> float:
        # The force falls from 1 to 0.6 N between drives of 1 and 1.5, and rises beyond.
        return float(np.interp(drive, [0.0, 1.0, 1.5, 101.5], [0.0, 1.0, 0.6, 200.6]))

    drives = control_drive(force, 0.05)
    assert force(drives[-1]) == pytest.approx(LEVEL, rel=FORCE_TOLERANCE)


def test_drive_is_stable_at_jump_over_level() -> None:
    drives = control_drive(lambda drive: 2.0 * drive if drive < 1.0 else 4.0 * drive, 0.5, max_drives=40)
    # The level is between the forces before and after the jump. The last drives stay near the jump, at a drive of 1.
    assert len(drives) == 40
    assert np.all(np.abs(np.log(drives[15:])) < np.log(3.0))


def test_amplifier_limit_is_respected() -> None:
    control = AmplitudeControl(LEVEL, limit=1.2)
    assert control.next_drive(1.0, 0.5) == 1.2
    assert control.next_drive(1.2, 0.6) == 1.2


def test_excessive_force_cuts_drive() -> None:
    control = AmplitudeControl(LEVEL)
    # The drive is reduced in proportion to the force, at most by a factor of three.
    assert control.reduce_drive(9.0, 100.0) == pytest.approx(9.0 / 3)
    assert control.reduce_drive(9.0, 2 * LEVEL) == pytest.approx(9.0 / 2)
    assert control.next_drive(1.0, LEVEL / 2) == pytest.approx(2.0)


def test_tolerance_of_level_includes_standard_error() -> None:
    # The tolerance is twice the relative standard uncertainty, but at most 2 %.
    control = AmplitudeControl(100.0)
    assert not control.is_at_level(101.0)
    assert control.is_at_level(101.0, standard_error=0.006)
    assert not control.is_at_level(105.0, standard_error=0.1)


def test_force_independent_of_drive_ends_control():
    control, drive = AmplitudeControl(LEVEL), 1.0
    for _ in range(1000):
        reduced_drive = control.reduce_drive(drive, 100 * LEVEL)
        if reduced_drive is None:
            break
        assert 0.0 < reduced_drive < drive
        drive = reduced_drive
    # The control ends when the drive is below 1e-4 of its largest value; the last reduction was by a factor of three.
    assert 1e-4 / 3 < drive < 1e-4
