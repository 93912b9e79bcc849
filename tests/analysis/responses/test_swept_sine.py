"""Sweeps with dampers in flight: the sweep is slow enough, or a warning states that it is too fast."""

from __future__ import annotations

import pytest

import analysis
import daq
import rig

SCENE = """
structure: {masses: [1 kg], springs: [12.8 kN/m], damping: {modal: 0.5 %}}
dampers: [{body: 1, mass_ratio: 9 %, clearance: 1.5 mm}]
shaker: {kind: force, body: 1}
test: {kind: swept_sine, from: 14 Hz, to: 21 Hz, duration: 2 s, force: 13 N}
channels: [{name: a, at: body 1, accelerometer: {}}, {name: force, at: shaker}]
converter: {rate: 1024 Hz}
"""


@pytest.mark.parametrize(("end", "warned"), [(21.0, True), (14.05, False)])
def test_fast_sweep_with_flight_warns(tmp_path, end, warned):
    scene = rig.loads(SCENE, where="a test")
    path = tmp_path / "a.mcap"
    daq.record(scene.replace(test=scene.test.replace(to=end)), path)
    with daq.open(path) as rec:
        [[frf]] = analysis.frequency_responses(rec)
    assert any("too fast to reach steady state" in text for text in frf.warnings) == warned
