"""Stops: the bilinear oscillator, hard cases, and studies."""

from math import pi, sqrt
from typing import Any

import numpy as np
import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import separation_levels
from rig.core.system.structural_model import receptance


def two_bodies(*joints: dict[str, Any], force: float = 10.0, **changes: Any) -> rig.Scene:
    """Return two bodies with stops, driven at the first body."""
    content: dict[str, Any] = {
        "structure": {"masses": [1.0, 0.5], "springs": [3e4, 1.2e4], "damping": {"modal": 0.01}},
        "joints": list(joints) or [{"between": [1, 2], "gap": 1e-4, "stiffness": 2e5, "damping": 5.0}],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": 22.0, "force": force},
    }
    return rig.load(content | changes)


@pytest.mark.parametrize(("between", "sign"), [(["ground", 1], 1.0), ([1, "ground"], -1.0)])
def test_free_period_is_that_of_the_bilinear_oscillator(between: list[Any], sign: float) -> None:
    mass, stiffness, contact = 1.0, 1e3, 3e3
    scene = rig.load(
        {
            "structure": {"masses": [mass], "springs": [stiffness]},
            "gravity": 0.0,
            "joints": [{"between": between, "gap": 0.0, "stiffness": contact}],
            "test": {"kind": "free", "displacement": [sign * 1e-3]},
        }
    )
    run = rig.simulate(scene, duration=5.0, rate=1000.0)
    touches = run.events["time"][run.events["kind"] == "touch"]
    expected = pi * sqrt(mass / stiffness) + pi * sqrt(mass / (stiffness + contact))
    np.testing.assert_allclose(np.diff(touches), expected, rtol=1e-13)
    assert abs(run.energy.residual) < 1e-12 * run.energy.stored


def test_open_stop_does_not_change_the_response() -> None:
    scene, frequencies = two_bodies(force=0.1), [15.0, 22.0]
    response = rig.frequency_response(scene, frequencies)
    assert set(response.motion_type) == {"linear"}
    np.testing.assert_allclose(response.compliance, receptance(scene.replace(joints=()), frequencies), rtol=1e-6)


def test_curve_of_orbits_ends_where_a_stop_opens() -> None:
    scene = two_bodies({"between": ["ground", 1], "gap": 1e-4, "stiffness": 1e5})
    curve = rig.follow_orbits(scene, "force", (0.5, 10.0), frequency=15.0)
    assert any("joint 1" in end for branch in curve.branches for end in branch.ends)


def test_map_starts_at_the_level_of_first_contact() -> None:
    scene = two_bodies({"between": ["ground", 1], "gap": 1e-4, "stiffness": 1e5})
    [level] = separation_levels(scene, np.array([15.0]))
    assert rig.frequency_response(scene.replace(test={**SINE, "force": 0.99 * level}), [15.0]).impacts.sum() == 0.0
    assert rig.frequency_response(scene.replace(test={**SINE, "force": 1.01 * level}), [15.0]).impacts.sum() > 0.0


SINE = {"kind": "sine", "frequency": 15.0}


def test_rebound_has_the_given_restitution() -> None:
    # Springs change the speeds during the short contact by less than the tolerance.
    bodies = {"masses": [1.0, 0.5], "springs": [10.0, 10.0]}
    joint = {"between": [1, 2], "gap": 1e-6, "stiffness": 1e10, "restitution": 0.3}
    test = {"kind": "free", "velocity": [0.0, -1.0]}
    scene = rig.load({"structure": bodies, "gravity": 0.0, "joints": [joint], "test": test})
    run = rig.simulate(scene, duration=1e-4, rate=1e5)
    assert list(run.events["kind"]) == ["touch", "release"]
    assert run.velocity[1, -1] - run.velocity[0, -1] == pytest.approx(0.3, rel=1e-5)


def test_restitution_excludes_damping() -> None:
    joint = {"between": [1, 2], "gap": 1e-3, "stiffness": 1e5, "damping": 5.0, "restitution": 0.3}
    with pytest.raises(SceneError, match="restitution and damping are given together"):
        two_bodies(joint)


def test_weight_of_a_bed_closes_a_stop_at_rest() -> None:
    bed = {"body": 1, "mass": 0.5, "clearance": 1e-3}
    scene = two_bodies({"between": ["ground", 1], "gap": 0.0, "stiffness": 7e4}, dampers=[bed])
    system = assemble(scene)
    assert system.elements[-1].law.start == "on floor"
    assert system.initial[0] == pytest.approx(-0.5 * scene.gravity / (3e4 + 7e4), rel=1e-12)


def test_events_name_the_joint() -> None:
    run = rig.simulate(two_bodies(dampers=[{"body": 2, "mass": 0.02, "clearance": 1e-3}]), duration=0.2)
    of_joint = run.events["joint"] == 1
    assert set(run.events["kind"][of_joint]) == {"touch", "release"}
    np.testing.assert_array_equal(run.events["damper"], np.where(of_joint, 0, 1))


def test_explanation_describes_the_stop() -> None:
    assert "stop between body 1 and body 2, gap 0.1 mm, 2e+05 N/m, 5 N s/m" in str(rig.explain(two_bodies()))


def test_too_many_joints_are_refused() -> None:
    joint = {"between": [1, 2], "gap": 1e-4, "stiffness": 2e5}
    with pytest.raises(SceneError, match="expected at most 31 together"):
        rig.simulate(two_bodies(*[joint] * 32), duration=0.1)


BED = {"body": 1, "mass": 0.05, "clearance": 1e-3}


@pytest.mark.parametrize("study", [rig.design, lambda scene: rig.approximate_response(scene, 1, ("10 Hz", "30 Hz"))])
def test_studies_of_linear_structures_refuse_joints(study: Any) -> None:
    with pytest.raises(SceneError, match=r"^joints: .* Remove"):
        study(two_bodies(dampers=[BED]))
