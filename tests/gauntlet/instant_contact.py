"""Random scenes of dampers in flight with instant contact, with and without ceiling.

The checks of impacts, restitution, types of motion and decays use them.
"""

import numpy as np
import yaml

import rig
from rig.core.system.structural_model import receptance
from tests.gauntlet.scenes import (
    INSTRUMENT_SEED_OFFSET,
    Draw,
    Settings,
    draw_chain,
    draw_coupling,
    with_drawn_instruments,
)

# Range of the acceleration amplitude of a body without its damper, in g. A damper flies only above 1 g.
_ACCELERATIONS_G = (1.3, 8.0)
# Standard acceleration of free fall, m/s^2.
GRAVITY = 9.80665
# Kinds of tests: a tone near a mode, steps around a mode, and the free decay of a single body.
TONE, STEPS, DECAY = "tone_dampers", "steps_dampers", "decay_dampers"


def draw_instant_contact(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw a scene: a tone or steps near a mode, imperfect accelerometers, delta-sigma converter and recorded truth."""
    random = Draw(seed, number)
    chain, natural_frequencies = draw_chain(random)
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
    # Above 80 Hz a period has fewer than 64 samples: too few to separate its impacts.
    natural_frequency = random.choice([frequency for frequency in natural_frequencies if frequency < 80.0])
    first, last = (
        float(f"{natural_frequency * random.uniform(*fractions):.4g}") for fractions in ((0.85, 0.95), (1.05, 1.15))
    )
    tests = {
        TONE: {"kind": "sine", "frequency": first, "duration": 2.0},
        STEPS: {"kind": "stepped_sine", "from": first, "to": last, "points": 6},
    }
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": chain,
        "dampers": dampers,
        "shaker": {"kind": "force", "body": random.integer(1, bodies)},
        "test": {**tests[kind], "force": 1.0},
        "channels": [
            *({"name": f"a{body}", "at": f"body {body}", **_accelerometer(random)} for body in damper_bodies),
            {"name": "force", "at": "shaker"},
        ],
        "converter": {
            "rate": Draw(seed, number + INSTRUMENT_SEED_OFFSET).choice([5120.0, 12800.0]),
            "filter": "delta_sigma",
        },
        "recording": {"display": False, "truth": True},
        "seed": random.integer(1, 10**6),
    }
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])
    scene = scene.replace(test=scene.test.replace(force=draw_force_for_flight(random, scene, damper_bodies[0])))
    return with_drawn_instruments(Draw(seed, number + INSTRUMENT_SEED_OFFSET + 1), scene)


def draw_decay(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw the free decay of a single body, from flight of its damper to rest on the floor."""
    random, instrument_random = Draw(seed, number), Draw(seed, number + INSTRUMENT_SEED_OFFSET)
    mass, frequency, damping_ratio = (
        random.log_uniform(0.3, 3.0),
        random.uniform(12.0, 40.0),
        random.log_uniform(0.002, 0.01),
    )
    damper = {
        "body": 1,
        "mass_ratio": random.uniform(0.02, 0.1),
        "clearance": random.choice([".inf", f"{random.log_uniform(0.5, 3.0):.3g} mm"]),
    }
    omega = 2.0 * np.pi * frequency
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": {"masses": [mass], "springs": [mass * omega**2], "damping": {"modal": damping_ratio}},
        "dampers": [damper],
        "test": {
            "kind": "free",
            "velocity": [random.log_uniform(2.0, 10.0) * GRAVITY / omega],
            "duration": round(min(8.0, 4.0 / (damping_ratio * omega)), 3),
        },
        "channels": [{"name": "a1", "at": "body 1", "accelerometer": {"sensitivity": "100 mV/g", "noise": 2e-4}}],
        "converter": {
            "rate": instrument_random.choice([2560.0, 5120.0]),
            "filter": "delta_sigma",
            **draw_coupling(instrument_random, False),
        },
        "recording": {"display": False},
        "seed": random.integer(1, 10**6),
    }
    return rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])


def _accelerometer(random: Draw) -> Settings:
    """Draw an accelerometer, of a data sheet or with drawn values, with or without an integrator."""
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


def draw_force_for_flight(random: Draw, scene: rig.Scene, body: int) -> float:
    """Draw the force that gives a body without dampers an acceleration within `_ACCELERATIONS_G`, N."""
    test = scene.test
    frequency = test.frequency if test.kind == "sine" else 0.5 * (test.from_ + test.to)
    compliance = abs(receptance(scene.replace(dampers=[]), np.array([frequency]))[body - 1, 0])
    accelerance = compliance * (2 * np.pi * frequency) ** 2
    return float(f"{random.log_uniform(*_ACCELERATIONS_G) * GRAVITY / accelerance:.4g}")
