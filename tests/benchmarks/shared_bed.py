"""A bed of grains on one rank of MPI and on several: time of a step of grains and structure.

    python -m tests.benchmarks.shared_bed [RANKS]

Beds have fallen into their cavities and ride on a body that is shaken at 29 Hz. It is the processor's time of the first
rank that counts, with its waiting for the others, of each few steps the shortest of several turns: ranks that share
their cores with other programs wait for each other far longer than their work takes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from rig import ranks
from rig.grain_beds import coupling, packing
from rig.grain_beds.spheres import spheres_of
from rig.scene.scene import Scene

#: Mass of the bed, kg; diameter of the cavity, m; steps to follow.
BEDS = ((0.071, 0.04, 1000), (0.285, 0.06, 400), (1.14, 0.08, 100))
TURNS, FEW = 6, 5


def scene_of(mass: float, cavity: float) -> Scene:
    """Put a bed of 2 mm lead into a body ten times as heavy."""
    grains = {"diameter": 2e-3, "modulus": 1e7, "cavity": cavity}
    return Scene.model_validate(
        {
            "structure": {"masses": [10.0 * mass], "springs": [3.3e5 * mass], "damping": {"modal": 0.005}},
            "dampers": [{"body": 1, "mass": mass, "clearance": 1e-3, "grains": grains}],
            "shaker": {"kind": "force", "body": 1},
            "test": {"kind": "sine", "frequency": 29.0, "force": 70.0 * mass},
        }
    )


def follow(fallen: str, mass: float, cavity: float, steps: int) -> None:
    """Print the seconds that each few steps take."""
    ranks.join()
    coupling.settled = lambda _: np.load(fallen)
    coupled = coupling.CoupledPropagator(scene_of(mass, cavity), 1e-3)
    turns = 29.0 * coupled.step * np.arange(steps + 1)
    drive = 70.0 * mass * np.sin(2.0 * np.pi * turns)[None]
    coupled.place(coupled.system.initial, drive[:, 0])
    taken = []
    for first in range(0, steps, FEW):
        begin = time.process_time()
        coupled.march(drive[:, first : first + FEW + 1])
        taken.append(time.process_time() - begin)
    print(json.dumps(taken))


def measured(several: int) -> None:
    """Print the time of a step by number of grains and of ranks."""
    with tempfile.TemporaryDirectory() as folder:
        fallen = Path(folder) / "fallen.npy"
        for mass, cavity, steps in BEDS:
            spheres = spheres_of(scene_of(mass, cavity))[0]
            np.save(fallen, packing._fallen(spheres))
            given = [str(fallen), str(mass), str(cavity), str(steps)]
            taken: dict[int, list[list[float]]] = {1: [], several: []}
            for _ in range(TURNS):
                for number, turns in taken.items():
                    words = [
                        Path(sys.prefix) / "bin" / "mpiexec",
                        "-n",
                        str(number),
                        sys.executable,
                        "-m",
                        __spec__.name,
                    ]
                    done = subprocess.run([*words, *given], capture_output=True, text=True, check=True)
                    turns.append(json.loads(done.stdout))
            one, more = (1e3 * np.min(turns, axis=0).sum() / steps for turns in taken.values())
            print(
                f"{spheres.count} grains: {one:.2f} ms a step on one rank, {more:.2f} ms on {several}, "
                f"{one / more:.2f} times as fast",
                flush=True,
            )


if __name__ == "__main__":
    if len(sys.argv) > 2:
        follow(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
    else:
        measured(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
