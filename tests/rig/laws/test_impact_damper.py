"""Impact dampers on springs: an independent oracle, the limit without contact, hard cases, and every study."""

from dataclasses import replace
from math import inf
from typing import Any

import numpy as np
import pytest

import rig
from rig.core.orbits.event_kinds import RIDES_CEILING, RIDES_FLOOR
from rig.core.system.assembly import assemble
from rig.core.system.structural_model import receptance
from rig.studies.motion_map.grid import take_off_levels
from tests.rig.laws.orbit_differences import (
    assert_derivatives_are_those_of_differences,
    assert_multipliers_are_those_of_differences,
)
from tests.rig.laws.random_scenes import random_scene
from tests.rig.laws.test_declarations import assert_motion_as_declared

STEEL = {"contact": {"duration": "1 ms"}}


def one_body(**damper: Any) -> rig.Scene:
    """Return a body with a mass on a spring."""
    content: dict[str, Any] = {
        "structure": {"masses": [1.0], "springs": [4e3], "damping": {"modal": 0.01}},
        "dampers": [{"body": 1, "mass": 0.1, "spring": 300.0, "damping": 0.2} | damper],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": 9.0, "force": 20.0},
    }
    return rig.load(content)


@pytest.mark.parametrize("seed", range(20))
def test_random_systems_move_as_declared(seed: int) -> None:
    assert_motion_as_declared(random_scene(seed, "impact", "bed"), periods=5, tolerance=1e-10)


def driven(force: float, **damper: Any) -> rig.Scene:
    """Return a body with a mass on a spring between walls, without rest on them in a period, at a force, N."""
    scene = one_body(**({"clearance": inf, "clearance_below": 1e-3, "restitution": 0.4} | damper))
    return scene.replace(test=scene.test.replace(force=force))


def test_without_contact_it_is_a_tuned_mass_damper() -> None:
    scene = driven(0.05)
    open_scene = scene.replace(dampers=[scene.dampers[0].without_walls()])
    with_walls, without = (rig.simulate(each, duration=1.0, rate=2000.0) for each in (scene, open_scene))
    assert not len(with_walls.events)
    np.testing.assert_allclose(with_walls.gap, without.gap, rtol=0, atol=1e-15)
    frequencies = [8.0, 10.0, 12.0]
    np.testing.assert_allclose(
        rig.orbit_response(scene, frequencies).compliance, receptance(open_scene, frequencies), rtol=1e-8
    )


@pytest.mark.parametrize("damper", [{}, {"contact": {"duration": "2 ms"}}, {"clearance": "1 mm", "restitution": 0.0}])
def test_energy_is_balanced(damper: dict[str, Any]) -> None:
    energy = rig.simulate(driven(20.0, **damper), duration=1.0, rate=2000.0).energy
    assert energy.impacts + energy.contacts > 0.01 * energy.work
    assert abs(energy.residual) < 1e-12 * energy.work


CASES = [
    {"restitution": 0.4},
    {"restitution": 0.0, "clearance": "1 mm"},
    {"contact": {"duration": "2 ms"}},
    {"restitution": 0.0, "clearance_below": 0.0},
]


@pytest.mark.parametrize("damper", CASES)
def test_orbit_is_the_steady_motion(damper: dict[str, Any]) -> None:
    scene = driven(6.0, **damper)
    orbit, response = rig.periodic_orbit(scene, 10.0), rig.frequency_response(scene, [10.0])
    assert orbit.stable and len(orbit.events) and orbit.motion_type == response.motion_type[0]
    np.testing.assert_allclose(orbit.compliance, response.compliance[:, 0], rtol=1e-6)


@pytest.mark.parametrize("damper", CASES)
def test_multipliers_are_those_of_differences(damper: dict[str, Any]) -> None:
    orbit = rig.periodic_orbit(driven(6.0, **damper), 10.0)
    system = assemble(orbit.problem.scene)
    held = [
        element.gap
        for element, wall in zip(system.elements, orbit.plan.sequence.wall[0], strict=True)
        if wall in (RIDES_FLOOR, RIDES_CEILING)
    ]
    free = [i for i in range(system.states) if i % system.coordinates not in held]
    assert_multipliers_are_those_of_differences(orbit, free, change=1e-7)


@pytest.mark.parametrize("damper", CASES)
@pytest.mark.parametrize("parameter", ["clearance", "mass_ratio", "frequency", "force"])
def test_derivatives_are_those_of_differences(damper: dict[str, Any], parameter: str) -> None:
    orbit = rig.periodic_orbit(driven(6.0, **damper), 10.0)
    field = "level" if parameter == "force" else parameter
    setting = replace(orbit.setting, clearance=1e-3) if field == "clearance" else orbit.setting
    assert_derivatives_are_those_of_differences(orbit, setting, field)


def test_map_starts_at_the_level_of_first_contact() -> None:
    scene = driven(6.0)
    motion_map = rig.map_motion(scene, frequencies=[9.0, 10.0], values=[0.9, 1.1])
    assert motion_map.kind.shape == (2, 2)
    [level] = take_off_levels(scene, np.array([10.0]))
    at_level = driven(level)
    orbit = rig.periodic_orbit(at_level.replace(dampers=[at_level.dampers[0].without_walls()]), 10.0)
    assert -orbit.columns()["gap 1_m"].min() == pytest.approx(1e-3, rel=1e-3)


def test_explanation_states_the_walls() -> None:
    assert "(8.717 Hz, damping ratio 1.83 %), walls 1 mm below" in str(rig.explain(driven(1.0)))


def test_wall_text_names_both_walls() -> None:
    assert driven(1.0, clearance=2e-3).dampers[0].walls_text == "walls 1 mm below and 2 mm above"
