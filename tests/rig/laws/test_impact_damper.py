"""Impact dampers on springs: the limit without contact, and studies."""

from math import inf
from typing import Any

import numpy as np
import pytest

import rig
from rig.core.system.open_loop_drive import separation_levels
from rig.core.system.structural_model import receptance


def one_body(**damper: Any) -> rig.Scene:
    """Return a body with a mass on a spring."""
    content: dict[str, Any] = {
        "structure": {"masses": [1.0], "springs": [4e3], "damping": {"modal": 0.01}},
        "dampers": [{"body": 1, "mass": 0.1, "spring": 300.0, "damping": 0.2} | damper],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": 9.0, "force": 20.0},
    }
    return rig.load(content)


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


def test_map_starts_at_the_level_of_first_contact() -> None:
    scene = driven(6.0)
    motion_map = rig.map_motion(scene, frequencies=[9.0, 10.0], values=[0.9, 1.1])
    assert motion_map.kind.shape == (2, 2)
    [level] = separation_levels(scene, np.array([10.0]))
    at_level = driven(level)
    orbit = rig.periodic_orbit(at_level.replace(dampers=[at_level.dampers[0].without_walls()]), 10.0)
    assert -orbit.columns()["gap 1_m"].min() == pytest.approx(1e-3, rel=1e-3)


def test_explanation_states_the_walls() -> None:
    assert "(8.717 Hz, damping ratio 1.83 %), walls 1 mm below" in str(rig.explain(driven(1.0)))


def test_wall_text_names_both_walls() -> None:
    assert driven(1.0, clearance=2e-3).dampers[0].walls_text == "walls 1 mm below and 2 mm above"
