"""A design is written as a scene with a test that checks it; its frequencies and expected results are correct.

The objective is what a design optimizes: structure, force levels and band. A choice is the dampers of a candidate
design (bodies, masses in kg, clearances in m); a trial is a choice with its peaks. Arguments are positional:
Peak(compliance, frequency, level, body, acceleration, irregular share).
"""

import numpy as np
import pytest

import rig
from rig.core.base.workers import Workers
from rig.core.scene.excitation import SteppedSine
from rig.studies.design.check import expected_results, scene_with_check
from rig.studies.design.choice import INSTANTANEOUS, Choice, Trial
from rig.studies.design.request import parse_request
from rig.studies.design.worst_peak import Peak
from tests.rig.this_process import pieces_in_this_process


def test_check_covers_all_levels_and_peaks() -> None:
    scene = rig.load("fig9")
    objective, _ = parse_request(scene, levels=[2.0, 4.0], band=(30.0, 55.0))
    choice = Choice((2,), (0.1,), (1e-3,))
    peaks = tuple(Peak(1e-4, f, level, 1, 1.0, 0.0) for f, level in ((34.1, 2.0), (48.7, 4.0)))
    test = scene_with_check(scene, Trial(choice, peaks), objective).test
    assert isinstance(test, SteppedSine) and test.frequencies is not None
    assert test.levels == (2.0, 4.0)
    assert {34.1, 48.7, float(f"{objective.bare_peak.frequency:.6g}")} <= set(test.frequencies)
    spacings = np.diff(test.frequencies)
    # 25 frequencies around 34.1 Hz, and fewer than 2 * 25 in one common range around 48.7 Hz and the peak without
    # dampers. The one large step is between these ranges.
    assert len(test.frequencies) < 70 and np.sum(spacings > 0.005 * 48.7) == 1


def test_expected_compliance_includes_force_harmonics() -> None:
    scene = rig.load("fig9", {"shaker": {"kind": "table", "body": 1, "spring": "6.6 kN/m"}})
    objective, _ = parse_request(scene, bodies=[2], levels=[1.5])
    choice = Choice((2,), (0.1,), (0.969e-3,))
    peak = objective.worst(choice)
    trial = Trial(choice, (peak,))
    with pieces_in_this_process(), Workers() as workers:
        (expected_result,) = expected_results(scene_with_check(scene, trial, objective), trial, workers)
    assert expected_result.magnitudes is not None
    # Compliances over the tolerance of the force controller, 0.5 %.
    low, nominal, high = expected_result.magnitudes
    assert low < nominal < high < 1.01 * low
    test_scene = scene.replace(channels=None, dampers=choice.dampers(INSTANTANEOUS))
    for force, expected_compliance in ((1.5 * 1.005, low), (1.5, nominal), (1.5 * 0.995, high)):
        forced_scene = test_scene.replace(test={"kind": "sine", "frequency": peak.frequency, "force": force})
        steady = abs(rig.frequency_response(forced_scene, [peak.frequency]).compliance[peak.body - 1, 0])
        assert expected_compliance == pytest.approx(steady, rel=1.1e-3)


def test_check_drives_the_shaker_of_the_scene() -> None:
    shakers = [{"kind": "force", "body": 1}, {"kind": "force", "body": 3}]
    drive = {"kind": "sine", "frequency": "49 Hz", "force": "3 N", "shaker": 2}
    scene = rig.load("fig9", {"shaker": shakers, "test": drive, "channels": None})
    objective, _ = parse_request(scene, band=(45.0, 55.0))
    trial = Trial(Choice((2,), (0.1,), (1e-3,)), (Peak(1e-4, 48.7, 3.0, 1, 1.0, 0.0),))
    assert scene_with_check(scene, trial, objective).driven == 2
