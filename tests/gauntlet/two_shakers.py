"""Random structures with two shakers, driven simultaneously by uncorrelated noise or orthogonal multisines."""

import numpy as np
import yaml
from numpy.typing import NDArray

import rig
from rig.core.system.structural_model import structural_model
from tests.gauntlet.scenes import INSTRUMENT_SEED_OFFSET, Draw, Settings

# Kinds of tests.
RANDOM, MULTISINE = "random_two_shakers", "multisine_two_shakers"


def draw_two_shakers(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw a chain of three bodies with a force on the first and the last, and noisy sensors."""
    random, instrument_random = Draw(seed, number), Draw(seed, number + INSTRUMENT_SEED_OFFSET)
    masses = [random.uniform(0.5, 1.5) for _ in range(3)]
    springs = [1e3 * random.uniform(10.0, 40.0) for _ in range(3)]
    tests: dict[str, Settings] = {
        RANDOM: {"kind": "random", "duration": random.uniform(24.0, 40.0)},
        MULTISINE: {
            "kind": "multisine",
            "period": random.uniform(3.0, 5.0),
            "periods": random.integer(2, 4),
            "realisations": random.integer(2, 3),
        },
    }
    sensor = {
        "accelerometer": {"sensitivity": "100 mV/g", "noise": f"{random.log_uniform(20.0, 500.0):.3g} ug/sqrt(Hz)"}
    }
    force_sensor = {"hammer": {"sensitivity": "100 mV/N"}}
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": {"masses": masses, "springs": springs, "damping": {"modal": random.log_uniform(0.006, 0.02)}},
        "shaker": [{"kind": "force", "body": 1}, {"kind": "force", "body": 3}],
        "test": {
            "shaker": 1,
            "also": [2],
            "from": 8.0,
            "to": 60.0,
            "force": random.log_uniform(0.5, 2.0),
            **tests[kind],
        },
        "channels": [
            *({"name": f"a{body}", "at": f"body {body}", **sensor} for body in (1, 2, 3)),
            *({"name": f"f{shaker}", "at": f"shaker {shaker}", **force_sensor} for shaker in (1, 2)),
        ],
        "converter": {"rate": 2048.0, "bits": 24, "range": 10.0},
        "recording": {"display": False},
        "seed": random.integer(1, 10**6),
    }
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])
    if instrument_random.chance(0.3):
        scene = scene.replace(converter=scene.converter.replace(clock_error=instrument_random.uniform(-5e-5, 5e-5)))
    channels = [
        channel.replace(accelerometer=channel.accelerometer.replace(sensitivity_tolerance=0.05))
        if channel.accelerometer is not None and instrument_random.chance(0.4)
        else channel
        for channel in scene.channels or ()
    ]
    return scene.replace(channels=tuple(channels))


def exact_receptance(scene: rig.Scene, frequency: NDArray[np.float64], shaker: int) -> NDArray[np.complex128]:
    """Return receptances for the force of one shaker, numbered from 1; (bodies, frequencies), m/N."""
    force = np.zeros(scene.structure.bodies)
    force[[body - 1 for body in scene.shakers[shaker - 1].bodies]] = 1.0
    return structural_model(scene).response(frequency, force)
