"""What stiffness and step of time of grains make of a bed's steady motion, with its scatter over packings.

    python -m tests.benchmarks.bed_convergence

A body of one mode at 50 Hz with a bed of a tenth of its mass: two layers in free flight, four that meet a ceiling, and
six that have just taken off, which feel their own elasticity most. Grains and structure are coupled at every step of
time, so that its length is that of the coupling as well. Six minutes of one core for each setting.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from analysis.reproduction.bed_study import MODULUS, Setting, scene_of_bed
from rig.bed_response.steady_bed import steady_grains
from rig.grain_beds.spheres import rayleigh_time
from rig.scene.damper import Grains
from rig.scene.scene import STANDARD_GRAVITY, Scene

PACKINGS = (1, 2, 3)
BLOCK, MOST = 20, 3
#: Frequency, Hz; force over the body's weight; clearance, m; layers.
SETTINGS = ((48.5, 0.15, math.inf, 2), (49.0, 0.2, 0.98e-3, 4), (47.5, 0.08, 3e-3, 6))
RESONANCE = 50.0
#: Stiffness over that of the study, and step in Rayleigh times.
VARIANTS = ((1.0, 0.06), (0.5, 0.06), (2.0, 0.06), (1.0, 0.03), (1.0, 0.12))


def resonant(force: float, clearance: float, layers: int, packing: int, modulus: float, step: float) -> Scene:
    """Put a bed of the study into a body that it damps."""
    grains = Grains(diameter=2e-3, modulus=modulus)
    time_step = step * rayleigh_time(grains, grains.density)
    scene = scene_of_bed(Setting(1.0, clearance, layers, packing), modulus=modulus, time_step=time_step)
    bed = scene.dampers[0].mass
    assert bed is not None
    body = 10.0 * bed
    return scene.replace(
        structure={
            "masses": [body], "springs": [body * (2.0 * math.pi * RESONANCE) ** 2], "damping": {"modal": 0.005},
        },
        test={"kind": "sine", "frequency": RESONANCE, "force": force * body * STANDARD_GRAVITY},
    )  # fmt: skip


def main() -> None:
    """Print means over packings and their standard errors, and how far each variant is from the first."""
    names = ("compliance", "floor impulse", "energy")
    for (frequency, force, clearance, layers), (stiffness, step) in product(SETTINGS, VARIANTS):
        seen = []
        for packing in PACKINGS:
            scene = resonant(force, clearance, layers, packing, stiffness * MODULUS, step)
            motion = steady_grains(scene, frequency, BLOCK, MOST, least=MOST)
            seen.append([abs(motion.compliance[0]), motion.floor_impulse[0], motion.energy[0]])
        if (stiffness, step) == VARIANTS[0]:
            first = np.array(seen)
        mean, error = np.mean(seen, axis=0), np.std(seen, axis=0, ddof=1) / math.sqrt(len(seen))
        off = mean / first.mean(axis=0) - 1.0
        figures = (
            f"{name} {a:.4g} ±{100 * b / a:.1f} % ({100 * c:+.1f} %)"
            for name, a, b, c in zip(names, mean, error, off, strict=True)
        )
        print(
            f"{layers} layers, {stiffness * MODULUS / 1e6:g} MPa, step {step:g}: {', '.join(figures)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
