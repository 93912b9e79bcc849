"""`rig design` on one and on two workers of a Dask cluster: speed, equality of the files, size and cost of a task.

    python -m tests.benchmarks.cluster [SCENE]

It takes some minutes on an otherwise idle machine.
"""

import pickle
import sys
import tempfile
import time
from pathlib import Path

from distributed import LocalCluster

import rig
from rig.core.base.workers import Workers, cores
from rig.studies.design.choice import Choice
from rig.studies.design.figure import write
from rig.studies.design.request import parse_request

# Number of tasks without computation, to measure the overhead of a task.
EMPTY_TASKS = 3000


def empty_task(task_input: object) -> int:
    """Return at once: a task whose input has a realistic size."""
    return 0


def design_on_cluster(scene: str, workers: int, folder: Path) -> tuple[float, dict[str, bytes]]:
    """Design on a number of workers; return the elapsed time [s], and the written files by name."""
    folder.mkdir()
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:
        start = time.perf_counter()
        design = rig.design(scene, table=folder / "table.csv", cluster=cluster.scheduler_address)
        seconds = time.perf_counter() - start
    write(design, folder)
    return seconds, {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def main() -> int:
    """Print all results; return exit code 1 if the files differ."""
    name = sys.argv[1] if len(sys.argv) > 1 else "fig8-three-dampers"
    objective, space = parse_request(rig.load(name))
    choice = Choice(space.locations[0], (space.max_mass,), space.clearance[:1])
    # A task computes the peak of a choice of dampers for one structure at one force level.
    subproblem = objective.subproblems[0]
    task_input = subproblem, choice
    print(f"a task and its input: {len(pickle.dumps((empty_task, task_input)))} bytes; ", end="")
    print(f"its result: {len(pickle.dumps(subproblem.worst(choice)))} bytes")
    start = time.process_time()
    for location in space.locations:
        objective.worst(Choice(location, (space.max_mass,), space.clearance[1:]))
    task_time = (time.process_time() - start) / len(space.locations) / len(objective.subproblems)
    print(f"CPU time of a task: {task_time:.2f} s")
    with (
        LocalCluster(n_workers=cores(), threads_per_worker=1, dashboard_address=None) as cluster,
        Workers(cluster.scheduler_address) as workers,
    ):
        list(workers.compute(empty_task, [task_input]))
        # The scheduler runs in this process, so that its time is included.
        start = time.process_time()
        list(workers.compute(empty_task, [task_input] * EMPTY_TASKS))
        print(f"scheduler and client: {1e3 * (time.process_time() - start) / EMPTY_TASKS:.2f} ms of CPU a task")
    with tempfile.TemporaryDirectory() as folder:
        single_time, single_files = design_on_cluster(name, 1, Path(folder) / "one")
        double_time, double_files = design_on_cluster(name, 2, Path(folder) / "two")
    different = [name for name in single_files if single_files[name] != double_files.get(name)]
    print(
        f"one worker {single_time:.0f} s, two {double_time:.0f} s: {single_time / double_time:.2f} times as fast, "
        f"{f'files differ: {different}' if different else 'equal files'}"
    )
    return int(single_files != double_files)


if __name__ == "__main__":
    sys.exit(main())
