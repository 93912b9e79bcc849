"""Random structures with two close modes, as exact curves and as scenes to record, for the check of modes."""

import numpy as np
import yaml

import rig
from rig.core.base.arrays import Array
from rig.core.results.response import Response
from rig.core.system.structural_model import receptance
from tests.gauntlet.scenes import INSTRUMENT_SEED_OFFSET, Draw, Settings, with_drawn_instruments

# Kinds: exact curves without a recording, and two kinds of recorded tests.
CURVES, MULTISINE, STEPPED = "curves_close_modes", "multisine_close_modes", "stepped_sine_close_modes"
# Two shakers separate modes at a fraction of their half-power widths.
TWO_SHAKERS = "two_shakers_close_modes"
# Exact curves: smallest relative distance of the two natural frequencies, and damping ratio of all modes.
_EXACT_DISTANCE = 0.004
_EXACT_DAMPING_RATIO = 0.002
# The same for recorded tests, whose curves have noise.
_NOISY_DISTANCE = 0.01
_NOISY_DAMPING_RATIO = 0.005
# The same for tests with two shakers; the damping ratio is drawn from a range.
_TWO_SHAKERS_DISTANCE = 0.004
_TWO_SHAKERS_DAMPING_RATIOS = (0.002, 0.012)
# The contributions of the two modes to a response have at least this ratio: a smaller ratio would hide a mode.
_MIN_CONTRIBUTION_RATIO = 0.25


def draw_close_modes(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw a structure of 2 to 4 bodies with a close pair, and a test that resolves it with noisy accelerometers."""
    random, instrument_random = Draw(seed, number), Draw(seed, number + INSTRUMENT_SEED_OFFSET)
    distance, damping_ratio = (
        (_EXACT_DISTANCE, _EXACT_DAMPING_RATIO) if kind == CURVES else (_NOISY_DISTANCE, _NOISY_DAMPING_RATIO)
    )
    if kind == TWO_SHAKERS:
        distance, damping_ratio = _TWO_SHAKERS_DISTANCE, random.log_uniform(*_TWO_SHAKERS_DAMPING_RATIOS)
    bodies = random.integer(2, 4)
    first = random.uniform(20.0, 40.0)
    natural_frequencies = [first, first * (1.0 + distance * random.uniform(1.0, 1.5)), 1.7 * first, 2.9 * first][
        :bodies
    ]
    masses = np.array([random.log_uniform(0.5, 2.0) for _ in range(bodies)])
    shapes = _shapes(random, bodies) * np.sqrt(masses)[:, None]
    stiffness = shapes * (2.0 * np.pi * np.array(natural_frequencies)) ** 2 @ shapes.T
    bandwidth = 2.0 * damping_ratio * first
    tests: dict[str, Settings] = {
        MULTISINE: {"kind": "multisine", "period": round(5.0 / bandwidth, 2), "periods": 3},
        STEPPED: {"kind": "stepped_sine", "points": 40},
        TWO_SHAKERS: {
            "kind": "multisine", "period": round(4.0 / bandwidth, 2), "periods": 3, "realisations": 2, "shaker": 1,
            "also": [2],
        },
    }  # fmt: skip
    excitation: Settings = {"shaker": {"kind": "force", "body": 1}, "forces": [{"name": "force", "at": "shaker"}]}
    if kind == TWO_SHAKERS:
        excitation = {
            "shaker": [{"kind": "force", "body": 1}, {"kind": "force", "body": 2}],
            "forces": [{"name": "f1", "at": "shaker 1"}, {"name": "f2", "at": "shaker 2"}],
        }
    band = {"from": round(0.94 * first, 3), "to": round(1.08 * first, 3)}
    sensor = {
        "accelerometer": {"sensitivity": "100 mV/g", "noise": f"{random.log_uniform(30.0, 1000.0):.3g} ug/sqrt(Hz)"}
    }
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": {
            "matrices": {"mass": np.diag(masses).tolist(), "stiffness": (0.5 * (stiffness + stiffness.T)).tolist()},
            "damping": {"modal": damping_ratio},
        },
        "shaker": excitation["shaker"],
        "test": {**tests.get(kind, tests[STEPPED]), **band, "force": random.log_uniform(0.5, 3.0)},
        "channels": [*({"name": f"a{body}", "at": f"body {body}", **sensor} for body in (1, 2)), *excitation["forces"]],
        "converter": {"rate": instrument_random.choice([1024.0, 2048.0]), "bits": 24, "range": 10.0},
        "recording": {"display": False},
        "seed": random.integer(1, 10**6),
    }
    if instrument_random.chance(0.5):
        settings["converter"] |= {"filter": "delta_sigma"}
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])
    return scene if kind == CURVES else with_drawn_instruments(instrument_random, scene)


def exact_curves(scene: rig.Scene, seed: int, number: int) -> list[Response]:
    """Return receptances in closed form, with 2 to 6 lines in each half-power width."""
    random = Draw(seed, number + 10**6)
    bandwidth = 2.0 * _EXACT_DAMPING_RATIO * scene.test.from_
    spacing = bandwidth / random.uniform(2.0, 6.0)
    frequency = np.arange(scene.test.from_, scene.test.to, spacing)
    values = receptance(scene, frequency)[: random.integer(1, 2)]
    degrees_of_freedom = np.full(frequency.size, 38.0)
    return [
        Response.curve(frequency, value, f"a{k}", degrees_of_freedom=degrees_of_freedom)
        for k, value in enumerate(values, 1)
    ]


def _shapes(random: Draw, bodies: int) -> Array:
    """Draw orthonormal mode shapes (bodies, modes); the first two contribute similarly to the measured responses."""
    while True:
        shapes = np.linalg.qr([[random.uniform(-1.0, 1.0) for _ in range(bodies)] for _ in range(bodies)])[0]
        contributions = abs(shapes[:2, :2] * shapes[0, :2])
        if contributions.min() > _MIN_CONTRIBUTION_RATIO * contributions.max():
            return np.asarray(shapes)
