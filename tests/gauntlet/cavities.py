"""Random scenes with dampers in flight, with and without ceiling, for the judges of impacts, restitution and decays."""

from __future__ import annotations

import numpy as np
import yaml

import rig
from rig.system.structural_model import receptance
from tests.gauntlet.scenes import INSTRUMENTS, Draw, Settings, coupling, instrumented, structure

# Range of the acceleration amplitude of a damper's body without dampers, in g: dampers fly only above 1.
_ACCELERATIONS_G = (1.3, 8.0)
GRAVITY = 9.80665
# Kinds of tests: one tone, steps around a mode, and free decay of one body.
TONE, STEPS, DECAY = "tone_dampers", "steps_dampers", "decay_dampers"


def draw_cavities(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw tones near a mode behind a delta-sigma converter at 5120 Hz, with real accelerometers and recorded truth."""
    random = Draw(seed, number)
    chain, modes = structure(random)
    bodies = len(chain["masses"])
    damper_bodies = sorted({random.integer(1, bodies) for _ in range(random.integer(1, 2))})
    dampers = [
        {
            "body": body,
            "mass_ratio": random.uniform(0.03, 0.15),
            "clearance": random.choice([".inf", f"{random.log_uniform(0.3, 3.0):.3g} mm"]),
            "restitution": random.choice([0.0, random.uniform(0.05, 0.6)]),
        }
        for body in damper_bodies
    ]
    # Above 80 Hz a period with its impacts has fewer than 64 samples.
    mode_frequency = random.choice([mode for mode in modes if mode < 80.0])
    first, last = (
        float(f"{mode_frequency * random.uniform(*fractions):.4g}") for fractions in ((0.85, 0.95), (1.05, 1.15))
    )
    tones = {TONE: {"kind": "sine", "frequency": first, "duration": 2.0}}
    tones[STEPS] = {"kind": "stepped_sine", "from": first, "to": last, "points": 6}
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": chain,
        "dampers": dampers,
        "shaker": {"kind": "force", "body": random.integer(1, bodies)},
        "test": {**tones[kind], "force": 1.0},
        "channels": [
            *({"name": f"a{body}", "at": f"body {body}", **_accelerometer(random)} for body in damper_bodies),
            {"name": "force", "at": "shaker"},
        ],
        "converter": {"rate": Draw(seed, number + INSTRUMENTS).choice([5120.0, 12800.0]), "filter": "delta_sigma"},
        "recording": {"display": False, "truth": True},
        "seed": random.integer(1, 10**6),
    }
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])
    scene = scene.replace(test=scene.test.replace(force=force_that_flies(random, scene, damper_bodies[0])))
    return instrumented(Draw(seed, number + INSTRUMENTS + 1), scene)


def draw_decay(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw the free decay of a single body, from flight of its damper to rest on the floor."""
    random, other_random = Draw(seed, number), Draw(seed, number + INSTRUMENTS)
    mass, frequency, ratio = random.log_uniform(0.3, 3.0), random.uniform(12.0, 40.0), random.log_uniform(0.002, 0.01)
    damper = {
        "body": 1,
        "mass_ratio": random.uniform(0.02, 0.1),
        "clearance": random.choice([".inf", f"{random.log_uniform(0.5, 3.0):.3g} mm"]),
    }
    angular = 2.0 * np.pi * frequency
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": {"masses": [mass], "springs": [mass * angular**2], "damping": {"modal": ratio}},
        "dampers": [damper],
        "test": {
            "kind": "free",
            "velocity": [random.log_uniform(2.0, 10.0) * GRAVITY / angular],
            "duration": round(min(8.0, 4.0 / (ratio * angular)), 3),
        },
        "channels": [{"name": "a1", "at": "body 1", "accelerometer": {"sensitivity": "100 mV/g", "noise": 2e-4}}],
        "converter": {
            "rate": other_random.choice([2560.0, 5120.0]),
            "filter": "delta_sigma",
            **coupling(other_random, False),
        },
        "recording": {"display": False},
        "seed": random.integer(1, 10**6),
    }
    return rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])


def _accelerometer(random: Draw) -> Settings:
    if random.chance(0.3):
        return {"accelerometer": {"preset": "PCB 352C33", "bias": 0.0}}
    sensor = {
        "sensitivity": "100 mV/g",
        "noise": f"{random.log_uniform(1.0, 100.0):.4g} ug/sqrt(Hz)",
        "resonance": random.log_uniform(2e4, 5e4),
        "low_cutoff": random.log_uniform(0.05, 0.8),
    }
    order = random.choice([0, 0, 1, 2])
    if order:
        return {
            "accelerometer": sensor,
            "integrator": {
                "order": order,
                "corner": random.log_uniform(0.2, 2.0),
                "gain": 50.0 if order == 1 else 2000.0,
            },
        }
    return {"accelerometer": sensor}


def force_that_flies(random: Draw, scene: rig.Scene, body: int) -> float:
    """Draw the force that gives a body without dampers an acceleration of `_ACCELERATIONS_G`."""
    test = scene.test
    frequency = np.array([test.frequency if test.kind == "sine" else 0.5 * (test.from_ + test.to)])
    compliance = abs(receptance(scene.replace(dampers=[]), frequency)[body - 1, 0])
    force = random.log_uniform(*_ACCELERATIONS_G) * GRAVITY / (compliance * (2 * np.pi * frequency[0]) ** 2)
    return float(f"{force:.4g}")
