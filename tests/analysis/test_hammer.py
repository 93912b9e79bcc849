from __future__ import annotations

import numpy as np
import pytest

import analysis
import daq
from rig.errors import RecordingError
from rig.receptance import receptance
from tests.analysis import synthetic


def test_given_a_response_that_rings_on_when_averaged_then_the_windows_damping_is_taken_off(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=3, interval=5.0, noise=1e-4)) as rec:
        [curves] = analysis.frequency_responses(rec)
        modes = analysis.identify(curves, count=3)
    assert curves[0].shift > 0
    assert sum("still rang from the hit before" in warning for warning in curves[0].warnings) == 2
    np.testing.assert_allclose(2 * np.pi * modes.frequency, [81.911, 218.512, 312.041], rtol=2e-4)
    np.testing.assert_allclose(modes.damping, 0.005, rtol=0.02)


def test_given_a_block_in_which_all_dies_out_when_averaged_then_compliance_is_exact(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=1, interval=15.0)) as rec:
        [curves] = analysis.frequency_responses(rec)
        exact = receptance(rec.scene, curves[0].frequency)
    assert curves[0].shift == 0
    near = (curves[0].frequency > 5.0) & (curves[0].frequency < 60.0)
    for body, frf in enumerate(curves):
        strong = near & (abs(exact[body]) > 2e-6)
        # The force between samples is a straight line, which at 60 Hz is 0.2 % less than the samples tell.
        np.testing.assert_allclose(frf.value[strong], exact[body][strong], rtol=0.02)
    assert any("One hit" in warning for warning in curves[0].warnings)


def test_given_a_rebound_when_averaged_then_that_hit_is_left_out(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=3, interval=12.0, rebound=(2,))) as rec:
        [curves] = analysis.frequency_responses(rec)
    assert any("Hit 2 left out: the hammer hit 2 times" in warning for warning in curves[0].warnings)
    assert curves[0].degrees[0] == 2.0


def test_given_rebounds_in_every_hit_when_averaged_then_no_clean_hit_is_said(tmp_path):
    path = synthetic.impulses(tmp_path / "a.mcap", hits=2, interval=4.0, rebound=(1, 2))
    with daq.open(path) as rec, pytest.raises(RecordingError, match="no clean hit"):
        analysis.frequency_responses(rec)


def test_given_no_force_channel_when_averaged_then_it_says_what_to_add(tmp_path):
    path = synthetic.impulses(tmp_path / "a.mcap", hammer=False, interval=1.0)
    with daq.open(path) as rec, pytest.raises(RecordingError, match=r"add \{name: hammer, at: hammer\}"):
        analysis.frequency_responses(rec)
