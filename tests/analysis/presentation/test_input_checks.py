"""Commands that do not suit a recording name the command that does."""

from __future__ import annotations

import numpy as np
import pytest

import daq
from analysis.presentation.inputs import check_recording
from rig.errors import RecordingError
from tests.analysis.responses import synthetic


@pytest.mark.parametrize(
    ("test", "marker_kind", "command", "suggested"),
    [
        ("{kind: random, from: 5 Hz, to: 60 Hz, duration: 10 s, force: 1 N}", "measure", "decay", "analysis frf"),
        ("{kind: random, from: 5 Hz, to: 60 Hz, duration: 10 s, force: 1 N}", "measure", "dampers", "analysis frf"),
        ("{kind: free, mode: 1, amplitude: 5 mm, duration: 10 s}", None, "frf", "analysis decay"),
        ("{kind: free, mode: 1, amplitude: 5 mm, duration: 10 s}", None, "modes", "analysis decay"),
        ("{kind: impulse, body: 1, peak: 50 N, width: 4 ms}", "hit", "dampers", "analysis decay"),
    ],
)
def test_wrong_recording_names_right_command(tmp_path, test, marker_kind, command, suggested):
    undriven = test.startswith("{kind: free") or test.startswith("{kind: impulse")
    scene = synthetic.scene(test)
    scene = scene.replace(dampers=[{"body": 1, "mass_ratio": 0.1, "clearance": 1e-3}])
    if undriven:
        scene = scene.replace(shaker=None)
    path = tmp_path / "my test.mcap"
    marker_rows = [] if marker_kind is None else [(marker_kind, 0, 20, {})]
    synthetic.write(path, scene, synthetic.channels(), np.zeros((4, 64)), marker_rows)
    with daq.open(path) as rec, pytest.raises(RecordingError, match=f"{suggested} '.*my test.mcap'"):
        check_recording(rec, path, command)
