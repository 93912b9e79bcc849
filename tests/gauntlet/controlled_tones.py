"""Random scenes with tests that control motion or phase: constant response, backbone, curves.

The structure has dampers in flight, which orbits describe, or none, so that its modes are known.
"""

import numpy as np
import yaml

import rig
from rig.core.system.structural_model import receptance, structural_model
from tests.gauntlet.instant_contact import GRAVITY, draw_force_for_flight
from tests.gauntlet.scenes import INSTRUMENT_SEED_OFFSET, Draw, Settings, draw_chain

# Stiffness of the coil spring of an electrodynamic shaker, relative to that of the first spring.
_SPRING_RATIO = 0.2
# Kinds of tests.
HELD, BACKBONE, CURVE = "constant_response_dampers", "phase_resonance_dampers", "continuation_dampers"
FOLDS = "continuation_folds_dampers"
LINEAR_HELD, LINEAR_BACKBONE, LINEAR_CURVE = "constant_response", "phase_resonance", "continuation"
KINDS = HELD, BACKBONE, CURVE, FOLDS, LINEAR_HELD, LINEAR_BACKBONE, LINEAR_CURVE
# The band of a linear resonance, relative to its half-power width.
_BANDWIDTHS = 1.5
# At most so many structures are drawn until the response at constant force has folds.
_MAX_FOLD_DRAWS = 40
# Smallest distance of two folds, relative to the half-power width.
_MIN_FOLD_WIDTH = 0.2


def bands_between_folds(curve: rig.OrbitCurve) -> list[tuple[float, float]]:
    """Return the bands of frequency, Hz, in which three or more motions repeat each period: folds are their ends."""
    ends: list[tuple[float, int]] = []
    for branch in curve.branches:
        if branch.orbits[0].repetition > 1:
            continue
        turns = np.flatnonzero(np.diff(np.sign(np.diff(branch.value)))) + 1
        for part in np.split(branch.value, turns):
            ends += [(float(part.min()), 1), (float(part.max()), -1)]
    bands, count, low = [], 0, 0.0
    for value, change in sorted(ends):
        if (count, change) == (2, 1):
            low = value
        elif (count, change) == (3, -1):
            bands.append((low, value))
        count += change
    return bands


def draw_folds(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw one or two bodies on springs, one with a damper between floor and ceiling, and a force shaker.

    The response at the force of the test turns back in its band.
    """
    random = Draw(seed, number)
    name = f"gauntlet {seed}/{number} {kind}"
    for _ in range(_MAX_FOLD_DRAWS):
        masses = [random.log_uniform(0.5, 2.0) for _ in range(random.integer(1, 2))]
        stiffness = (2.0 * np.pi * random.log_uniform(15.0, 50.0)) ** 2
        body = random.integer(1, len(masses))
        sensor = {"sensitivity": "10 mV/g", "noise": "20 ug/sqrt(Hz)"}
        settings: Settings = {
            "name": name,
            "structure": {
                "masses": masses,
                "springs": [mass * stiffness for mass in masses],
                "damping": {"modal": random.log_uniform(0.002, 0.005)},
            },
            "shaker": {"kind": "force", "body": body},
            "channels": [
                {"name": f"a{body}", "at": f"body {body}", "accelerometer": sensor},
                {"name": "force", "at": "shaker", "hammer": {"sensitivity": "100 mV/N"}},
            ],
            "converter": {"rate": 5120.0, "bits": 24, "range": 10.0},
            "recording": {"display": False},
            "seed": random.integer(1, 10**6),
        }
        scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=name)
        mode = float(random.choice(structural_model(scene).modes.frequency))
        # The amplitude at resonance without damper, m.
        amplitude = random.log_uniform(8.0, 40.0) * GRAVITY / (2.0 * np.pi * mode) ** 2
        force = float(amplitude / abs(receptance(scene, np.array([mode]))[body - 1, 0]))
        damper = {
            "body": body,
            "mass_ratio": random.uniform(0.03, 0.08),
            "clearance": random.log_uniform(0.2, 1.0) * amplitude,
        }
        low, high = 0.94 * mode, 1.03 * mode
        tone = {"kind": "sine", "frequency": mode, "force": force}
        scene = scene.replace(dampers=[damper], test=tone)
        bands = bands_between_folds(rig.follow_orbits(scene.replace(channels=None), "frequency", (low, high)))
        width = 2.0 * scene.structure.damping.modal * mode
        if any(last - first > _MIN_FOLD_WIDTH * width for first, last in bands):
            test = {"kind": "continuation", "at": f"body {body}", "from": high, "to": low, "force": force}
            return scene.replace(test=test)
    raise AssertionError(f"{name}: no response with folds")


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
