"""Compare the analysis with the truth on random scenes: ``python -m tests.gauntlet --scenes 300 --seed 7``.

The test of each scene is recorded and analyzed. A judge compares one kind of result with the truth, point by point; a
point is a value with a 95 % interval. The printed table has a row for each judge and kind of test. Exit code 1: a
result was wrong without a warning, or the fraction of points within their 95 % intervals is too small or too large.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from tests.gauntlet.scenes import KINDS
from tests.gauntlet.trial import run_trial
from tests.gauntlet.verdict import Verdict

# Smallest and largest fraction of the points within their 95 % intervals, over all scenes of a kind.
MIN_COVERAGE = 0.90
MAX_COVERAGE = 0.99
# The largest fraction applies only to intervals without sensor tolerances. No sensor exceeds its tolerance: intervals
# with tolerances therefore contain more than 95 %.
JUDGES_WITHOUT_TOLERANCES = ("responses, as built",)
OUTCOMES = ("right", "warned", "refused", "wrong")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=300, help="how many scenes (default: 300)")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other scenes")
    parser.add_argument("--kind", action="append", choices=KINDS, help="only this kind of test (repeatable)")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--verbose", action="store_true", help="print every scene, not only wrong ones")
    options = parser.parse_args()
    kinds = options.kind or KINDS
    verdicts: list[Verdict] = []
    with ProcessPoolExecutor(options.workers) as pool:
        jobs = {
            pool.submit(run_trial, options.seed, number, kind := kinds[number % len(kinds)]): f"{number} {kind}"
            for number in range(options.scenes)
        }
        completed = as_completed(jobs)
        try:
            for job in track(completed, "gauntlet", total=len(jobs), console=Console(stderr=True)):
                verdicts += job.result()
        except KeyboardInterrupt:
            # Report the finished scenes, and name the unfinished ones.
            print("not finished:", *(name for job, name in jobs.items() if job.running()), sep="\n  ")
            pool.shutdown(wait=False, cancel_futures=True)
    for verdict in sorted(verdicts, key=lambda verdict: (verdict.kind, verdict.scene)):
        if verdict.outcome == "wrong" or options.verbose:
            coverage = f"{verdict.inside / verdict.points:.0%}" if verdict.points else "-"
            print(f"{verdict.outcome:8} {verdict.judge} {verdict.scene} {coverage}: {verdict.note}")
    return print_summary(verdicts)


def print_summary(all_verdicts: list[Verdict]) -> int:
    """Print a row for each judge and kind of test; return the exit code."""
    groups: dict[tuple[str, str], list[Verdict]] = defaultdict(list)
    for verdict in all_verdicts:
        groups[verdict.judge, verdict.kind].append(verdict)
    table = Table(
        "judge",
        "kind of test",
        "scenes",
        "points",
        "within 95 % bounds",
        "median bound",
        "right",
        "warned",
        "refused",
        "wrong",
    )
    failed = False
    for (judge, kind), verdicts in sorted(groups.items()):
        points = sum(verdict.points for verdict in verdicts)
        inside = sum(verdict.inside for verdict in verdicts)
        counts = [sum(v.outcome == outcome for v in verdicts) for outcome in OUTCOMES]
        coverage = inside / points if points else np.nan
        max_coverage = MAX_COVERAGE if judge in JUDGES_WITHOUT_TOLERANCES else 1.0
        failed |= counts[-1] > 0 or (points > 0 and not MIN_COVERAGE <= coverage <= max_coverage)
        widths = [v.width for v in verdicts if v.points and np.isfinite(v.width)]
        width = f"{np.median(widths):.2%}" if widths else "-"
        table.add_row(judge, kind, str(len(verdicts)), str(points), f"{coverage:.1%}", width, *map(str, counts))
    Console(width=140).print(table)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
