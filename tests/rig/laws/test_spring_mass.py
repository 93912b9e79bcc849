"""Tuned mass dampers: fixed points of Den Hartog, multipliers, and studies."""

from math import pi, sqrt
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rig
from rig.core.orbits.periodic_orbit import set_to_orbit, start_propagator
from rig.core.orbits.problem import OrbitProblem
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import separation_levels
from rig.core.system.structural_model import receptance
from rig.studies.motion_map.grid import vertical_axis

MASS, STIFFNESS, MASS_RATIO = 1.0, 4e3, 0.05
MIXED = {"body": 2, "mass_ratio": "6 %", "clearance": "0.98 mm"}
TUNED = rig.load("tuned-mass-damper")


def den_hartog(damping_ratio: float) -> rig.Scene:
    """Return an undamped body with a damper of the optimal frequency, driven by 1 N."""
    omega, mass = sqrt(STIFFNESS / MASS) / (1.0 + MASS_RATIO), MASS_RATIO * MASS
    damper = {"body": 1, "mass": mass, "spring": mass * omega**2, "damping": 2.0 * damping_ratio * mass * omega}
    content: dict[str, Any] = {
        "structure": {"masses": [MASS], "springs": [STIFFNESS]},
        "dampers": [damper],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": 10.0, "force": 1.0},
    }
    return rig.load(content)


def with_particle_damper(restitution: float = 0.0) -> rig.Scene:
    """Return the third mode of a structure with a particle damper and a tuned mass damper, 3.3 N."""
    test = {"kind": "sine", "frequency": 49.6, "force": 3.3}
    dampers = [{"body": 3, "mass": 0.03, "spring": 2.7e3, "damping": 2.0}, MIXED | {"restitution": restitution}]
    return TUNED.replace(dampers=dampers, test=test)


@pytest.mark.parametrize("damping_ratio", [0.02, 0.127, 0.5])
def test_fixed_points_are_those_of_den_hartog(damping_ratio: float) -> None:
    # At two frequencies the amplitude is sqrt(1 + 2 / mu) times the static one, for any damping.
    spread = sqrt(MASS_RATIO / (2.0 + MASS_RATIO))
    ratios = np.sqrt((1.0 + np.array([-spread, spread])) / (1.0 + MASS_RATIO))
    frequencies = ratios * sqrt(STIFFNESS / MASS) / (2.0 * pi)
    response = rig.frequency_response(den_hartog(damping_ratio), frequencies)
    expected = sqrt(1.0 + 2.0 / MASS_RATIO) / STIFFNESS
    np.testing.assert_allclose(np.abs(response.compliance[0]), expected, rtol=1e-6)
    np.testing.assert_allclose(np.abs(receptance(den_hartog(damping_ratio), frequencies)[0]), expected, rtol=1e-12)


def test_optimal_damping_levels_both_peaks() -> None:
    optimum = sqrt(3.0 * MASS_RATIO / (8.0 * (1.0 + MASS_RATIO)))
    frequencies = np.linspace(7.0, 13.0, 4001)
    peaks = {
        factor: np.abs(receptance(den_hartog(factor * optimum), frequencies)[0]).max() for factor in (0.8, 1.0, 1.25)
    }
    assert peaks[1.0] < min(peaks[0.8], peaks[1.25])
    assert peaks[1.0] == pytest.approx(sqrt(1.0 + 2.0 / MASS_RATIO) / STIFFNESS, rel=0.01)


def test_rest_is_an_equilibrium() -> None:
    test = {"kind": "free", "displacement": [0.0, 0.0, 0.0], "duration": 0.2}
    run = rig.simulate(TUNED.replace(shaker=None, test=test), duration=0.2, rate=1000.0)
    assert np.abs(run.gap).max() < 1e-15 and np.ptp(run.displacement) < 1e-3
    assert np.abs(run.velocity).max() < 1e-13


def test_orbit_without_walls_is_the_receptance() -> None:
    orbits = rig.orbit_response(TUNED, [11.0, 12.5, 14.0])
    np.testing.assert_allclose(orbits.compliance, receptance(TUNED, [11.0, 12.5, 14.0]), rtol=1e-8)
    assert set(orbits.motion_type) == {"linear"}


def test_multipliers_are_those_of_the_poles() -> None:
    orbit = rig.periodic_orbit(TUNED, 12.4)
    expected = np.exp(assemble(TUNED).poles / 12.4)
    np.testing.assert_allclose(np.sort_complex(orbit.multipliers), np.sort_complex(expected), rtol=1e-9)


def test_multipliers_with_impacts_are_those_of_differences() -> None:
    scene = with_particle_damper()
    orbit = rig.periodic_orbit(scene, 49.6)
    propagator, steps = start_propagator(OrbitProblem(scene), orbit.operating_point)
    state, n, flying, change = propagator.state, assemble(scene).states, orbit.plan.flying, 1e-7

    def state_after_a_period(unknown: int, disturbance: float) -> NDArray[np.float64]:
        set_to_orbit(propagator, orbit)
        start = np.concatenate([state.z[:n], state.height[flying], state.velocity[flying]])
        start[unknown] += disturbance
        state.z[:n], state.height[flying], state.velocity[flying] = np.split(start, [n, n + flying.size])
        propagator.propagate_periods(steps, 1)
        return np.concatenate([state.z[:n], state.height[flying], state.velocity[flying]])

    columns = [
        (state_after_a_period(i, change) - state_after_a_period(i, -change)) / (2.0 * change)
        for i in range(n + 2 * flying.size)
    ]
    largest, computed = (np.sort(np.abs(values))[-6:] for values in (np.linalg.eigvals(columns), orbit.multipliers))
    np.testing.assert_allclose(computed, largest, rtol=1e-4)


def test_orbits_follow_the_mass_factor() -> None:
    scene = with_particle_damper()
    curve = rig.follow_orbits(scene, "mass_ratio", (1.0, 1.02), frequency=49.6)
    heavier = [scene.dampers[0].replace(mass=1.02 * 0.03), scene.dampers[1].replace(mass_ratio=1.02 * 0.06)]
    expected = rig.frequency_response(scene.replace(dampers=heavier), [49.6])
    branch = curve.branches[0]
    assert branch.value.max() == pytest.approx(1.02)
    last = branch.compliance[:, np.argmax(branch.value)]
    np.testing.assert_allclose(np.abs(last), np.abs(expected.compliance[:, 0]), rtol=1e-5)


def test_explanation_states_frequency_and_damping_ratio() -> None:
    explanation = rig.explain(TUNED)
    assert explanation.states["motion"] == 8
    assert "60 g on 365 N/m and 1.19 N s/m (12.41 Hz, damping ratio 12.7 %)" in str(explanation)


def test_only_walls_limit_the_level() -> None:
    mixed = with_particle_damper()
    assert np.isfinite(separation_levels(mixed, np.array([20.0, 49.0]))).all()
    with pytest.raises(rig.SceneError, match="no damper that can hit a wall"):
        vertical_axis(TUNED, None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"restitution": 0.3}, "no walls. Add a clearance, or remove restitution"),
        ({"contact": {"duration": "2 ms"}}, "or remove contact"),
        ({"clearance": "1 mm", "grains": {"diameter": "1 mm"}}, "a bed of grains cannot be on a spring"),
        ({"spring": None, "clearance": 1e-3, "clearance_below": 1e-3}, "a bed rests on its floor"),
        ({"spring": None}, "clearance: missing"),
    ],
)
def test_walls_with_a_spring_are_reported(changes: dict[str, Any], message: str) -> None:
    damper = {"body": 1, "mass": "50 g", "spring": "1 kN/m"} | changes
    with pytest.raises(rig.SceneError, match=message):
        rig.load({"structure": {"masses": [1.0], "springs": [1e4]}, "dampers": [damper]})
