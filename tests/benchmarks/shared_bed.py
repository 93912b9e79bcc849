"""Time of a step of a bed of grains that is shared by several MPI ranks (processes), compared with one rank.

    python -m tests.benchmarks.shared_bed [RANKS]

Each bed starts at rest in its cavity, in a body that is shaken at 29 Hz. A step advances grains and structure. The time
is the processor time of the first rank, including its waiting for the others. Steps are timed in groups of five. The
shortest time of each group over several runs counts, because a rank with a busy core delays all others.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from rig.core.scene.scene import Scene
from rig.core.system.spheres import spheres_of
from rig.extras.grains import coupling, packing, ranks

#: Mass of the bed, kg; diameter of the cavity, m; number of steps.
BEDS = ((0.071, 0.04, 1000), (0.285, 0.06, 400), (1.14, 0.08, 100))
RUNS = 6
STEPS_PER_GROUP = 5


def scene_of(mass: float, cavity: float) -> Scene:
    """Return a scene with a bed of 2 mm lead shot in a body of ten times its mass.

    `mass`: mass of the bed, kg; `cavity`: diameter, m.
    """
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
    """Run on each rank; the first prints the times of all groups of steps, s, as JSON."""
    ranks.join()
    coupling.settled_positions = lambda _: np.load(positions_path)
    coupled = coupling.CoupledPropagator(scene_of(mass, cavity), 1e-3)
    cycles = 29.0 * coupled.step * np.arange(steps + 1)
    drive = 70.0 * mass * np.sin(2.0 * np.pi * cycles)[None]
    coupled.set_state(coupled.system.initial, drive[:, 0])
    times = []
    for first in range(0, steps, STEPS_PER_GROUP):
        start = time.process_time()
        coupled.propagate_steps(drive[:, first : first + STEPS_PER_GROUP + 1])
        times.append(time.process_time() - start)
    print(json.dumps(times))


def compare_ranks(n_ranks: int) -> None:
    """Print the time of a step for each bed, on one rank and on several."""
    with tempfile.TemporaryDirectory() as folder:
        positions_path = Path(folder) / "positions.npy"
        for mass, cavity, steps in BEDS:
            spheres = spheres_of(scene_of(mass, cavity))[0]
            np.save(positions_path, packing._drop(spheres))
            arguments = [str(positions_path), str(mass), str(cavity), str(steps)]
            times: dict[int, list[list[float]]] = {1: [], n_ranks: []}
            for _ in range(RUNS):
                for rank_count, runs in times.items():
                    mpi = [Path(sys.prefix) / "bin" / "mpiexec", "-n", str(rank_count)]
                    command = [*mpi, sys.executable, "-m", __spec__.name, *arguments]
                    process = subprocess.run(command, capture_output=True, text=True, check=True)
                    runs.append(json.loads(process.stdout))
            single_ms, several_ms = (1e3 * np.min(runs, axis=0).sum() / steps for runs in times.values())
            print(
                f"{spheres.count} grains: {single_ms:.2f} ms a step on one rank, {several_ms:.2f} ms on {n_ranks}, "
                f"{single_ms / several_ms:.2f} times as fast",
                flush=True,
            )


if __name__ == "__main__":
    if len(sys.argv) > 2:
        print_step_times(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
    else:
        compare_ranks(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
