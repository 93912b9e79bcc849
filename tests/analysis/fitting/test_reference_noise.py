from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

import analysis
import daq
import rig
from tests.analysis.fitting.other_simulator import drawn, random_test

pytestmark = pytest.mark.filterwarnings("ignore::daq.RunWarning")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Return a chain of two bodies, its random test with noise in the force, and an initial guess."""
    chain, folder = drawn(14), tmp_path_factory.mktemp("other")
    settings = random_test(chain, folder / "a.csv", 14, duration=40.0)
    scene = rig.loads(yaml.safe_dump(settings), where="the other simulator")
    return chain, daq.import_files(folder / "a.csv", scene, folder / "a.mcap"), scene


def test_reference_noise_is_told_from_response_noise(bench):
    with daq.open(bench[1]) as recording:
        curves = analysis.frfs(recording)
    errors = curves.covariance()
    # 3 % of the force's rms, white to 500 Hz; the force ends at 262 Hz.
    assert np.median(errors.reference) == pytest.approx(0.03**2 * 262.0 / 500.0, rel=0.3)
    own = np.einsum("kaa->ka", errors.lines).real
    peak = int(np.argmax(abs(curves[0].value)))
    common = abs(errors.lines[peak, 0, 1]) / np.sqrt(own[peak, 0] * own[peak, 1])
    assert common > 0.8


def test_modal_values_lie_in_intervals_alike(bench):
    chain, path, scene = bench
    fitted = analysis.fit(path, scene)
    with daq.open(path) as recording:
        modes = analysis.identify(analysis.frfs(recording))
    assert not fitted.misfit
    off = []
    for k, frequency in enumerate(chain.modes[0]):
        one = fitted.modes[k]
        off += [abs(one.frequency - frequency) / one.frequency_bound]
        off += [abs(one.damping - chain.damping[k]) / one.damping_bound]
        assert abs(modes.frequency[k] - frequency) < 3.0 * modes.frequency_error[k]
        assert 1 / 1.5 < 2.0 * modes.frequency_error[k] / one.frequency_bound < 1.6
        assert 1 / 1.5 < 2.0 * modes.damping_error[k] / one.damping_bound < 1.6
    # One in twenty 95 % intervals may miss the true value, but no error may reach 1.5 times its bound.
    assert sum(each > 1.0 for each in off) <= 1 and max(off) < 1.5


def test_starts_far_apart_give_one_answer(bench):
    _, path, scene = bench
    found = [
        analysis.fit(path, scene.replace(structure=scene.structure.replace(masses=masses)))
        for masses in (scene.structure.masses, tuple(1.3 * m for m in scene.structure.masses))
    ]
    for one, other in zip(found[0].parameters, found[1].parameters, strict=True):
        assert abs(np.log(one.value / other.value)) < 0.1 * one.half_width


@pytest.mark.thorough
def test_delayed_channel_is_named_with_its_delay(bench):
    _, path, scene = bench
    with daq.open(path) as recording:
        recording.channels["a2"] = replace(recording.channels["a2"], delay=-5e-5)
        found = analysis.fit(recording, scene)
    # A smaller time advance of the other channel explains the curves nearly as well.
    named = re.search(r"a2 reads ([\d.]+) µs late", found.misfit)
    assert named is not None and float(named[1]) == pytest.approx(50.0, abs=1.0)
    assert "another" not in found.misfit
