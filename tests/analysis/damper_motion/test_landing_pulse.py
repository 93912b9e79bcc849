"""Velocity change of a body during an impact of finite duration, compared with a numerical solution."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rig
from analysis.core.damper_motion.landing_pulse import landing_pulse, transmissibility
from rig.core.base.errors import RecordingError


def with_damper(**damper):
    return rig.load("fig9").replace(dampers=[{"body": 2, "mass": 0.05, "clearance": float("inf"), **damper}])


@pytest.mark.parametrize(
    "contact",
    [
        {"contact": {"duration": 2e-3}, "restitution": 0.4},
        {"contact": {"duration": 2e-3}, "restitution": 0.0},
        # Critical damping of the reduced mass of damper (0.05 kg) and body (0.71 kg).
        {"contact": {"stiffness": 1e5, "damping": 2.0 * np.sqrt(1e5 * 0.05 * 0.71 / 0.76)}},
    ],
)
def test_contact_agrees_with_numerical_solution(contact):
    scene = with_damper(**contact)
    pulse = landing_pulse(scene, "body 2", 5120.0)
    stiffness, damping = pulse.angular_frequency**2, 2.0 * pulse.damping_ratio * pulse.angular_frequency
    time = np.linspace(0.0, pulse.duration, 50)
    motion = solve_ivp(
        lambda _, z: [z[1], -stiffness * z[0] - damping * z[1]],
        (0.0, time[-1]),
        [0.0, 1.0],
        t_eval=time,
        rtol=1e-10,
        atol=1e-14,
    ).y
    assert pulse.velocity_change_ratio(time) == pytest.approx((1.0 - motion[1]) / (1.0 - motion[1, -1]), abs=1e-5)
    # At release the force is zero, and the speed ratio equals the coefficient of restitution.
    assert stiffness * motion[0, -1] + damping * motion[1, -1] == pytest.approx(0.0, abs=1e-3 * pulse.angular_frequency)
    assert pulse.restitution == pytest.approx(-motion[1, -1], abs=1e-5)
    if scene.dampers[0].restitution:
        assert pulse.restitution == pytest.approx(0.4, abs=1e-6)


def test_short_contact_has_no_pulse():
    # Within a sample interval the velocity change is a jump.
    scene = with_damper(contact={"duration": 2e-5})
    assert landing_pulse(scene, "body 2", 5120.0) is None
    assert landing_pulse(scene, "body 2", 51200.0) is not None
    assert landing_pulse(with_damper(), "body 2", 5120.0) is None


def test_mixed_contacts_are_reported():
    [damper] = with_damper(contact={"duration": 2e-3}).dampers
    scene = rig.load("fig9").replace(dampers=[damper, damper.replace(contact=None)])
    with pytest.raises(RecordingError, match="restitutions of floor, ceiling or dampers differ"):
        landing_pulse(scene, "body 2", 5120.0)


def test_grains_are_rejected():
    scene = with_damper(grains={"diameter": 2e-3})
    with pytest.raises(RecordingError, match="body 2: the grains of a bed"):
        landing_pulse(scene, "body 2", 5120.0)


def test_transmissibility_of_soft_floor_is_closed_form():
    scene = with_damper(contact={"stiffness": 5e4, "damping": 10.0})
    frequency = np.array([0.0, 30.0, 100.0])
    s = 2j * np.pi * frequency
    expected = (5e4 + 10.0 * s) / (5e4 + 10.0 * s + 0.05 * s**2)
    assert transmissibility(scene, 1, frequency) == pytest.approx(expected, rel=1e-12)
    assert transmissibility(with_damper(), 1, frequency) == pytest.approx(np.ones(3))
