"""Random scenes with tests that control motion or phase: constant response, backbone, curves.

The structure has dampers in flight, which orbits describe, or none, so that its modes are known.
"""

from __future__ import annotations

import numpy as np
import yaml

import rig
from rig.core.system.structural_model import structural_model
from tests.gauntlet.instant_contact import draw_force_for_flight
from tests.gauntlet.scenes import INSTRUMENT_SEED_OFFSET, Draw, Settings, draw_chain

# Stiffness of the coil spring of an electrodynamic shaker, relative to that of the first spring.
_SPRING_RATIO = 0.2
# Kinds of tests.
HELD, BACKBONE, CURVE = "constant_response_dampers", "phase_resonance_dampers", "continuation_dampers"
LINEAR_HELD, LINEAR_BACKBONE, LINEAR_CURVE = "constant_response", "phase_resonance", "continuation"
KINDS = HELD, BACKBONE, CURVE, LINEAR_HELD, LINEAR_BACKBONE, LINEAR_CURVE
# The band of a linear resonance, relative to its half-power bandwidth.
_BANDWIDTHS = 1.5


def draw_controlled_tone(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw a chain of one to four bodies with one or two dampers, a shaker, and sensors with and without tolerances."""
    random = Draw(seed, number)
    chain, natural_frequencies = draw_chain(random)
    while len(chain["masses"]) > 4:
        chain, natural_frequencies = draw_chain(random)
    bodies = len(chain["masses"])
    damped = sorted({random.integer(1, bodies) for _ in range(random.integer(1, 2))})
    dampers = [
        {
            "body": body,
            "mass_ratio": random.uniform(0.02, 0.08),
            "clearance": random.choice([".inf", f"{random.log_uniform(0.5, 3.0):.3g} mm"]),
        }
        for body in damped
    ]
    mode = random.choice([frequency for frequency in natural_frequencies if frequency < 80.0])
    sensor = {"sensitivity": "100 mV/g", "noise": f"{random.log_uniform(5.0, 100.0):.3g} ug/sqrt(Hz)"}
    sensor |= random.choice([{}, {"sensitivity_tolerance": 0.05}])
    place = Draw(seed, number + INSTRUMENT_SEED_OFFSET).choice(["force", "spring", "cell"])
    shaker: Settings = {"kind": "force", "body": damped[0]}
    if place != "force":
        shaker = {
            "kind": "electrodynamic",
            "body": damped[0],
            "spring": f"{_SPRING_RATIO * chain['springs'][0]:.4g} N/m",
        }
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": chain,
        "dampers": dampers,
        "shaker": shaker,
        "test": {"kind": "sine", "frequency": float(f"{mode:.4g}"), "force": 1.0},
        "channels": [
            *({"name": f"a{body}", "at": f"body {body}", "accelerometer": sensor} for body in range(1, bodies + 1)),
            {"name": "table", "at": "table", "accelerometer": sensor}
            if place == "spring"
            else {"name": "force", "at": "shaker", "hammer": {"sensitivity": "100 mV/N"}},
        ],
        "converter": {"rate": random.choice([2560.0, 5120.0]), "bits": 24, "range": 10.0},
        "recording": {"display": False},
        "seed": random.integer(1, 10**6),
    }
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])
    force = 0.5 * draw_force_for_flight(random, scene, damped[0])
    if not kind.endswith("_dampers"):
        scene = scene.replace(dampers=[])
    modes = structural_model(scene).modes
    nearest = int(np.argmin(abs(modes.frequency - mode)))
    half_band = 2.0 * _BANDWIDTHS * float(modes.decay_rate[nearest]) / (2.0 * np.pi)
    at, low, high = f"body {damped[0]}", 0.95 * mode, 1.05 * mode
    tests: dict[str, Settings] = {
        HELD: {
            "kind": "constant_response", "at": at, "from": 0.98 * mode, "to": 1.01 * mode, "points": 4,
            "acceleration": [random.uniform(8.0, 12.0), random.uniform(13.0, 20.0)],
        },
        BACKBONE: {
            "kind": "phase_resonance", "at": at, "frequency": mode, "from": low, "to": high,
            "force": sorted(random.uniform(0.3, 1.0) * force for _ in range(3)),
        },
        CURVE: {"kind": "continuation", "at": at, "from": high, "to": low, "force": force, "step": 0.4},
        LINEAR_HELD: {
            "kind": "constant_response", "at": at, "from": mode - half_band, "to": mode + half_band, "points": 11,
            "acceleration": random.uniform(8.0, 12.0),
        },
    }  # fmt: skip
    tests[LINEAR_BACKBONE] = tests[BACKBONE]
    tests[LINEAR_CURVE] = {**tests[CURVE], "from": max(high, mode + half_band), "to": min(low, mode - half_band)}
    return scene.replace(test=tests[kind])
