"""Two commits in runs by turns, and what differs by more than the noise: `python -m tests.benchmarks.compare A B`.

Both are measured by the benchmark of this checkout and in its environment. A figure differs if all runs of one commit
took longer than all runs of the other: by chance that happens to one in 126 figures, at five runs each.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from tests.benchmarks.checkouts import checked_out

ROUNDS = 5
BENCHMARK = Path(__file__).parent / "waits.py"


def measured(tree: Path, result: Path) -> dict[str, float]:
    """Give the figures of one run on the packages in a tree, s."""
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    words = [sys.executable, str(BENCHMARK), "--quick", str(result)]
    subprocess.run(words, check=True, cwd=tree, env=environment, stdout=subprocess.DEVNULL)
    return dict(json.loads(result.read_text(encoding="utf-8")))


def verdict(before: list[float], after: list[float]) -> str:
    """Say whether the runs of one commit all took longer than those of the other.

    >>> verdict([1.0, 1.1], [0.8, 0.9]), verdict([1.0, 1.1], [1.05, 1.2])
    ('faster', '')
    """
    return "faster" if max(after) < min(before) else "SLOWER" if min(after) > max(before) else ""


def main(first: str, second: str) -> None:
    """Measure both by turns and print a table."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as checkouts:
        folder = Path(name)
        runs: list[list[dict[str, float]]] = [[], []]
        trees = [
            checkouts.enter_context(checked_out(commit, folder / place))
            for place, commit in (("a", first), ("b", second))
        ]
        for number in range(ROUNDS):
            for tree, found in zip(trees, runs, strict=True):
                found.append(measured(tree, folder / "run.json"))
            print(f"round {number + 1} of {ROUNDS}", file=sys.stderr, flush=True)
    print(f"{'processor time, s':52s} {first[:10]:>10s} {second[:10]:>10s} {'ratio':>7s}")
    for name in runs[0][0]:
        before, after = ([run[name] for run in found] for found in runs)
        least = min(before), min(after)
        print(
            f"{name:52s} {least[0]:10.4g} {least[1]:10.4g} {least[1] / least[0]:7.3f} {verdict(before, after)}"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
