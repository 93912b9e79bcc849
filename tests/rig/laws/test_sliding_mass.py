"""Horizontal dampers with friction: closed forms, hard cases, and mistakes in scenes."""

from math import asin, inf, pi, sqrt, tan
from typing import Any

import numpy as np
import pytest

import rig
from rig.core.laws.law import faults
from rig.core.laws.sliding_mass import sliding_mass
from rig.core.system.assembly import assemble
from rig.core.system.structural_model import receptance
from tests.rig.laws.test_declarations import assert_motion_as_declared

GRAVITY = 9.80665


def scene_with(force: float, frequency: float, *dampers: dict[str, Any], **changes: Any) -> rig.Scene:
    """Return two bodies with dampers under a tone on body 1, N and Hz."""
    content: dict[str, Any] = {
        "structure": {"masses": [1.0, 0.8], "springs": [6e3, 5e3], "damping": {"modal": 0.01}},
        "dampers": [{"body": 1, "mass": 0.2, "friction": 0.3, "clearance": inf} | damper for damper in dampers],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": frequency, "force": force},
    }
    return rig.load(content | changes)


@pytest.mark.parametrize("slip_force", [0.0, 0.4])
@pytest.mark.parametrize("restitution", [0.0, 0.5])
@pytest.mark.parametrize("clearance", [1e-3, inf])
def test_declarations_have_no_faults(slip_force: float, restitution: float, clearance: float) -> None:
    assert faults(sliding_mass(slip_force, restitution, clearance)) == []


def test_continuous_sliding_is_that_of_den_hartog() -> None:
    # Friction on the body is a square wave, and the velocity of the mass a triangle: the response of an undamped body
    # between two reversals is known. The phase of the reversals follows from equal velocities.
    mass, stiffness, sliding, friction, force, frequency = 1.0, 4e3, 0.2, 0.3, 30.0, 14.0
    scene = rig.load(
        {
            "structure": {"masses": [mass], "springs": [stiffness]},
            "dampers": [{"body": 1, "mass": sliding, "friction": friction, "clearance": inf}],
            "shaker": {"kind": "force", "body": 1},
            "test": {"kind": "sine", "frequency": frequency, "force": force},
        }
    )
    omega, natural, slip_force = 2 * pi * frequency, sqrt(stiffness / mass), friction * sliding * GRAVITY
    amplitude, offset = force / (stiffness - mass * omega**2), slip_force / stiffness
    slope = -offset * natural * tan(pi * natural / omega / 2)
    phase = pi - asin((slope - slip_force * pi / (2 * sliding * omega)) / (amplitude * omega))
    time = np.linspace(0.0, pi / omega, 20_001)
    shape = offset * (1.0 - np.cos(natural * time)) + slope / natural * np.sin(natural * time)
    expected = np.abs(amplitude * np.cos(omega * time + phase) + shape).max()

    orbit = rig.periodic_orbit(scene, frequency)

    assert orbit.plan.label == "1x 1x" and orbit.stable
    assert orbit.peak[0] == pytest.approx(expected, rel=1e-7)
    reversals = orbit.events["time"][orbit.events["kind"] == "stop"]
    assert np.diff(reversals)[0] == pytest.approx(0.5 / frequency, rel=1e-11)


def test_mass_sticks_below_the_slip_force() -> None:
    # At the threshold the acceleration of the body is friction times gravity.
    level = 1.0 / (np.abs(receptance(scene_with(1.0, 8.0, {}), [8.0], riding=[1])[0, 0]) * (16.0 * pi) ** 2)
    level *= 0.3 * GRAVITY
    below, above = (rig.periodic_orbit(scene_with(factor * level, 8.0, {}), 8.0) for factor in (0.999, 1.001))
    assert below.motion_type == "riding" and below.margin == pytest.approx(0.3e-3, rel=1e-6)
    assert above.motion_type == "2 slips per 1"


HARD_CASES: dict[str, tuple[dict[str, Any], ...]] = {
    "equal dampers": ({"body": 1}, {"body": 2}, {"body": 2}),
    "plastic walls": ({"clearance": 2e-3}, {"body": 2, "clearance": 1e-3}),
    "chattering to rest": ({"clearance": 1e-3, "restitution": 0.9},),
    "no friction": ({"friction": 0.0, "clearance": 1e-3, "restitution": 0.3},),
    "light and heavy": (
        {"mass": "0.1 g", "clearance": 2e-3},
        {"body": 2, "mass": None, "mass_ratio": "1000 %", "clearance": 2e-3},
    ),
    "friction that never slips": ({"friction": 1e6},),
    "weak friction": ({"friction": 1e-9},),
    "next to a bed": ({"clearance": 2e-3}, {"friction": None, "clearance": 1e-3}),
}


@pytest.mark.parametrize("case", HARD_CASES)
def test_hard_cases_move_as_declared(case: str) -> None:
    assert_motion_as_declared(scene_with(30.0, 14.0, *HARD_CASES[case]), periods=6, tolerance=1e-10)


def test_without_gravity_there_is_no_friction() -> None:
    run = rig.simulate(scene_with(30.0, 14.0, {}, gravity=0.0), duration=0.5, rate=2000.0)
    assert not len(run.events) and np.ptp(run.gap) > 1e-3


def test_without_clearance_the_mass_is_part_of_the_body() -> None:
    assert assemble(scene_with(30.0, 14.0, {"clearance": 0.0})).dampers == 0


def test_mass_starts_in_the_middle_of_loaded_structure() -> None:
    bed = {"body": 2, "friction": None, "mass": 0.1, "clearance": 1e-3}
    system = assemble(scene_with(1.0, 14.0, {"clearance": 2e-3}, bed))
    assert system.initial[2] == 0.0 and system.initial[1] < 0.0


def test_friction_dissipates_the_energy_of_a_free_body() -> None:
    test = {"kind": "free", "displacement": [5e-3, 0.0], "duration": 3.0}
    run = rig.simulate(scene_with(1.0, 14.0, {}, shaker=None, test=test), duration=3.0, rate=1000.0)
    assert run.events["kind"][-1] == "stop"
    # A stop makes a speed that is zero within rounding exactly zero, a jump of 1e-17 m/s.
    assert abs(run.energy.impacts) < 1e-16 * run.energy.stored_before
    assert np.ptp(run.gap[0, -50:]) == 0.0


@pytest.mark.parametrize(("parameter", "end"), [("force", 31.0), ("mass_ratio", 1.03), ("clearance", 2.05e-3)])
def test_orbits_follow_each_parameter(parameter: Any, end: float) -> None:
    scene = scene_with(30.0, 14.0, {"clearance": 2e-3})
    start = {"force": 30.0, "mass_ratio": 1.0, "clearance": 2e-3}[parameter]
    curve = rig.follow_orbits(scene, parameter, (start, end), frequency=14.0)
    damper = {"clearance": end if parameter == "clearance" else 2e-3}
    damper["mass"] = 0.2 * end if parameter == "mass_ratio" else 0.2
    expected_scene = scene_with(end if parameter == "force" else 30.0, 14.0, damper)
    expected = rig.frequency_response(expected_scene, [14.0]).compliance[:, 0]
    branch = curve.branches[0]
    np.testing.assert_allclose(branch.compliance[:, np.argmax(branch.value)], expected, rtol=1e-5)


def test_explanation_states_the_slip_force() -> None:
    text = str(rig.explain(scene_with(30.0, 14.0, {"clearance": 2e-3})))
    assert "200 g, slips above 2.942 m/s² (0.5884 N), 2 mm between walls" in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"spring": "1 kN/m"}, "Remove spring, or remove friction"),
        ({"contact": {"duration": "2 ms"}}, "Remove contact"),
        ({"grains": {"diameter": "2 mm"}}, "Remove grains"),
        ({"restitution": 0.3}, "the mass has no walls"),
        ({"friction": -0.1}, "friction"),
        ({"clearance_below": 1e-3}, "walls. Remove clearance_below."),
        ({"damping": 1.0}, "mass on a spring. Remove damping."),
    ],
)
def test_mistakes_are_reported(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(rig.SceneError, match=message):
        scene_with(1.0, 10.0, changes)


def test_force_at_the_start_makes_the_mass_slip() -> None:
    scene = scene_with(1.0, 9.0, {})
    drive = np.full((1, 20), 60.0)
    simulated, plant = rig.simulate(scene, 0.01, 1000.0, drive=drive), rig.Plant(scene, 1000.0)
    for events in (simulated.events, plant.advance(drive).events):
        assert (events["kind"][0], events["time"][0]) == ("slip", 0.0)
