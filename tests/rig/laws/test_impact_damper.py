"""Impact dampers on springs: an independent oracle, the limit without contact, hard cases, and every study."""

from __future__ import annotations

from math import inf, sqrt
from typing import Any

import numpy as np
import pytest

import rig
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
    random = np.random.default_rng(seed)
    bodies = int(random.integers(1, 6))
    damped = random.permutation(bodies)[: random.integers(1, 5)] + 1
    dampers = []
    for number, body in enumerate(damped.tolist()):
        mass = float(10.0 ** random.uniform(-2.5, -0.5))
        damper: dict[str, Any] = {"body": body, "mass": mass, "clearance": float(random.choice([3e-4, 1e-3, inf]))}
        if number == 0 or random.random() < 0.6:
            stiffness = mass * float(random.uniform(30.0, 300.0)) ** 2
            dashpot = float(random.choice([0.0, 0.1, 1.5])) * sqrt(mass * stiffness)
            below = float(random.choice([2e-4, 5e-4, 1e-3]))
            damper |= {"spring": stiffness, "damping": dashpot, "clearance_below": below}
            damper |= STEEL if random.random() < 0.4 else {}
        damper["restitution"] = float(random.choice([0.0, 0.4, 0.8]))
        dampers.append(damper)
    content: dict[str, Any] = {
        "structure": {
            "masses": random.uniform(0.3, 1.5, bodies).tolist(),
            "springs": random.uniform(1e4, 4e4, bodies).tolist(),
            "damping": {"modal": 0.01},
        },
        "dampers": dampers,
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": float(random.uniform(8.0, 50.0)), "force": 20.0},
    }
    assert_motion_as_declared(rig.load(content), periods=5, tolerance=1e-10)
