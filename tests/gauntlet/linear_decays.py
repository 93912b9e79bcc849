"""Random free decays of linear structures with separate and close modes, and converters of few to many counts."""

import numpy as np
import yaml

import rig
from rig.core.base.arrays import Array
from rig.core.system.structural_model import structural_model
from tests.gauntlet.scenes import Draw, Settings, draw_chain

# Kind of test: a free decay without dampers.
LINEAR_DECAY = "decay_linear"
# Fraction of the scenes with two close modes: two equal oscillators and a weak coupling.
_CLOSE_FRACTION = 0.6
# Coupling relative to the stiffness of an oscillator: modes from less than the half-power width to 10 % apart.
_COUPLINGS = (0.002, 0.1)


def draw_linear_decay(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw a structure of 1 to 6 bodies with random initial velocities, and an accelerometer on each body."""
    random = Draw(seed, number)
    structure = _close_oscillators(random) if random.chance(_CLOSE_FRACTION) else draw_chain(random)[0]
    bodies = len(structure["masses"]) if "masses" in structure else 2
    sensor = {"sensitivity": "100 mV/g", "noise": f"{random.log_uniform(3.0, 300.0):.3g} ug/sqrt(Hz)"}
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": structure,
        "test": {
            "kind": "free",
            "velocity": [random.uniform(-0.3, 0.3) for _ in range(bodies)],
            "duration": random.uniform(3.0, 8.0),
        },
        "channels": [{"name": f"a{k}", "at": f"body {k}", "accelerometer": sensor} for k in range(1, bodies + 1)],
        "converter": {"rate": 2048.0, "bits": random.choice([10, 12, 16, 24]), "range": 10.0},
        "recording": {"display": False},
        "seed": random.integer(1, 10**6),
    }
    return rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])


def _close_oscillators(random: Draw) -> Settings:
    """Draw two oscillators of nearly equal natural frequencies, with different dampers and a weak coupling."""
    mass, frequency = random.log_uniform(0.5, 5.0), random.uniform(12.0, 60.0)
    stiffness = mass * (2.0 * np.pi * frequency) ** 2
    coupling = stiffness * random.log_uniform(*_COUPLINGS)
    dashpots = [2.0 * random.log_uniform(0.002, 0.02) * np.sqrt(stiffness * mass) for _ in range(2)]
    return {
        "matrices": {
            "mass": np.diag([mass, mass * random.uniform(0.95, 1.05)]).tolist(),
            "stiffness": [[stiffness + coupling, -coupling], [-coupling, stiffness + coupling]],
            "damping": np.diag(dashpots).tolist(),
        }
    }


def exact_modes(scene: rig.Scene) -> tuple[Array, Array]:
    """Return natural frequencies [Hz] and damping ratios from the eigenvalues of the equation of motion."""
    model = structural_model(scene)
    stiffness, damping = (np.linalg.solve(model.mass, matrix) for matrix in (model.stiffness, model.damping))
    size = len(stiffness)
    poles = np.linalg.eigvals(np.block([[np.zeros((size, size)), np.eye(size)], [-stiffness, -damping]]))
    poles = poles[poles.imag > 0.0]
    return np.abs(poles) / (2.0 * np.pi), -poles.real / np.abs(poles)
