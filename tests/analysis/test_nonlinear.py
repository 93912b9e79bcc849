from __future__ import annotations

import numpy as np
import pytest

import analysis
import daq
from analysis.merit import describe_changes, energy_per_cycle, peak_changes
from analysis.nonlinear import DamperMotion, jumps
from analysis.stepped import sweeps
from rig.errors import RecordingError
from tests.analysis import synthetic


def test_given_a_linear_structure_when_balanced_then_it_dissipates_all_that_is_supplied(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", [12.0, 13.04, 30.0, 34.8, 49.7])) as rec:
        [sweep] = sweeps(rec)
        energy = energy_per_cycle(rec, sweep)
    np.testing.assert_allclose(energy.structure, energy.supplied, rtol=1e-6)
    assert np.all(abs(energy.dampers) < 1e-5 * energy.supplied)


def test_given_no_channel_on_a_body_when_balanced_then_it_is_named(tmp_path):
    infos = [info for info in synthetic.channels() if info.name != "body2"]
    marks = [("measure", 0, 2559, {"frequency": 20.0, "level": 1.0, "direction": "up"})]
    wave = np.tile(np.sin(2 * np.pi * 20 / synthetic.RATE * np.arange(2560)), (3, 1))
    with daq.open(synthetic.write(tmp_path / "a.mcap", synthetic.scene(), infos, wave, marks)) as rec:
        [sweep] = sweeps(rec)
        with pytest.raises(RecordingError, match="no channel on body 2"):
            energy_per_cycle(rec, sweep)


def test_given_the_same_structure_twice_when_compared_then_nothing_has_changed(tmp_path):
    frequencies = np.unique(np.append(np.linspace(8.0, 60.0, 105), [13.0366, 34.7773, 49.6628]))
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", frequencies)) as rec:
        [curves] = analysis.frequency_responses(rec)
    changes = peak_changes(curves, curves)
    assert len(changes) == 9
    for change in changes:
        assert change.reduction == pytest.approx(1.0, abs=1e-3)
        assert change.equivalent_damping == pytest.approx(0.005, rel=2e-3)
        assert abs(change.added_mass) < 1e-4
    assert "+0.0 dB" in describe_changes(changes)[0] or "-0.0 dB" in describe_changes(changes)[0]


def test_given_a_curve_with_a_resonance_only_when_searched_then_no_jump_is_claimed(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", np.linspace(8.0, 60.0, 105))) as rec:
        for [*curves] in analysis.frequency_responses(rec):
            assert [jumps(curve) for curve in curves] == [[], [], []]


@pytest.mark.parametrize(
    ("floor", "ceiling", "name"),
    [(0, 0, "at rest"), (1, 0, "Type I:"), (1, 1, "Type II or III"), (0.5, 0, "other"), (2, 1, "other")],
)
def test_given_impacts_a_period_when_named_then_the_papers_types_are_used(floor, ceiling, name):
    assert DamperMotion(30.0, "body2", floor, ceiling, 1e-3).name.startswith(name)
