"""Responses to hits sampled by a clock with jitter: the stated uncertainty contains the error due to jitter."""

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.core.responses.errors.systematic import JITTER
from rig.core.system.structural_model import receptance

HITS_SCENE = """
structure: {{masses: [1 kg, 0.2 kg], springs: [395 kN/m, 2370 kN/m], damping: {{modal: 1 %}}}}
test: {{kind: impulse, body: 1, peak: 100 N, width: 0.5 ms, repeats: {repeats}, interval: 1 s}}
channels:
  - {{name: a2, at: body 2, accelerometer: {{sensitivity: 10 mV/g}}}}
  - {{name: hammer, at: hammer, hammer: {{sensitivity: 20 mV/N}}}}
converter: {{rate: 5120 Hz, bits: 24, range: 5 V{jitter}}}
recording: {{display: false}}
"""


def response_and_error(path, **settings):
    """Return the estimated response of body 2, and the magnitude of its error in m/N."""
    scene = rig.loads(HITS_SCENE.format(**settings))
    with daq.open(daq.record(scene, path)) as rec:
        [[frf]] = analysis.frequency_responses(rec, ["a2"])
        return frf, abs(frf.value - receptance(rec.scene, frf.frequency)[1])


@pytest.mark.parametrize("repeats", [1, 3])
def test_jitter_bound_contains_error_due_to_jitter(repeats, tmp_path):
    frf, error = response_and_error(tmp_path / "a.mcap", repeats=repeats, jitter=", jitter: 1 us")
    without_jitter = frf.without(JITTER)
    assert np.mean(error <= without_jitter.bound()) < 0.8
    assert np.mean(error <= frf.bound()) > 0.9
    # The bound is twice the standard deviation.
    exceeding = error > without_jitter.bound()
    assert 0.3 < np.sqrt(np.mean((error / frf.limits[JITTER])[exceeding] ** 2)) < 0.9


def test_response_without_jitter_has_no_jitter_bound(tmp_path):
    frf, error = response_and_error(tmp_path / "a.mcap", repeats=1, jitter="")
    assert JITTER not in frf.limits and np.mean(error <= frf.bound()) > 0.9
