"""A bed of grains on one rank of MPI and on several: time of a step of grains and structure.

    python -m tests.benchmarks.shared_bed [RANKS]

Beds at rest in their cavities ride on a body that is shaken at 29 Hz. The result is the processor time of the first
rank, including its waiting for the others. Of every few steps the shortest time of several repeats is used, because
ranks that share their cores with other programs wait for each other far longer than they compute.
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
REPEATS = 6
STEPS_PER_MEASUREMENT = 5


def scene_of(mass: float, cavity: float) -> Scene:
    """Return a scene with a bed of 2 mm lead shot in a body of ten times its mass."""
    grains = {"diameter": 2e-3, "modulus": 1e7, "cavity": cavity}
    return Scene.model_validate(
        {
            "structure": {"masses": [10.0 * mass], "springs": [3.3e5 * mass], "damping": {"modal": 0.005}},
            "dampers": [{"body": 1, "mass": mass, "clearance": 1e-3, "grains": grains}],
            "shaker": {"kind": "force", "body": 1},
            "test": {"kind": "sine", "frequency": 29.0, "force": 70.0 * mass},
        }
    )


def print_step_times(positions_path: str, mass: float, cavity: float, steps: int) -> None:
    """Print the times of groups of steps, s."""
    ranks.join()
    coupling.settled = lambda _: np.load(positions_path)
    coupled = coupling.CoupledPropagator(scene_of(mass, cavity), 1e-3)
    periods = 29.0 * coupled.step * np.arange(steps + 1)
    drive = 70.0 * mass * np.sin(2.0 * np.pi * periods)[None]
    coupled.set_state(coupled.system.initial, drive[:, 0])
    times = []
    for first in range(0, steps, STEPS_PER_MEASUREMENT):
        start = time.process_time()
        coupled.march(drive[:, first : first + STEPS_PER_MEASUREMENT + 1])
        times.append(time.process_time() - start)
    print(json.dumps(times))


def compare_ranks(n_ranks: int) -> None:
    """Print the time of a step for each number of grains and ranks."""
    with tempfile.TemporaryDirectory() as folder:
        positions_path = Path(folder) / "fallen.npy"
        for mass, cavity, steps in BEDS:
            spheres = spheres_of(scene_of(mass, cavity))[0]
            np.save(positions_path, packing._drop(spheres))
            arguments = [str(positions_path), str(mass), str(cavity), str(steps)]
            times: dict[int, list[list[float]]] = {1: [], n_ranks: []}
            for _ in range(REPEATS):
                for number, turns in times.items():
                    command = [
                        Path(sys.prefix) / "bin" / "mpiexec",
                        "-n",
                        str(number),
                        sys.executable,
                        "-m",
                        __spec__.name,
                    ]
                    process = subprocess.run([*command, *arguments], capture_output=True, text=True, check=True)
                    turns.append(json.loads(process.stdout))
            single_time, several_time = (1e3 * np.min(turns, axis=0).sum() / steps for turns in times.values())
            print(
                f"{spheres.count} grains: {single_time:.2f} ms a step on one rank, {several_time:.2f} ms on {n_ranks}, "
                f"{single_time / several_time:.2f} times as fast",
                flush=True,
            )


if __name__ == "__main__":
    if len(sys.argv) > 2:
        print_step_times(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
    else:
        compare_ranks(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
