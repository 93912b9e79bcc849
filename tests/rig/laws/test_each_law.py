"""Each contact law: an independent oracle, balance of energy, and orbits compared with simulated motions."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest

import rig
from rig.core.orbits.periodic_orbit import set_to_orbit, start_propagator
from rig.core.orbits.problem import OrbitProblem
from tests.rig.laws.orbit_differences import (
    assert_derivatives_are_those_of_differences,
    assert_multipliers_are_those_of_differences,
)
from tests.rig.laws.random_scenes import KINDS, random_friction, random_scene, random_stop
from tests.rig.laws.test_declarations import assert_motion_as_declared
from tests.rig.laws.test_friction_joint import two_bodies as with_friction_joint
from tests.rig.laws.test_impact_damper import driven as with_impact_damper
from tests.rig.laws.test_sliding_mass import HARD_CASES
from tests.rig.laws.test_sliding_mass import scene_with as with_sliding_masses
from tests.rig.laws.test_spring_mass import with_particle_damper
from tests.rig.laws.test_stop import two_bodies as with_stops

#: Kinds of dampers and joints in random scenes, by the law that they contain.
RANDOM: dict[str, Callable[[int], rig.Scene]] = {
    "all dampers": lambda seed: random_scene(seed, *KINDS),
    "tuned mass damper": lambda seed: random_scene(seed, "tuned", "bed"),
    "impact damper": lambda seed: random_scene(seed, "impact", "bed"),
    "sliding mass": lambda seed: random_scene(seed, "sliding", "bed"),
    "stop": lambda seed: random_scene(seed, *KINDS, joint=random_stop),
    "friction joint": lambda seed: random_scene(seed, *KINDS, joint=random_friction),
}


class Case(NamedTuple):
    """A motion under a tone whose orbit contains events of a law."""

    scene: Callable[[], rig.Scene]
    frequency: float  # Hz
    motion_type: str
    loss: str  # part of the energy balance that contains at least 1 % of the work, besides the structure
    parameters: tuple[str, ...] = ("frequency", "level")


STOP, DAMPED = {"between": ["ground", 1], "gap": 1e-4, "stiffness": 1e5}, {"stiffness": 2e5, "damping": 5.0}
OF_IMPACT_DAMPER = ("frequency", "level", "clearance", "mass_ratio")


def impact_case(motion_type: str, loss: str, **damper: Any) -> Case:
    """Return a case of a mass on a spring between walls."""
    return Case(partial(with_impact_damper, 6.0, **damper), 10.0, motion_type, loss, OF_IMPACT_DAMPER)


CASES = {
    "stop": Case(partial(with_stops, {"between": [1, 2], "gap": 1e-4} | DAMPED), 22.0, "4 per 2", "contacts"),
    "two stops": Case(
        partial(with_stops, {"between": [2, 1], "gap": 1e-4, "stiffness": 1e5}, STOP), 22.0, "1 per 1/2 per 1", ""
    ),
    "stop without gap": Case(
        partial(with_stops, {"between": [1, "ground"], "gap": 0.0, "stiffness": 5e4, "damping": 20.0}),
        22.0, "1 per 1", "contacts",
    ),
    "friction joint": Case(with_friction_joint, 22.0, "1 per 1/3 slips per 1", "dissipated"),
    "impact damper": impact_case("I", "impacts", restitution=0.4),
    "rest on two walls": impact_case("III", "impacts", restitution=0.0, clearance="1 mm"),
    "finite contact": impact_case("I", "contacts", contact={"duration": "2 ms"}),
    "wall at rest": impact_case("I", "impacts", restitution=0.0, clearance_below=0.0),
    "sliding": Case(partial(with_sliding_masses, 30.0, 14.0, {}), 14.0, "2 slips per 1", "dissipated"),
    "sliding and rebounds": Case(
        partial(with_sliding_masses, 30.0, 14.0, {"clearance": 2e-3, "restitution": 0.4}), 14.0, "II", "impacts"
    ),
    "sliding and rest": Case(partial(with_sliding_masses, 30.0, 14.0, {"clearance": 2e-3}), 14.0, "III", "impacts"),
    "next to a tuned mass damper": Case(with_particle_damper, 49.6, "II", "impacts", ()),
}  # fmt: skip


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("law", RANDOM)
def test_random_systems_move_as_declared(law: str, seed: int) -> None:
    assert_motion_as_declared(RANDOM[law](seed), periods=5, tolerance=1e-10)


@pytest.mark.parametrize("name", HARD_CASES)
def test_hard_cases_of_sliding_balance_energy(name: str) -> None:
    energy = rig.simulate(with_sliding_masses(30.0, 14.0, *HARD_CASES[name]), duration=0.5, rate=2000.0).energy
    assert abs(energy.residual) < 1e-12 * energy.work


@pytest.mark.parametrize("name", CASES)
def test_energy_is_balanced(name: str) -> None:
    energy = rig.simulate(CASES[name].scene(), duration=1.0, rate=2000.0).energy
    assert abs(energy.residual) < 1e-13 * energy.work
    assert not CASES[name].loss or getattr(energy, CASES[name].loss) > 0.01 * energy.work


@pytest.mark.parametrize("name", CASES)
def test_orbit_is_the_steady_motion(name: str) -> None:
    scene, frequency = CASES[name].scene(), CASES[name].frequency
    orbit, response = rig.periodic_orbit(scene, frequency), rig.frequency_response(scene, [frequency])
    assert orbit.stable and len(orbit.events)
    assert orbit.motion_type == response.motion_type[0] == CASES[name].motion_type
    np.testing.assert_allclose(orbit.compliance, response.compliance[:, 0], rtol=1e-6)


def free_states(orbit: rig.Orbit) -> list[int]:
    """Return the states that are free at the start of an orbit."""
    propagator, _ = start_propagator(OrbitProblem(orbit.problem.scene), orbit.operating_point)
    set_to_orbit(propagator, orbit)
    system, fixed = propagator.system, set[int]()
    for element, regime in zip(system.elements, propagator.state.regime, strict=True):
        if propagator.tables.model.laws.regimes.is_held[regime]:
            fixed |= {element.gap, system.coordinates + element.gap}
        if element.slider >= 0:  # the rate of a slider is zero
            fixed.add(system.coordinates + element.slider)
    # The gap of a sliding mass without walls has no effect.
    free_gaps = [damper.friction is not None and damper.clearance == np.inf for damper in orbit.problem.scene.dampers]
    fixed |= {element.gap for element, is_free in zip(system.elements, free_gaps, strict=False) if is_free}
    return [state for state in range(system.states) if state not in fixed]


@pytest.mark.parametrize("name", [name for name in CASES if name != "next to a tuned mass damper"])
def test_multipliers_are_those_of_differences(name: str) -> None:
    orbit = rig.periodic_orbit(CASES[name].scene(), CASES[name].frequency)
    assert_multipliers_are_those_of_differences(orbit, free_states(orbit), change=1e-7, count=2, rtol=1e-5)


@pytest.mark.parametrize(("name", "parameter"), [(name, each) for name in CASES for each in CASES[name].parameters])
def test_derivatives_are_those_of_differences(name: str, parameter: str) -> None:
    orbit = rig.periodic_orbit(CASES[name].scene(), CASES[name].frequency)
    setting = replace(orbit.operating_point, clearance=1e-3) if parameter == "clearance" else orbit.operating_point
    assert_derivatives_are_those_of_differences(orbit, setting, parameter)
