"""Random structures with two close modes for the judge of modes, as exact curves and as scenes to record."""

from __future__ import annotations

import numpy as np
import yaml

import rig
from rig.arrays import Array
from rig.results.response import Response
from rig.system.structural_model import receptance
from tests.gauntlet.scenes import INSTRUMENTS, Draw, Settings, instrumented

CURVES, MULTISINE, STEPPED = "curves_pairs", "multisine_pairs", "stepped_sine_pairs"
# Smallest relative distance of the two modes, and damping ratio of all modes, for curves without noise.
_EXACT_DISTANCE_AND_DAMPING = (0.004, 0.002)
# The same for noisy curves.
_NOISY_DISTANCE_AND_DAMPING = (0.01, 0.005)
# Smallest ratio of the two modes' contributions at the driven and measured bodies.
_MIN_CONTRIBUTION_RATIO = 0.25


def draw_pair(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw a structure of 2 to 4 bodies with a close pair, and a test that resolves it with noisy accelerometers."""
    random, other_random = Draw(seed, number), Draw(seed, number + INSTRUMENTS)
    distance, ratio = _EXACT_DISTANCE_AND_DAMPING if kind == CURVES else _NOISY_DISTANCE_AND_DAMPING
    bodies = random.integer(2, 4)
    first = random.uniform(20.0, 40.0)
    modes = [first, first * (1.0 + distance * random.uniform(1.0, 1.5)), 1.7 * first, 2.9 * first][:bodies]
    masses = np.array([random.log_uniform(0.5, 2.0) for _ in range(bodies)])
    shapes = _shapes(random, bodies) * np.sqrt(masses)[:, None]
    stiffness = shapes * (2.0 * np.pi * np.array(modes)) ** 2 @ shapes.T
    width = 2.0 * ratio * first
    tests: dict[str, Settings] = {
        MULTISINE: {"kind": "multisine", "period": round(5.0 / width, 2), "periods": 3},
        STEPPED: {"kind": "stepped_sine", "points": 40},
    }
    band = {"from": round(0.94 * first, 3), "to": round(1.08 * first, 3)}
    sensor = {
        "accelerometer": {"sensitivity": "100 mV/g", "noise": f"{random.log_uniform(30.0, 1000.0):.3g} ug/sqrt(Hz)"}
    }
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": {
            "matrices": {"mass": np.diag(masses).tolist(), "stiffness": (0.5 * (stiffness + stiffness.T)).tolist()},
            "damping": {"modal": ratio},
        },
        "shaker": {"kind": "force", "body": 1},
        "test": {**tests.get(kind, tests[STEPPED]), **band, "force": random.log_uniform(0.5, 3.0)},
        "channels": [
            *({"name": f"a{body}", "at": f"body {body}", **sensor} for body in (1, 2)),
            {"name": "force", "at": "shaker"},
        ],
        "converter": {"rate": other_random.choice([1024.0, 2048.0]), "bits": 24, "range": 10.0},
        "recording": {"display": False},
        "seed": random.integer(1, 10**6),
    }
    if other_random.chance(0.5):
        settings["converter"] |= {"filter": "delta_sigma"}
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])
    return scene if kind == CURVES else instrumented(other_random, scene)


def exact_curves(scene: rig.Scene, seed: int, number: int) -> list[Response]:
    """Receptances in closed form, with 2 to 6 lines in each half-power bandwidth."""
    random = Draw(seed, number + 10**6)
    width = 2.0 * _EXACT_DISTANCE_AND_DAMPING[1] * scene.test.from_
    spacing = width / random.uniform(2.0, 6.0)
    frequency = np.arange(scene.test.from_, scene.test.to, spacing)
    values = receptance(scene, frequency)[: random.integer(1, 2)]
    degrees = np.full(frequency.size, 38.0)
    return [Response.curve(frequency, value, f"a{k}", degrees=degrees) for k, value in enumerate(values, 1)]


def _shapes(random: Draw, bodies: int) -> Array:
    """Draw orthonormal shapes; the first two are of similar size at the driven and measured bodies."""
    while True:
        shapes = np.linalg.qr([[random.uniform(-1.0, 1.0) for _ in range(bodies)] for _ in range(bodies)])[0]
        contributions = abs(shapes[:2, :2] * shapes[0, :2])
        if contributions.min() > _MIN_CONTRIBUTION_RATIO * contributions.max():
            return np.asarray(shapes)
