"""Simulated steady response against the closed form of linear structures."""

import numpy as np
import pytest

import rig
from rig.core.system.structural_model import receptance

FORCE_SHAKER: dict[str, object] = {"kind": "force", "body": 1}
TABLE_SHAKER: dict[str, object] = {"kind": "table", "body": 1, "spring": 6600.0}


# The servo of a table is faster than the structure, so that the engine's steps are shorter.
@pytest.mark.parametrize(
    ("shaker", "frequency"), [(FORCE_SHAKER, 0.02), (FORCE_SHAKER, 14.0), (TABLE_SHAKER, 0.2), (TABLE_SHAKER, 14.0)]
)
def test_linear_response_is_exact_far_below_resonances(shaker: dict[str, object], frequency: float) -> None:
    # The step of the engine follows the highest rate of the rig: a period has up to 10 000 steps.
    scene = rig.Scene(
        structure={"masses": [0.8, 0.7, 0.6], "springs": [26e3, 20e3, 20e3], "damping": {"modal": 0.01}},
        shaker=shaker,
        test={"kind": "sine", "frequency": frequency, "force": 1.0},
    )
    response = rig.frequency_response(scene, np.array([frequency]))
    by_force = receptance(scene.replace(shaker=FORCE_SHAKER), np.array([frequency]))
    assert response.converged.all()
    np.testing.assert_allclose(response.compliance, by_force, rtol=1e-7)


def scaled_scene(time_scale: float) -> rig.Scene:
    """Return a rig with flights and impacts in which all times are multiplied by a factor, and no acceleration is."""
    return rig.Scene(
        structure={
            "masses": [0.8, 0.7, 0.6],
            "springs": [stiffness / time_scale**2 for stiffness in (26e3, 20e3, 20e3)],
            "damping": {"modal": 0.01},
        },
        dampers=[{"body": 3, "mass_ratio": 0.1, "clearance": 0.5e-3 * time_scale**2}],
        shaker=FORCE_SHAKER,
        test={"kind": "sine", "frequency": 14.0 / time_scale, "force": 8.0},
        converter={"rate": 5120.0 * max(1.0, 1.0 / time_scale)},
    )


@pytest.mark.parametrize("compute", [rig.frequency_response, rig.orbit_response])
@pytest.mark.parametrize("time_scale", [0.02, 50.0])
def test_time_scale_changes_no_motion_type(compute, time_scale: float) -> None:
    frequency = np.array([12.0, 14.0])
    response = compute(scaled_scene(1.0), frequency)
    scaled = compute(scaled_scene(time_scale), frequency / time_scale)
    assert scaled.motion_type.tolist() == response.motion_type.tolist() and "riding" not in response.motion_type
    np.testing.assert_allclose(scaled.compliance, response.compliance * time_scale**2, rtol=1e-9)
    np.testing.assert_allclose(scaled.peak, response.peak * time_scale**2, rtol=1e-9)


def test_two_masses_that_move_alike_equal_one() -> None:
    scene, frequency = rig.load("fig9"), [48.9, 49.1, 49.5, 50.1]
    damper = scene.dampers[0].replace(mass_ratio=0.06, clearance=0.01)
    pair = scene.replace(dampers=[damper, damper.replace(mass_ratio=0.04)])
    one = scene.replace(dampers=[damper.replace(mass_ratio=0.1)])
    expected = rig.frequency_response(one, frequency)
    assert "irregular" not in expected.motion_type and len(set(expected.motion_type)) > 1
    np.testing.assert_allclose(rig.frequency_response(pair, frequency).compliance, expected.compliance, rtol=1e-9)
