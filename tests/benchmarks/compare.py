"""Processor times of two commits, compared in alternating runs: `python -m tests.benchmarks.compare A B`.

Both commits run `compared_times` of this checkout in its environment. A time is faster or slower if all runs of one
commit took longer than all runs of the other. With five runs each, chance alone does this for one time in 126.
"""

import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from tests.benchmarks.checkouts import temporary_checkout

ROUNDS = 5
BENCHMARK = Path(__file__).parent / "compared_times.py"


def measure(code: Path, result: Path) -> dict[str, float]:
    """Return the times of one run with the code of a folder, s."""
    environment = {**os.environ, "PYTHONPATH": str(code)}
    command = [sys.executable, str(BENCHMARK), "--quick", str(result)]
    subprocess.run(command, check=True, cwd=code, env=environment, stdout=subprocess.DEVNULL)
    return dict(json.loads(result.read_text(encoding="utf-8")))


def verdict(before: list[float], after: list[float]) -> str:
    """Return whether all runs of one commit took longer than those of the other.

    >>> verdict([1.0, 1.1], [0.8, 0.9]), verdict([1.0, 1.1], [1.05, 1.2])
    ('faster', '')
    """
    return "faster" if max(after) < min(before) else "SLOWER" if min(after) > max(before) else ""


def main(first: str, second: str) -> None:
    """Measure both commits in turns and print a table."""
    with tempfile.TemporaryDirectory() as directory, ExitStack() as checkouts:
        folder = Path(directory)
        runs: list[list[dict[str, float]]] = [[], []]
        code_folders = [
            checkouts.enter_context(temporary_checkout(commit, folder / name))
            for name, commit in (("a", first), ("b", second))
        ]
        for number in range(ROUNDS):
            for code, results in zip(code_folders, runs, strict=True):
                results.append(measure(code, folder / "run.json"))
            print(f"round {number + 1} of {ROUNDS}", file=sys.stderr, flush=True)
    print(f"{'processor time, s':52s} {first[:10]:>10s} {second[:10]:>10s} {'ratio':>7s}")
    for name in runs[0][0]:
        before, after = ([run[name] for run in results] for results in runs)
        shortest = min(before), min(after)
        ratio = shortest[1] / shortest[0]
        print(f"{name:52s} {shortest[0]:10.4g} {shortest[1]:10.4g} {ratio:7.3f} {verdict(before, after)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
