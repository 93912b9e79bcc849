"""Steady-state motion over a parameter as stable periodic orbits, compared with simulations to steady state.

`simulated` marks points without a stable orbit, where the motion is simulated; `repetition` is the length of the motion
in periods of the drive, 0 for irregular motion.
"""

import numpy as np
import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.system.open_loop_drive import with_ideal_force
from tests.rig.orbits.scenes import finite_contact_scene, scene_with

CURVES = [
    (rig.load("fig9"), np.linspace(48.0, 50.9, 30)),
    (scene_with("fig9", 2.5, 0.04, 0.7e-3), np.linspace(47.5, 50.5, 16)),
    (scene_with("fig8-two-dampers", 2.0, 0.08, np.inf), np.linspace(46.0, 49.0, 16)),
    (scene_with("fig5-three-dampers", 8.0, 0.07, 1.3e-3), np.linspace(49.0, 51.0, 15)),
    (finite_contact_scene("fig9", {"duration": 4e-3}), [44.0, 47.0, 49.1, 49.4, 49.8]),
]


@pytest.mark.parametrize(("scene", "frequencies"), CURVES)
def test_orbit_sweep_equals_steady_simulation(scene: rig.Scene, frequencies: np.ndarray) -> None:
    scene = with_ideal_force(scene)

    orbits = rig.orbit_response(scene, frequencies)

    simulated = rig.frequency_response(scene, frequencies, tolerance=1e-8)
    both_converged = simulated.converged & ~orbits.simulated
    assert both_converged.mean() > 0.6
    assert not orbits.simulated.any()
    largest_compliance = np.abs(simulated.compliance).max(axis=0)
    deviation = np.abs(orbits.compliance - simulated.compliance).max(axis=0) / largest_compliance
    assert deviation[both_converged].max() < 1e-6
    assert (orbits.motion_type[both_converged] == simulated.motion_type[both_converged]).all()
    assert (orbits.repetition[both_converged] == simulated.repetition[both_converged]).all()
    for orbit in orbits.orbits:
        assert orbit is None or (orbit.stable and not orbit.flaw and orbit.residual < 1e-11)


def test_irregular_motion_is_simulated_with_the_reason() -> None:
    scene = with_ideal_force(rig.load("fig8-three-dampers"))

    orbits = rig.orbit_response(scene, [33.2, 33.3, 33.6])

    assert orbits.simulated.tolist() == [True, True, False]
    assert "no periodic motion at 33.2 Hz" in orbits.reasons[0]
    assert orbits.reasons[2] == ""
    assert orbits.repetition.tolist() == [0, 0, 1]
    assert np.isnan(orbits.multiplier[0])
    assert orbits.multiplier[2] < 1
    assert orbits.motion_type[0] == "irregular"
    assert np.isfinite(orbits.compliance).all()
    assert orbits.peak.min() > 0


@pytest.mark.parametrize(
    # Values in N, in m, and relative to the damper masses of the scene.
    ("parameter", "values"),
    [("force", [3.0, 3.3, 3.6]), ("clearance", [1.02e-3, 0.98e-3, 0.94e-3]), ("mass_ratio", [0.9, 1.0, 1.1])],
)
def test_orbits_over_parameter_equal_changed_scenes(parameter: str, values: list[float]) -> None:
    scene = with_ideal_force(rig.load("fig9"))
    damper = scene.dampers[0]

    orbits = rig.orbit_response(scene, values, parameter, frequency=49.8)

    for value, compliance in zip(values, orbits.compliance.T, strict=True):
        changed = {
            "force": lambda v: scene.replace(test=scene.test.replace(force=v)),
            "clearance": lambda v: scene.replace(dampers=[damper.replace(clearance=v)]),
            "mass_ratio": lambda v: scene.replace(dampers=[damper.replace(mass_ratio=damper.mass_ratio * v)]),
        }[parameter](value)
        orbit = rig.periodic_orbit(changed, 49.8)
        assert np.abs(orbit.compliance - compliance).max() < 1e-10 * np.abs(compliance).max()


@pytest.mark.parametrize(
    "values",
    [[49.2, 49.5, 49.8, 49.5, 49.3], [49.5, 49.5, 49.5], [49.2, 49.5, 49.2], [49.2, 49.2003, 49.2006, 49.2009, 49.8]],
)
def test_sweep_may_reverse_repeat_or_change_its_spacing(values: list[float]) -> None:
    scene = with_ideal_force(rig.load("fig9"))

    swept = rig.orbit_response(scene, values)

    for value, compliance in zip(values, swept.compliance.T, strict=True):
        orbit = rig.periodic_orbit(scene, value)
        assert np.abs(orbit.compliance - compliance).max() < 1e-10 * np.abs(compliance).max()


def test_error_names_invalid_sweep_arguments() -> None:
    scene = rig.load("fig9")
    with pytest.raises(SceneError, match="expected one or more positive values"):
        rig.orbit_response(scene, [49.0, -1.0])
    with pytest.raises(SceneError, match="Give the frequency at which the force is varied"):
        rig.orbit_response(scene, [3.0], "force")
    with pytest.raises(SceneError, match="expected one of frequency, force"):
        rig.orbit_response(scene, [3.0], "colour")


def test_level_of_drive_has_its_unit() -> None:
    scene = rig.load("fig9").replace(test={"kind": "sine", "frequency": "49.5 Hz", "drive": "5 V"})

    response = rig.orbit_response(scene, ["4.9 V", "5 V"], "drive", frequency=49.5)

    assert np.allclose(response.value, [4.9, 5.0])
    assert "drive_V" in response.columns() and "drive 4.9 to 5 V" in response.summary()
