"""Limits of periodic orbits with closed forms: no damper mass, no clearance, acceleration below gravity."""

import numpy as np
import pytest

import rig
from rig.core.scene.scene import Scene
from rig.core.system.open_loop_drive import with_ideal_force
from rig.core.system.structural_model import receptance
from tests.rig.bouncing_ball import FULL_PERIOD_ACCELERATION_G, fly, take_off_phase

GRAVITY = 9.80665  # m/s^2


def at_body(scene: Scene, body: int, frequency: float, acceleration: float, **damper: float) -> Scene:
    """Return a scene with a damper in a body, driven by the force for an acceleration.

    `acceleration`: amplitude of the body without damper, g; `damper`: further keys of the damper.
    """
    undamped_scene = with_ideal_force(scene).replace(dampers=[])
    compliance = abs(receptance(undamped_scene, [frequency])[body - 1, 0])
    force = acceleration * GRAVITY / ((2 * np.pi * frequency) ** 2 * compliance)
    test = {"kind": "stepped_sine", "frequencies": [frequency], "force": float(force)}
    return undamped_scene.replace(dampers=[{"body": body, **damper}], test=test)


@pytest.mark.parametrize(("body", "frequency"), [(2, 47.0), (3, 30.0), (1, 20.0)])
@pytest.mark.parametrize("acceleration", [1.02, 1.5, 2.4, 3.2])
def test_massless_damper_moves_as_inelastic_ball(acceleration: float, body: int, frequency: float) -> None:
    scene = at_body(rig.load("fig9"), body, frequency, acceleration, mass_ratio=1e-9, clearance=float("inf"))

    orbit = rig.periodic_orbit(scene, frequency)

    start = take_off_phase(acceleration)
    flight = fly(acceleration, start)
    assert orbit.motion_type == "I"
    kinds, angles = orbit.events["kind"], orbit.events["time"] * 2 * np.pi * frequency
    # The force is sin(w t), so that the body moves as sin(w t + phase of its compliance).
    phase = angles[kinds == "separation"][0] + np.angle(orbit.compliance[body - 1])
    assert phase % (2 * np.pi) == pytest.approx(start, abs=1e-6)
    flight_angle = (angles[kinds == "floor"][0] - angles[kinds == "separation"][0]) % (2 * np.pi)
    assert flight_angle == pytest.approx(flight.end - flight.start, abs=1e-6)
    linear_response = receptance(scene.replace(dampers=[]), [frequency])[:, 0]
    assert np.abs(orbit.compliance - linear_response).max() < 1e-6 * np.abs(linear_response).max()


def test_massless_damper_bounces_at_high_acceleration() -> None:
    acceleration = FULL_PERIOD_ACCELERATION_G + 0.1
    scene = at_body(rig.load("fig9"), 2, 47.0, acceleration, mass_ratio=1e-9, clearance=float("inf"))

    orbit = rig.periodic_orbit(scene, 47.0)

    # Events: 1^ separation, 1_ landing, 1v landing of damper 1 with separation at the same instant.
    assert orbit.plan.label == "1v"
    phase = orbit.events["time"][0] * 2 * np.pi * 47.0 + np.angle(orbit.compliance[1])
    # Separation and landing occur at the same phase, where the body's velocity is pi g/w.
    assert np.cos(phase) * acceleration == pytest.approx(np.pi, abs=1e-6)


def test_type_i_branch_ends_at_full_period_flight() -> None:
    scene = at_body(rig.load("fig9"), 2, 47.0, 1.0, mass_ratio=1e-9, clearance=float("inf"))
    force_for_1g = scene.test.force

    curve = rig.follow_orbits(scene, "force", (1.2 * force_for_1g, 3.6 * force_for_1g), frequency=47.0, searches=1)

    # The branch on which damper 1 separates (1^) and lands (1_) once in a period.
    (type_i_branch,) = [branch for branch in curve.branches if branch.plan.label in ("1^ 1_", "1_ 1^")]
    # At the end of the branch the time on the floor is zero: the damper lands at the phase at which it takes off.
    assert type_i_branch.value.max() / force_for_1g == pytest.approx(FULL_PERIOD_ACCELERATION_G, abs=1e-6)
    assert type_i_branch.ends[int(type_i_branch.value[-1] > type_i_branch.value[0])] in (
        "damper 1 leaves its wall early",
        "event 1_ and event 1^ change order",
    )


@pytest.mark.parametrize("change", [{"clearance": 0.0}, {"locked": True}])
@pytest.mark.parametrize(
    ("name", "frequency"), [("fig9", 49.7), ("fig5-three-dampers", 48.0), ("fig8-two-dampers", 13.0)]
)
def test_response_of_fixed_dampers_is_linear_with_their_masses(name, frequency, change):
    scene = with_ideal_force(rig.load(name))
    fixed = scene.replace(dampers=[damper.replace(**change) for damper in scene.dampers])

    orbit = rig.periodic_orbit(fixed, frequency)

    all_dampers = range(1, len(scene.dampers) + 1)
    exact = receptance(scene, [frequency], riding=all_dampers)[:, 0]
    assert np.abs(orbit.compliance - exact).max() < 1e-10 * np.abs(exact).max()
    assert orbit.motion_type == "linear"


def test_small_clearances_tend_to_the_linear_response() -> None:
    scene = with_ideal_force(rig.load("fig9"))
    exact = receptance(scene, [49.5], riding=[1])[:, 0]

    deviations = []
    for clearance in (1e-5, 1e-6, 1e-7):
        orbit = rig.periodic_orbit(scene.replace(dampers=[scene.dampers[0].replace(clearance=clearance)]), 49.5)
        assert orbit.motion_type == "III"
        assert orbit.residual < 1e-11
        deviations.append(np.abs(orbit.compliance - exact).max() / np.abs(exact).max())

    assert deviations[2] < 0.011 * deviations[0]
    assert deviations[2] < 1e-4


@pytest.mark.parametrize(("name", "frequency"), [("fig9", 30.0), ("fig8-three-dampers", 40.0)])
def test_dampers_at_rest_give_the_linear_response(name: str, frequency: float) -> None:
    scene = with_ideal_force(rig.load(name))

    orbit = rig.periodic_orbit(scene, frequency)

    exact = receptance(scene, [frequency], riding=range(1, len(scene.dampers) + 1))[:, 0]
    assert orbit.motion_type == "riding"
    assert len(orbit.events) == 0
    assert np.abs(orbit.compliance - exact).max() < 1e-10 * np.abs(exact).max()
