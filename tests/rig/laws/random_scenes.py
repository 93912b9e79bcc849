"""Random structures with dampers of given kinds, also several in one body, for the comparison with the oracle."""

from __future__ import annotations

from math import inf, sqrt
from typing import Any

import numpy as np

import rig

#: Kinds of dampers: particle damper, tuned mass damper, impact damper on a spring, sliding mass with friction.
KINDS = "bed", "tuned", "impact", "sliding"


def random_scene(seed: int, *kinds: str) -> rig.Scene:
    """Return a chain of 1 to 5 bodies with 1 to 4 dampers of some of `KINDS`, driven at its first body."""
    random = np.random.default_rng(seed)
    bodies = int(random.integers(1, 6))
    content: dict[str, Any] = {
        "structure": {
            "masses": random.uniform(0.3, 1.5, bodies).tolist(),
            "springs": random.uniform(1e4, 4e4, bodies).tolist(),
            "damping": {"modal": 0.01},
        },
        "dampers": [
            {"body": body} | _random_damper(random, str(random.choice(kinds)))
            for body in random.integers(1, bodies + 1, random.integers(1, 5)).tolist()
        ],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": float(random.uniform(8.0, 50.0)), "force": 20.0},
    }
    return rig.load(content)


def _random_damper(random: np.random.Generator, kind: str) -> dict[str, Any]:
    mass, clearance = float(10.0 ** random.uniform(-2.5, -0.5)), float(random.choice([3e-4, 1e-3, inf]))
    damper: dict[str, Any] = {"mass": mass, "clearance": clearance}
    if kind in ("tuned", "impact"):
        stiffness = mass * float(random.uniform(30.0, 300.0)) ** 2
        damper |= {"spring": stiffness, "damping": float(random.choice([0.0, 0.1, 1.5])) * sqrt(mass * stiffness)}
    if kind == "tuned":
        return damper | {"clearance": inf}
    if kind == "impact":
        damper["clearance_below"] = float(random.choice([2e-4, 5e-4, 1e-3]))
        damper |= {"contact": {"duration": "1 ms"}} if random.random() < 0.4 else {}
    if kind == "sliding":
        damper["friction"] = float(random.choice([0.0, 0.05, 0.3, 1.0]))
    if kind != "sliding" or clearance < inf:
        damper["restitution"] = float(random.choice([0.0, 0.4, 0.8]))
    return damper
