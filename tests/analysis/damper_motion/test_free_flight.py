from __future__ import annotations

import pytest

import daq
import rig
from analysis.damper_motion.free_flight import BodyMotion, restitution


@pytest.mark.parametrize(("true", "clearance"), [(0.0, 1e-3), (0.0, float("inf")), (0.3, 1e-3), (0.6, 1e-3)])
def test_restitution_lies_within_its_bounds(tmp_path, true, clearance):
    sensor = {"sensitivity": 0.0102, "noise": 1.96e-4, "resonance": 30e3, "low_cutoff": 0.5}
    scene = rig.load("fig8-no-damper").replace(
        dampers=[{"body": 2, "mass_ratio": 0.08, "clearance": clearance, "restitution": true}],
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 49.5, "force": 2.6, "duration": 2.0},
        channels=[{"name": "body2", "at": "body 2", "accelerometer": sensor}, {"name": "force", "at": "shaker"}],
        recording={"display": False},
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [window] = [marker for marker in rec.markers if marker.kind == "measure"]
        first, stop = window.first_sample, window.stop
        estimate = restitution(BodyMotion(rec, "body2", first, stop), scene.dampers[0])
    assert estimate is not None and estimate.error < 0.05
    assert abs(estimate.value - true) < 2.0 * estimate.error
