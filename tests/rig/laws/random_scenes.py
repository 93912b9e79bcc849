"""Random structures with dampers and joints of given kinds, also several in one body, to compare with the oracle."""

from math import inf, sqrt
from typing import Any

import numpy as np

import rig

#: Kinds of dampers: particle damper, tuned mass damper, impact damper on a spring, sliding mass with friction.
KINDS = "bed", "tuned", "impact", "sliding"


def random_scene(seed, *kinds, joint=None):
    """Return a chain of 1 to 5 bodies with 1 to 4 dampers of some of `KINDS`, driven at its first body.

    `joint`: returns random settings of a joint; with it, the chain has 1 to 3 joints and up to two dampers.
    """
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
    if joint is not None:
        places = ["ground", *range(1, bodies + 1)]
        pairs = [random.choice(len(places), 2, replace=False).tolist() for _ in range(random.integers(1, 4))]
        content["joints"] = [{"between": [places[i] for i in pair]} | joint(random) for pair in pairs]
        content["dampers"] = content["dampers"][: random.integers(0, 3)]
    return rig.load(content)


def random_stop(random: np.random.Generator) -> dict[str, Any]:
    """Return the settings of a stop without its ends."""
    return {
        "gap": float(random.choice([0.0, 1e-4, 5e-4])),
        "stiffness": float(10.0 ** random.uniform(4.0, 6.5)),
        "damping": float(random.choice([0.0, 5.0, 100.0])),
    }


def random_friction(random: np.random.Generator) -> dict[str, Any]:
    """Return the settings of a friction joint without its ends."""
    return {
        "slip_force": float(10.0 ** random.uniform(-1.0, 1.5)),
        "stiffness": float(10.0 ** random.uniform(4.0, 6.0)),
    }


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
