"""What stiffness and step of time of grains make of a bed's steady motion, with its scatter over packings.

    python -m tests.benchmarks.bed_stiffness 50MPa 100MPa 200MPa

Two settings of `analysis beds`: a bed of four layers in full flight, and one of six that has just taken off, which
feels its own elasticity most. A quarter of a minute of one core for each modulus, setting and packing.
"""

from __future__ import annotations

import sys
from itertools import product

import numpy as np

from analysis.paper.bed_study import Setting, scene_of_bed, steady_frequency, told
from rig.bed_response.steady_bed import steady_grains
from rig.scene.quantities import MODULUS, positives

PACKINGS = (1, 2, 3)
BLOCK, MOST = 20, 3
NAMES = ("compliance", "floor impulse", "ceiling impulse", "energy", "landing", "flight")


def main() -> None:
    """Print means and their standard errors."""
    moduli = positives(sys.argv[1:] or ["50 MPa", "100 MPa", "200 MPa"], MODULUS, "moduli")
    for (level, clearance, layers), modulus in product(((0.2, 0.98e-3, 4), (0.08, 3e-3, 6)), moduli):
        frequency = steady_frequency(level, clearance)
        seen = []
        for packing in PACKINGS:
            scene = scene_of_bed(Setting(level, clearance, layers, packing), modulus=modulus)
            values = told(scene, frequency, steady_grains(scene, frequency, BLOCK, MOST))[:-1]
            seen.append([float(value) for value in values])
        mean, error = np.mean(seen, axis=0), np.std(seen, axis=0, ddof=1) / np.sqrt(len(seen))
        figures = (f"{name} {a:.4g} ±{b:.2g}" for name, a, b in zip(NAMES, mean, error, strict=True))
        print(f"{layers} layers, level {level:g}, {modulus / 1e6:g} MPa: {', '.join(figures)}", flush=True)


if __name__ == "__main__":
    main()
