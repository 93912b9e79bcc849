"""Effect of grain stiffness and time step on the steady-state motion of a bed of grains; its scatter over packings.

    python -m tests.benchmarks.bed_convergence

A single-mode structure at 50 Hz has a bed of a tenth of its mass. There are three settings: two layers in free flight,
four layers that hit a ceiling, and six layers that barely take off. The motion of the last depends most on the
stiffness. Grains and structure are coupled at every time step. Each setting takes six minutes of one core.
"""

import math
from itertools import product

import numpy as np

from analysis.studies.paper.bed_study import MODULUS_PA, Setting, scene_of_bed
from rig.core.scene.damper import Grains
from rig.core.scene.scene import STANDARD_GRAVITY, Scene
from rig.core.system.spheres import rayleigh_time
from rig.extras.bed_response.steady_bed import steady_grains

# Seeds of the random packings.
PACKINGS = (1, 2, 3)
# A simulation has three blocks of 20 periods.
BLOCK_PERIODS = 20
BLOCKS = 3
#: Frequency, Hz; force relative to the body's weight; clearance, m; number of layers.
SETTINGS = ((48.5, 0.15, math.inf, 2), (49.0, 0.2, 0.98e-3, 4), (47.5, 0.08, 3e-3, 6))
RESONANCE_HZ = 50.0
#: Elastic modulus of the grains relative to the modulus in the bed study (`MODULUS_PA`); time step in Rayleigh times.
#: The first variant is the reference.
VARIANTS = ((1.0, 0.06), (0.5, 0.06), (2.0, 0.06), (1.0, 0.03), (1.0, 0.12))


def resonant_scene(force: float, clearance: float, layers: int, packing: int, modulus: float, step: float) -> Scene:
    """Return a scene with a body on a spring that contains a bed of the bed study and has ten times its mass.

    `force`: relative to the body's weight; `clearance`: m; `modulus`: Pa; `step`: Rayleigh times.
    """
    grains = Grains(diameter=2e-3, modulus=modulus)
    time_step = step * rayleigh_time(grains, grains.density)
    scene = scene_of_bed(Setting(1.0, clearance, layers, packing), modulus=modulus, time_step=time_step)
    bed_mass = scene.dampers[0].mass
    assert bed_mass is not None
    body_mass = 10.0 * bed_mass
    return scene.replace(
        structure={
            "masses": [body_mass],
            "springs": [body_mass * (2.0 * math.pi * RESONANCE_HZ) ** 2],
            "damping": {"modal": 0.005},
        },
        test={"kind": "sine", "frequency": RESONANCE_HZ, "force": force * body_mass * STANDARD_GRAVITY},
    )


def main() -> None:
    """Print means over packings, their standard uncertainties, and the deviation of each variant from the reference."""
    names = ("compliance", "floor impulse", "energy")
    for (frequency, force, clearance, layers), (stiffness, step) in product(SETTINGS, VARIANTS):
        values = []
        for packing in PACKINGS:
            scene = resonant_scene(force, clearance, layers, packing, stiffness * MODULUS_PA, step)
            motion = steady_grains(scene, frequency, BLOCK_PERIODS, BLOCKS, min_blocks=BLOCKS)
            values.append([abs(motion.compliance[0]), motion.floor_impulse[0], motion.energy[0]])
        if (stiffness, step) == VARIANTS[0]:
            reference = np.array(values)
        mean = np.mean(values, axis=0)
        standard_error = np.std(values, axis=0, ddof=1) / math.sqrt(len(values))
        deviation = mean / reference.mean(axis=0) - 1.0
        results = (
            f"{name} {value:.4g} ±{100 * error / value:.1f} % ({100 * relative:+.1f} %)"
            for name, value, error, relative in zip(names, mean, standard_error, deviation, strict=True)
        )
        print(f"{layers} layers, {stiffness * MODULUS_PA / 1e6:g} MPa, step {step:g}: {', '.join(results)}", flush=True)


if __name__ == "__main__":
    main()
