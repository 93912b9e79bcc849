"""A design predicts which accelerometers its check would overload, by impacts or by the steady-state motion.

The check is the test that verifies the design. A prediction has a reason and the changes of the scene that prevent it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import daq
import rig
from rig.core.system.assembly import assemble
from rig.core.system.impact_acceleration import impact_acceleration
from rig.studies.design.check import Expected
from rig.studies.design.overloads import overload_lines, predict_overloads
from rig.studies.design.worst_peak import Peak

FREQUENCY_HZ, FORCE_N = 49.0, 3.3
# A peak of the steady-state motion that overloads no sensor: compliance 1e-6 m/N at body 2, acceleration 1 m/s^2, no
# irregular motion.


def _peak(compliance: float) -> Peak:
    acceleration = compliance * FORCE_N * (2.0 * np.pi * FREQUENCY_HZ) ** 2
    return Peak(compliance, FREQUENCY_HZ, FORCE_N, 2, acceleration, 0.0)


SMALL_PEAK = _peak(1e-6)
# A peak at which the dampers stay at rest on their floors: no approach speed.
PEAK_WITHOUT_LANDING = Expected(_peak(1e-4), None, (0.0,))


def _scene(contact: dict[str, Any] | None, sensor: dict[str, Any]) -> rig.Scene:
    """Return a scene with a damper in body 2, and the sensor on body 2 and on body 3."""
    changes = {
        "dampers": [{"body": 2, "mass_ratio": 0.06, "clearance": 0.98e-3, "contact": contact}],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "stepped_sine", "frequencies": [FREQUENCY_HZ], "force": FORCE_N, "settle": {"longest": "2 s"}},
        "channels": [
            {"name": "force", "at": "shaker"},
            {"name": "impacted", "at": "body 2", "accelerometer": sensor},
            {"name": "other", "at": "body 3", "accelerometer": sensor},
        ],
        "converter": {"rate": "5120 Hz"},
    }
    return rig.load("fig9", changes)


def _expected(scene: rig.Scene) -> Expected:
    """Return the expected measurement at the peak, with the closing speed of the damper in steady state."""
    response = rig.frequency_response(scene.replace(channels=None), [FREQUENCY_HZ], tolerance=1e-4)
    return Expected(_peak(1e-4), None, tuple(response.closing_speed[:, 0].tolist()))


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*steady state:daq.RunWarning")
@pytest.mark.parametrize("contact", [None, {"duration": "2 ms"}])
def test_landings_overload_the_predicted_sensor(contact: dict[str, Any] | None, tmp_path: Path) -> None:
    resonance = {"resonance": "5 kHz", "q": 30}
    scene = _scene(contact, resonance)
    expected = _expected(scene)
    # Largest acceleration of body 2 (index 1) that a sensor with a resonance at 5 kHz indicates, m/s^2.
    peak_acceleration = impact_acceleration(assemble(scene), 1, expected.closing_speed, 5000.0)
    for saturation_ratio in (0.5, 2.0):
        limited_scene = _scene(contact, {**resonance, "saturation": saturation_ratio * peak_acceleration})
        path = tmp_path / f"{saturation_ratio}.mcap"
        daq.record(limited_scene, path)
        with daq.open(path) as recording:
            recorded = {marker.fields["channel"] for marker in recording.overloads}
        names = [
            overload.reason.partition(":")[0] for overload in predict_overloads(limited_scene, [expected], SMALL_PEAK)
        ]
        assert names == (["impacted"] if saturation_ratio < 1.0 else [])
        assert recorded == ({"impacted"} if saturation_ratio < 1.0 else set())


def test_instantaneous_landings_overload_any_sensor_without_resonance() -> None:
    scene = _scene(None, {"saturation": "5000 g"})
    (overload,) = predict_overloads(scene, [_expected(scene)], SMALL_PEAK)
    assert overload.reason.startswith("impacted: up to")
    assert (
        "because of damper impacts with closing speeds of up to" in overload.reason
        and "saturates at 5000 g" in overload.reason
    )
    assert overload.changes == ("channels[2].accelerometer.saturation=null",)
    lines = overload_lines([overload], finite_contact=False)
    assert "contact: {duration: 2 ms}" in lines[-1] and overload.changes[0] in lines[-1]


def test_no_overload_without_landing_or_saturation() -> None:
    limited_scene, unlimited_scene = _scene(None, {"saturation": "5 g"}), _scene(None, {})
    assert not predict_overloads(limited_scene, [PEAK_WITHOUT_LANDING], SMALL_PEAK)
    assert not predict_overloads(unlimited_scene, [_expected(unlimited_scene)], SMALL_PEAK)


def test_steady_motion_overloads_a_small_sensor() -> None:
    overloads = predict_overloads(_scene(None, {"saturation": "2 g"}), [PEAK_WITHOUT_LANDING], SMALL_PEAK)
    assert [overload.changes for overload in overloads] == [
        ("channels[2].accelerometer.saturation=6g",),
        ("channels[3].accelerometer.saturation=6g",),
    ]


def test_small_converter_range_is_reported() -> None:
    scene = _scene(None, {"sensitivity": "1 V/g"}).replace(converter={"rate": "5120 Hz", "range": "2 V"})
    (overload,) = predict_overloads(scene, [PEAK_WITHOUT_LANDING], SMALL_PEAK)
    assert overload.changes == ("converter.range=4.8V",)
