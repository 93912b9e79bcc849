from __future__ import annotations

import numpy as np
import pytest

import analysis
import daq
from analysis.polynomials import chart, stable_poles
from rig.errors import RecordingError
from rig.structure import natural_modes, structure_matrices
from tests.analysis import synthetic

OMEGA = np.array([81.911, 218.512, 312.041])
ATTACHED = np.array([86.776, 228.231, 318.003])


def theory(scene):
    mass, _, stiffness = structure_matrices(scene.structure)
    return natural_modes(mass, stiffness)


def test_given_a_stepped_sine_when_modes_are_identified_then_frequencies_and_damping_are_read_off(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", np.linspace(8.0, 60.0, 105))) as rec:
        [curves] = analysis.frequency_responses(rec)
        modes = analysis.identify(curves)
        omega, shapes = theory(rec.scene)
    np.testing.assert_allclose(2 * np.pi * modes.frequency, omega, rtol=1e-6)
    np.testing.assert_allclose(2 * np.pi * modes.frequency, OMEGA, rtol=1e-5)
    np.testing.assert_allclose(modes.damping, 0.005, rtol=1e-4)
    assert np.all(np.diag(analysis.mac(modes.shapes, shapes)) > 1 - 1e-9)
    np.testing.assert_allclose(modes.collinearity, 1.0, atol=1e-6)


def test_given_the_same_recording_when_divided_by_the_table_then_the_attached_resonances_are_found(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", np.linspace(8.0, 60.0, 105))) as rec:
        [curves] = analysis.frequency_responses(rec, reference="table")
        modes = analysis.identify(curves)
    np.testing.assert_allclose(2 * np.pi * modes.frequency, ATTACHED, rtol=1e-5)


def test_given_noise_when_modes_are_identified_then_their_errors_are_of_the_size_stated(tmp_path):
    off = []
    for seed in range(6):
        path = synthetic.stepped_sine(
            tmp_path / "a.mcap", np.linspace(8.0, 60.0, 105), noise=3e-6, seed=seed, periods=10
        )
        with daq.open(path) as rec:
            [curves] = analysis.frequency_responses(rec)
            modes = analysis.identify(curves)
            omega, _ = theory(rec.scene)
        off.append((modes.frequency - omega / (2 * np.pi)) / modes.frequency_error)
        off.append((modes.damping - 0.005) / modes.damping_error)
        np.testing.assert_allclose(modes.frequency, omega / (2 * np.pi), rtol=2e-4)
        np.testing.assert_allclose(modes.damping, 0.005, rtol=0.02)
    assert 0.3 < np.std(off) < 2.0


def test_given_few_points_in_a_resonance_when_identified_then_it_warns_that_damping_rests_on_flanks(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", np.linspace(8.0, 60.0, 60))) as rec:
        [curves] = analysis.frequency_responses(rec)
        warnings = " ".join(analysis.identify(curves).warnings)
    assert "damping ratio rests on the flanks" in warnings


def test_given_too_few_points_when_identified_then_it_says_how_many_are_needed(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", [10.0, 20.0, 30.0])) as rec:
        [curves] = analysis.frequency_responses(rec)
    with pytest.raises(RecordingError, match="3 frequencies are too few"):
        analysis.identify(curves)


@pytest.mark.parametrize("seed", range(5))
def test_given_white_noise_when_charted_then_no_pole_is_stable(seed):
    random = np.random.default_rng(seed)
    frequency = np.linspace(5.0, 60.0, 200)
    value = random.standard_normal((2, 200)) + 1j * random.standard_normal((2, 200))
    assert stable_poles(chart(frequency, value, np.ones((2, 200)))) == []
