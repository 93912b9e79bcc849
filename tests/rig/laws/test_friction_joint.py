"""Joints with friction: the loss of a cycle, the start of slip, hard cases, and descriptions."""

from math import pi
from typing import Any

import numpy as np
import pytest

import rig
from rig.core.simulation.run_output import summary

SLIP_FORCE, STIFFNESS = 2.0, 6e3
JOINT = {"between": ["ground", 1], "slip_force": SLIP_FORCE, "stiffness": STIFFNESS}


def one_body(force: float, damping: float = 0.0, *joints: dict[str, Any]) -> rig.Scene:
    """Return a body with a joint to ground, at a force, N."""
    return rig.load(
        {
            "structure": {"masses": [1.0], "springs": [4e3], "damping": {"modal": damping}},
            "gravity": 0.0,
            "joints": [JOINT, *joints],
            "shaker": {"kind": "force", "body": 1},
            "test": {"kind": "sine", "frequency": 9.0, "force": force},
        }
    )


def two_bodies(**changes: Any) -> rig.Scene:
    """Return two bodies with a joint between them, and a stop."""
    content: dict[str, Any] = {
        "structure": {"masses": [1.0, 0.5], "springs": [3e4, 1.2e4], "damping": {"modal": 0.01}},
        "joints": [
            {"between": [1, 2], "slip_force": 3.0, "stiffness": 4e4},
            {"between": ["ground", 1], "gap": 1e-4, "stiffness": 1e5, "damping": 5.0},
        ],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": 22.0, "force": 10.0},
    }
    return rig.load(content | changes)


def test_loss_of_a_cycle_is_that_of_the_jenkins_element() -> None:
    force = 5.0
    orbit = rig.periodic_orbit(one_body(force), 9.0)
    work = pi * force**2 * -orbit.compliance[0].imag
    assert orbit.plan.label == "1/ 1| 1\\ 1|" or len(orbit.events) == 4
    assert work == pytest.approx(4.0 * SLIP_FORCE * (orbit.peak[0] - SLIP_FORCE / STIFFNESS), rel=1e-10)


def test_joint_slips_at_its_slip_force() -> None:
    # Below the slip force, the structure with the spring of the joint is linear.
    level = SLIP_FORCE / STIFFNESS * abs(4e3 + STIFFNESS - (18.0 * pi) ** 2)
    below, above = (rig.periodic_orbit(one_body(factor * level, 0.01), 9.0) for factor in (0.99, 1.01))
    assert below.motion_type == "linear" and not len(below.events)
    assert above.motion_type == "2 slips per 1"


def test_weight_of_a_bed_does_not_load_the_joint() -> None:
    bed = {"body": 1, "mass": 0.5, "clearance": 1e-3}
    run = rig.simulate(two_bodies(dampers=[bed], test=None), duration=0.1)
    assert not len(run.events) and np.abs(run.velocity).max() < 1e-12


def test_displaced_body_slips_before_its_release() -> None:
    scene = one_body(1.0).replace(test={"kind": "free", "displacement": [5e-3]})
    run = rig.simulate(scene, duration=0.5, rate=2000.0)
    # The joint pushes with the slip force at the start.
    assert run.acceleration[0, 0] == pytest.approx(-(4e3 * 5e-3 + SLIP_FORCE), rel=1e-12)
    assert set(run.events["kind"]) == {"slip", "stop"}


def test_equal_joints_slip_and_stop_together() -> None:
    events = rig.simulate(one_body(9.0, 0.01, JOINT), duration=1.0).events
    first, second = (events[events["joint"] == joint] for joint in (1, 2))
    assert {"slip", "stop"} == set(first["kind"])
    np.testing.assert_array_equal(first["kind"], second["kind"])
    np.testing.assert_array_equal(first["time"], second["time"])


def test_summary_of_slips_states_no_impact() -> None:
    text = summary(rig.simulate(one_body(9.0, 0.01), duration=1.0))
    assert "joint 1: slip" in text and "fastest impact" not in text


def test_explanation_describes_the_joint() -> None:
    assert "friction joint between body 1 and body 2, slips at 3 N, 4e+04 N/m" in str(rig.explain(two_bodies()))
