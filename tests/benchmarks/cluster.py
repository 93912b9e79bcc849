"""A design on one worker of a Dask cluster and on two, their files compared, and what a task weighs and costs.

``python -m tests.benchmarks.cluster [SCENE]``: some minutes; the machine should have nothing else to do.
"""

from __future__ import annotations

import pickle
import sys
import tempfile
import time
from pathlib import Path

import rig
from rig.damper_design.choice import Choice
from rig.damper_design.figure import write
from rig.damper_design.request import parse_request
from rig.workers import Workers

# Of the tasks that do nothing, to see what it costs to hand one out.
TASKS = 3000


def nothing(piece: object) -> int:
    """Do nothing with a piece of the usual size."""
    return 0


def designed(scene: str, workers: int, folder: Path) -> tuple[float, dict[str, bytes]]:
    """Design on so many workers; seconds from their start, and the files."""
    from distributed import LocalCluster

    folder.mkdir()
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:
        begun = time.perf_counter()
        found = rig.design(scene, table=folder / "table.csv", cluster=cluster.scheduler_address)
        seconds = time.perf_counter() - begun
    write(found, folder)
    return seconds, {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def main() -> int:
    """Print it all; exit code 1 if the files differ."""
    name = sys.argv[1] if len(sys.argv) > 1 else "fig8-three-dampers"
    whole, space = parse_request(rig.load(name))
    choice = Choice(space.places[0], (space.mass,), space.clearance[:1])
    question = whole.parts[0]
    piece = question, choice
    print(f"a task and its piece: {len(pickle.dumps((nothing, piece)))} bytes; ", end="")
    print(f"its result: {len(pickle.dumps(question.worst(choice)))} bytes")
    begun = time.process_time()
    for place in space.places:
        whole.worst(Choice(place, (space.mass,), space.clearance[1:]))
    print(f"it computes for {(time.process_time() - begun) / len(space.places) / len(whole.parts):.2f} s")
    with Workers("local") as workers:
        list(workers.compute(nothing, [piece]))
        # The scheduler is in this process.
        begun = time.process_time()
        list(workers.compute(nothing, [piece] * TASKS))
        print(f"scheduler and client: {1e3 * (time.process_time() - begun) / TASKS:.2f} ms of CPU a task")
    with tempfile.TemporaryDirectory() as folder:
        one, files = designed(name, 1, Path(folder) / "one")
        two, others = designed(name, 2, Path(folder) / "two")
    same = files == others
    print(f"one worker {one:.0f} s, two {two:.0f} s: {one / two:.2f} times as fast, ", end="")
    print("the same files" if same else f"files differ: {[n for n in files if files[n] != others.get(n)]}")
    return int(not same)


if __name__ == "__main__":
    sys.exit(main())
