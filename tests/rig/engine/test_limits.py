"""Limits of the engine with exact results: simultaneous impacts, many periods, extreme ratios, free structures."""

import numpy as np
import pytest

import rig
from rig.core.system.structural_model import receptance
from tests.rig.bouncing_ball import fly, take_off_phase
from tests.rig.engine.exact import Segment

OMEGA = 2 * np.pi * 10.0  # natural frequency, rad/s


def single_body(damper: dict[str, object], damping: float = 0.01, **test: object) -> rig.Scene:
    """Return a body of 1 kg at 10 Hz with a damper of 50 g, driven by a force of 6 N at 9 Hz.

    `damper`, `test`: changed keys of the damper and of the test; `damping`: damping ratio.
    """
    return rig.Scene(
        structure={"masses": [1.0], "springs": [OMEGA**2], "damping": {"modal": damping}},
        dampers=[{"body": 1, "mass": 0.05, "clearance": float("inf"), **damper}],
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 9.0, "force": 6.0, "duration": 1.0, **test},
    )


def free_chain(masses: list[float], springs: list[float], velocity: list[float], **changes: object) -> rig.Scene:
    """Return a chain that moves from x = 0 with initial velocities [m/s]; masses in kg, springs in N/m.

    A first spring of 0 N/m leaves the chain free.
    """
    return rig.Scene(
        structure={"masses": masses, "springs": springs},
        test={"kind": "free", "start": "empty", "velocity": velocity, "duration": 1.0},
        **changes,
    )


@pytest.mark.parametrize(("frequency", "force"), [(9.0, 22.0), (11.0, 20.0), (12.0, 16.0)])
def test_masses_that_fly_together_land_together(frequency: float, force: float) -> None:
    # Both leave the body at the same instant. If rounding decided on the order of their impacts, the second would be
    # slower, because the first has pushed the body.
    scene = single_body({"restitution": 0.4}, frequency=frequency, force=force)
    light = scene.dampers[0].replace(mass=0.02)
    events = rig.simulate(scene.replace(dampers=[scene.dampers[0], light]), 0.5, rate=500.0).events
    landings = events[events["kind"] == "floor"]
    assert len(landings) == 4
    np.testing.assert_allclose(landings["speed"][::2], landings["speed"][1::2], rtol=1e-12)


def test_hundred_thousand_linear_periods_are_exact() -> None:
    scene = rig.load("bare-structure").replace(
        test={"kind": "sine", "frequency": 32.0, "force": 2.6}, shaker={"kind": "force", "body": 1}
    )
    periods_per_sample = 1024
    run = rig.simulate(scene, 123 * periods_per_sample / 32.0, rate=32.0 / periods_per_sample)
    exact = 2.6 * receptance(scene, [32.0])
    # The samples are at w t = 2 pi n, where Im(H F e^{i w t}) = F Im H.
    assert np.abs(run.displacement[:, -100:] - exact.imag).max() < 1e-12 * np.abs(exact).min()


def test_very_light_damper_is_inelastic_bouncing_ball() -> None:
    scene = single_body({"mass": 1e-9}, damping=0.1, force=25.0)
    run = rig.simulate(scene, 12.0, rate=100.0)
    omega = 2 * np.pi * scene.test.frequency
    amplitude = -1j * 25.0 * receptance(scene, [scene.test.frequency])[0, 0]
    acceleration_g = abs(amplitude) * omega**2 / scene.gravity
    separations = run.events["time"][run.events["kind"] == "separation"]
    landings = run.events["time"][run.events["kind"] == "floor"]
    # The displacement of the body is |X| sin(w t + phase). The phases of the last flight have closed forms.
    phase = np.angle(amplitude) + np.pi / 2
    flight = fly(acceleration_g, take_off_phase(acceleration_g))
    take_off_time = separations[separations < landings[-1]][-1]
    assert (omega * take_off_time + phase) % (2 * np.pi) == pytest.approx(flight.start, abs=1e-7)
    assert omega * (landings[-1] - take_off_time) == pytest.approx(flight.end - flight.start, abs=1e-7)


def test_damper_with_nanometer_clearance_moves_as_locked() -> None:
    scene = single_body({"clearance": 1e-9}, force=8.0)
    locked = rig.simulate(scene.replace(dampers=[scene.dampers[0].replace(locked=True)]), 1.0, rate=500.0)
    run = rig.simulate(scene, 1.0, rate=500.0)
    assert {"floor", "ceiling", "separation"} <= set(run.events["kind"])
    assert np.abs(run.acceleration).max() > 1.5 * scene.gravity
    assert np.abs(run.displacement - locked.displacement).max() < 2e-7 * np.abs(locked.displacement).max()


def test_floating_chain_momentum_changes_by_weight_alone() -> None:
    scene = free_chain(
        [1.0, 0.8],
        [0.0, 4e3],
        [1.0, -1.0],
        dampers=[{"body": 1, "mass": 0.1, "clearance": 1e-2}, {"body": 2, "mass": 0.2, "clearance": 5e-3}],
    )
    run = rig.simulate(scene, 3.0, rate=1000.0)
    assert len(run.events) > 50
    # The dampers have 0.1 kg and 0.2 kg; with them the bodies have 1.1 kg and 1.0 kg. Initial velocities: 1 and -1 m/s.
    weight = 0.3 * scene.gravity
    # Compare only while both dampers are in contact: their velocities are then those of the bodies.
    in_contact = (run.contact > 0).all(axis=0)
    momentum = 1.1 * run.velocity[0] + 1.0 * run.velocity[1]
    expected = 0.2 + 0.1 * 1.0 + 0.2 * -1.0 - weight * run.time
    assert in_contact.sum() > 5
    np.testing.assert_allclose(momentum[in_contact], expected[in_contact], rtol=1e-12, atol=1e-12)


def test_floating_chain_moves_as_closed_form() -> None:
    run = rig.simulate(free_chain([1.0, 3.0], [0.0, 4e3], [1.0, 0.0]), 2.0, rate=100.0)
    # Bodies of 1 kg and 3 kg with a spring of 4 kN/m; body 1 starts at 1 m/s.
    omega = np.sqrt(4e3 * (1 + 1 / 3))
    center_of_mass = 0.25 * run.time
    exact = center_of_mass + 0.75 * np.sin(omega * run.time) / omega
    np.testing.assert_allclose(run.displacement[0], exact, atol=1e-12 * np.abs(exact).max())


def test_extremely_stiff_spring_is_exact() -> None:
    scene = free_chain([0.74, 0.71, 0.64], [24.3e3, 1e9, 19.8e3], [0.1, 0.2, -0.1])
    run = rig.simulate(scene, 0.01, rate=1000.0)
    segment = Segment(scene, ())
    exact = segment.propagate(segment.initial_state(velocities=[0.1, 0.2, -0.1]), segment.gravity * 0 + run.time[-1])
    for body in range(3):
        assert run.displacement[body, -1] == pytest.approx(float(exact[body]), rel=1e-12)


def test_rebounds_end_in_finite_time() -> None:
    # Strong damping soon stops the body: a light damper then bounces on a body at rest, in a geometric sequence.
    scene = rig.Scene(
        structure={"masses": [1.0], "springs": [OMEGA**2], "damping": {"modal": 0.9}},
        dampers=[{"body": 1, "mass": 1e-9, "clearance": float("inf"), "restitution": 0.95}],
        test={"kind": "free", "displacement": [0.05], "duration": 1.0},
    )
    run = rig.simulate(scene, 12.0, rate=100.0)
    impacts = run.events[run.events["kind"] == "floor"]
    at_rest = impacts[impacts["time"] > 2.0]  # impacts on the body at rest
    speeds = at_rest["speed"][at_rest["speed"] > 1e-6]
    np.testing.assert_allclose(speeds[1:] / speeds[:-1], 0.95, rtol=1e-6)
    # Sum of the geometric sequence of flight times: restitution 0.95, 1 - 0.95 = 0.05.
    end_time = at_rest["time"][0] + 2 * 0.95 * at_rest["speed"][0] / scene.gravity / 0.05
    assert impacts["time"][-1] == pytest.approx(end_time, rel=1e-6)
    assert run.contact[0, -1] == 1
    assert 100 < len(impacts) < 1000


def test_motion_from_rest_starts_without_gravity() -> None:
    # The chain transmits the motion from the last body to the first, where it grows from 1e-44 m within a time step.
    scene = rig.Scene(
        structure={
            "masses": [0.11002458568653148, 1.1563741336422235, 0.8650154381354124, 0.5589685712008674],
            "springs": [3699.72289403043, 5570.6876759970755, 99383.2562955681, 3125.705662195247],
        },
        gravity=0.0,
        dampers=[
            {"body": 1, "mass": 0.147, "clearance": 3.5e-4, "contact": {"duration": 0.002}},
            {"body": 2, "mass": 0.221, "clearance": 7.2e-4, "restitution": 0.5},
            {"body": 4, "mass": 0.02498, "clearance": 1.88e-5},
            {"body": 4, "mass": 0.02539, "clearance": 1.22e-4, "restitution": 0.999},
        ],
        shaker={"kind": "table", "body": 4, "spring": 2339.075802989847},
        test={"kind": "sine", "frequency": 38.18785175, "force": 0.92, "start": "empty", "duration": 1.0},
    )
    run = rig.simulate(scene, 0.5, rate=2000.0)
    assert set(run.events["damper"]) == {1, 2, 3, 4}
    assert (run.gap[1:] > -1e-15).all()
    # The table moves at all 3000 discontinuities, most of them without a jump: 11 J together, and the work is 0.09 mJ.
    assert abs(run.energy.residual) < 1e-12 * abs(run.energy.work)
