from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import analysis
import daq
from analysis.modal.lscf import chart, stable_poles
from analysis.responses.frf import Frf
from rig.errors import RecordingError
from rig.system.structure import natural_modes, structure_matrices
from tests.analysis.responses import synthetic

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


@pytest.mark.parametrize(("ratio", "warned"), [(0.33, False), (0.6, True)])
def test_given_leakage_when_identified_then_it_warns_just_where_damping_is_off_by_two_percent(ratio, warned):
    # One mode, as random through Hann windows measures it: smeared by the square of the window's spectrum.
    natural, zeta = 30.0, 0.01
    resolution = ratio * zeta * natural
    bins = resolution / 1.5
    away = np.linspace(-30.0, 30.0, 6001)
    window = (np.sinc(away) + 0.5 * np.sinc(away - 1.0) + 0.5 * np.sinc(away + 1.0)) ** 2
    frequency = np.arange(24.0, 36.0, bins)
    s = 2j * np.pi * (frequency[:, None] - bins * away)
    pole = 2 * np.pi * natural * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    value = (1.0 / ((s - pole) * (s - pole.conjugate()))) @ (window / window.sum())
    nothing = np.zeros(frequency.size)
    frf = Frf(
        frequency, value, nothing + 1e-3 * abs(value).max(), nothing + 1.0, nothing + 38.0, "body1",
        resolution=resolution,
    )  # fmt: skip
    modes = analysis.identify([frf], count=1)
    assert any("smears" in warning for warning in modes.warnings) == warned
    assert (modes.damping[0] / zeta - 1.0 > 0.02) == warned
    assert modes.damping[0] / zeta - 1.0 == pytest.approx(0.16 * ratio**2, rel=0.25)


def test_given_a_peak_without_a_pole_when_identified_then_it_is_said_and_not_listed(tmp_path):
    frequencies = np.linspace(8.0, 60.0, 105)
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", frequencies, noise=1e-7)) as rec:
        [curves] = analysis.frequency_responses(rec)
    step = np.where(frequencies > 24.3, 0.8 + 0.3j, 1.0)
    modes = analysis.identify([replace(curve, value=curve.value * step) for curve in curves])
    assert np.all(modes.damping > 1e-4) and np.all(modes.damping_error < 0.5 * modes.damping)
