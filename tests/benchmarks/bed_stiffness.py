"""What stiffness and step of time of grains make of a bed's steady motion, with its scatter over packings.

    python -m tests.benchmarks.bed_stiffness 50MPa 100MPa 200MPa

A body of one mode at 50 Hz with a bed of a tenth of its mass: four layers in full flight, and six that have just taken
off, which feel their own elasticity most. A quarter of a minute of one core for each modulus, setting and packing.
"""

from __future__ import annotations

import math
import sys
from itertools import product

import numpy as np

from analysis.paper.bed_study import Setting, scene_of_bed
from rig.bed_response.steady_bed import steady_grains
from rig.scene.quantities import MODULUS, positives
from rig.scene.scene import STANDARD_GRAVITY, Scene

PACKINGS = (1, 2, 3)
BLOCK, MOST = 20, 3
#: Frequency, Hz; force over the body's weight; clearance, m; layers.
SETTINGS = ((49.0, 0.2, 0.98e-3, 4), (47.5, 0.08, 3e-3, 6))
RESONANCE = 50.0


def resonant(force: float, clearance: float, layers: int, packing: int, modulus: float) -> Scene:
    """Put a bed of the study into a body that it damps."""
    scene = scene_of_bed(Setting(1.0, clearance, layers, packing), modulus=modulus)
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
    """Print means over packings and their standard errors."""
    moduli = positives(sys.argv[1:] or ["50 MPa", "100 MPa", "200 MPa"], MODULUS, "moduli")
    for (frequency, force, clearance, layers), modulus in product(SETTINGS, moduli):
        seen = []
        for packing in PACKINGS:
            scene = resonant(force, clearance, layers, packing, modulus)
            motion = steady_grains(scene, frequency, BLOCK, MOST)
            seen.append([abs(motion.compliance[0]), motion.floor_impulse[0], motion.energy[0]])
        mean, error = np.mean(seen, axis=0), np.std(seen, axis=0, ddof=1) / np.sqrt(len(seen))
        names = ("compliance m/N", "floor impulse N s", "energy J")
        figures = (
            f"{name} {a:.4g} ±{100 * b / a:.1f} %" for name, a, b in zip(names, mean, error, strict=True)
        )
        print(f"{layers} layers, {modulus / 1e6:g} MPa: {', '.join(figures)}", flush=True)


if __name__ == "__main__":
    main()
