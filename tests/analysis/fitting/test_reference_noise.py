"""Fits to a random test with noise in the measured force, which another simulator made: intervals and delays."""

import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

import analysis
import daq
import rig
from analysis.core.fitting.diagnosis import find_cause, minimize_near
from analysis.core.fitting.estimate import estimate_structure
from analysis.core.fitting.measured import measured_curves
from analysis.core.fitting.parameters import free_parameters
from analysis.core.fitting.problem import Problem
from tests.analysis.fitting.other_simulator import random_chain, random_test

pytestmark = pytest.mark.filterwarnings("ignore::daq.RunWarning")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Return a chain of two bodies, the imported recording of its random test, and the initial scene of the fit."""
    chain, folder = random_chain(14), tmp_path_factory.mktemp("other")
    settings = random_test(chain, folder / "a.csv", 14)
    scene = rig.loads(yaml.safe_dump(settings), where="the other simulator")
    return chain, daq.import_files(folder / "a.csv", scene, folder / "a.mcap"), scene


def test_reference_noise_is_separated_from_response_noise(bench):
    with daq.open(bench[1]) as recording:
        curves = analysis.frfs(recording)
    errors = curves.covariance()
    # Noise of 3 % of the force's rms value is white up to 500 Hz; the force has a bandwidth of 262 Hz.
    assert np.median(errors.reference) == pytest.approx(0.03**2 * 262.0 / 500.0, rel=0.3)
    variances = np.einsum("kaa->ka", errors.lines).real
    peak = int(np.argmax(abs(curves[0].value)))
    correlation = abs(errors.lines[peak, 0, 1]) / np.sqrt(variances[peak, 0] * variances[peak, 1])
    assert correlation > 0.8


def test_modal_values_lie_in_their_intervals(bench):
    chain, path, scene = bench
    fitted = analysis.fit(path, scene)
    with daq.open(path) as recording:
        modes = analysis.identify(analysis.frfs(recording))
    assert not fitted.misfit
    normalized_errors = []
    for k, frequency in enumerate(chain.modes[0]):
        mode = fitted.modes[k]
        normalized_errors += [abs(mode.frequency - frequency) / mode.frequency_expanded]
        normalized_errors += [abs(mode.damping - chain.damping[k]) / mode.damping_expanded]
        assert abs(modes.frequency[k] - frequency) < 3.0 * modes.frequency_std[k]
        # The 95 % intervals of the fit and of the identification agree within a factor of 1.6.
        assert 1 / 1.5 < 2.0 * modes.frequency_std[k] / mode.frequency_expanded < 1.6
        assert 1 / 1.5 < 2.0 * modes.damping_std[k] / mode.damping_expanded < 1.6
    # One in twenty 95 % intervals may miss the true value, but no error may reach 1.5 times its bound.
    assert sum(error > 1.0 for error in normalized_errors) <= 1 and max(normalized_errors) < 1.5


def test_different_initial_values_give_the_same_fit(bench):
    _, path, scene = bench
    fits = [
        analysis.fit(path, scene.replace(structure=scene.structure.replace(masses=masses)))
        for masses in (scene.structure.masses, tuple(1.3 * m for m in scene.structure.masses))
    ]
    for parameter, same_parameter in zip(fits[0].parameters, fits[1].parameters, strict=True):
        assert abs(np.log(parameter.value / same_parameter.value)) < 0.1 * parameter.half_width


@pytest.mark.thorough
def test_delayed_channel_is_named_with_its_delay(bench):
    chain, path, scene = bench
    with daq.open(path) as recording:
        recording.channels["a2"] = replace(recording.channels["a2"], delay=-5e-5)
        curves = measured_curves(recording, "a")
    known = {"springs": chain.springs.tolist(), "damping": {"modal": chain.damping.tolist()}}
    model = scene.replace(structure=scene.structure.replace(**known))
    problem = Problem(model, free_parameters(model, ["structure.masses"]), curves)
    is_explained, text = find_cause(problem, estimate_structure(problem, problem.groups))
    # An advance of the other channel explains the curves nearly as well.
    delay_text = re.search(r"a2 reads ([\d.]+) µs late", text)
    assert is_explained and delay_text is not None
    assert float(delay_text[1]) == pytest.approx(50.0, abs=1.0)


def test_delay_far_from_its_estimate_is_found() -> None:
    assert minimize_near(lambda delay: (1e6 * (delay - 2.7e-4)) ** 2, 0.0) == pytest.approx(2.7e-4, abs=1e-7)


def test_wrong_unit_is_named_despite_uncertain_masses(bench) -> None:
    _, path, scene = bench
    masses = tuple(mass / 10.0 for mass in scene.structure.masses)
    result = analysis.fit(path, scene.replace(structure=scene.structure.replace(masses=masses)))
    assert "times the masses of the scene (g read as m/s²)" in result.misfit
