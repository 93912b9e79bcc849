"""Random scenes with finite-duration contact, for the checks of impacts and types of motion.

The rig is that of Inoue, Yokomichi, Hiraki (2011).
"""

import yaml

import rig
from rig.core.laws.landing import spring_damper
from tests.gauntlet.instant_contact import draw_force_for_flight
from tests.gauntlet.scenes import INSTRUMENT_SEED_OFFSET, Draw, Settings, with_drawn_instruments

# The rig of Inoue, Yokomichi and Hiraki (2011).
_MASSES_KG = (0.74, 0.71, 0.64)
_SPRINGS_N_PER_M = (24.3e3, 21.8e3, 19.8e3)
_NATURAL_FREQUENCIES_HZ = (12.6, 34.8, 49.2)
# Range of contact durations.
_CONTACT_DURATIONS_S = (5e-4, 8e-3)
# Kinds of tests: a tone near a mode, and steps around a mode.
TONE_FINITE_CONTACT, STEPS_FINITE_CONTACT = "tone_finite_contact", "steps_finite_contact"


def draw_finite_contact(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw a tone or steps near a mode of the rig with one to three dampers; record the exact motion, too."""
    random = Draw(seed, number)
    damper_bodies = sorted({random.integer(1, 3) for _ in range(random.integer(1, 3))})
    natural_frequency = random.choice(_NATURAL_FREQUENCIES_HZ)
    first, last = (
        float(f"{natural_frequency * random.uniform(*fractions):.4g}") for fractions in ((0.88, 1.0), (1.01, 1.1))
    )
    test: Settings = {"kind": "sine", "frequency": first, "duration": 1.5}
    if kind == STEPS_FINITE_CONTACT:
        test = {"kind": "stepped_sine", "from": first, "to": last, "points": 6}
    rate = random.choice([5120.0, 12800.0, 25600.0, 51200.0])
    sensor, converter = _instruments(random, rate)
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": {
            "masses": [mass * random.uniform(0.8, 1.25) for mass in _MASSES_KG],
            "springs": [spring * random.uniform(0.8, 1.25) for spring in _SPRINGS_N_PER_M],
            "damping": {"modal": random.log_uniform(0.003, 0.02)},
        },
        "dampers": [_damper(random, body) for body in damper_bodies],
        "shaker": {"kind": "force", "body": random.integer(1, 3)},
        "test": {**test, "force": 1.0},  # replaced below with a force with which a damper flies
        "channels": [
            *({"name": f"a{body}", "at": f"body {body}", **sensor} for body in damper_bodies),
            {"name": "force", "at": "shaker"},
        ],
        "converter": converter,
        "recording": {"display": False, "truth": True},
        "seed": random.integer(1, 10**6),
    }
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])
    scene = scene.replace(test=scene.test.replace(force=draw_force_for_flight(random, scene, damper_bodies[0])))
    return with_drawn_instruments(Draw(seed, number + INSTRUMENT_SEED_OFFSET), scene)


def _damper(random: Draw, body: int) -> Settings:
    """Draw a damper whose contact is given by its duration, or by stiffness and damping."""
    ratio, duration = random.uniform(0.03, 0.15), random.log_uniform(*_CONTACT_DURATIONS_S)
    restitution = random.choice([0.0, random.uniform(0.05, 0.6)])
    damper: Settings = {
        "body": body,
        "mass_ratio": ratio,
        "clearance": random.choice([".inf", f"{random.log_uniform(0.3, 3.0):.3g} mm"]),
    }
    if random.chance(0.7):
        return {**damper, "restitution": restitution, "contact": {"duration": duration}}
    reduced_mass = _MASSES_KG[body - 1] * ratio / (1.0 + ratio)
    stiffness, damping = spring_damper(duration, restitution, reduced_mass)
    return {**damper, "contact": {"stiffness": float(stiffness), "damping": float(damping)}}


def _instruments(random: Draw, rate: float) -> tuple[Settings, Settings]:
    """Draw sensor and converter: ideal, from data sheets, or with drawn values and perhaps an integrator."""
    choice = random.integer(0, 2)
    if choice == 0:
        return {}, {"rate": rate}
    if choice == 1:
        sensor = {"accelerometer": {"preset": "PCB 352C33", "bias": 0.0}}
        return sensor, {"preset": "NI 9234", "rate": rate, "remove_delay": True}
    sensor = {
        "accelerometer": {
            "sensitivity": "100 mV/g",
            "noise": f"{random.log_uniform(1.0, 300.0):.4g} ug/sqrt(Hz)",
            "resonance": random.log_uniform(2e4, 5e4),
            "low_cutoff": random.log_uniform(0.05, 0.8),
        }
    }
    order = random.integer(0, 2)
    if order:
        gain = 50.0 if order == 1 else 2000.0
        sensor["integrator"] = {"order": order, "corner": random.log_uniform(0.2, 2.0), "gain": gain}
    return sensor, {"rate": rate, **({"filter": "delta_sigma"} if random.chance(0.7) else {})}
