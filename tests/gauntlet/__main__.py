"""Compare the analysis with the truth on random scenes: ``python -m tests.gauntlet --scenes 300 --seed 7``.

The test of each scene is recorded and analyzed. A *check* compares one kind of result with the truth, point by point; a
point is a value with a 95 % interval. The printed table has a row for each check and kind of test. Exit code 1: a
result was wrong without a warning, or the fraction of points within their 95 % intervals is too small or too large.
"""

import argparse
import os
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from tests.gauntlet.checks.controlled_tones import EXACT_SENSORS
from tests.gauntlet.result import CheckResult
from tests.gauntlet.scenes import KINDS
from tests.gauntlet.trial import run_trial

# Smallest and largest fraction of the points within their 95 % intervals, over all scenes of a kind.
MIN_COVERAGE = 0.90
MAX_COVERAGE = 0.99
# The largest fraction applies only to intervals without sensor tolerances. No sensor exceeds its tolerance: intervals
# with tolerances therefore contain more than 95 %.
CHECKS_WITHOUT_TOLERANCES = ("responses, as built", "magnitudes, as built", EXACT_SENSORS)
OUTCOMES = ("correct", "warned", "refused", "wrong")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=300, help="how many scenes (default: 300)")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other scenes")
    parser.add_argument("--kind", action="append", choices=KINDS, help="only this kind of test (repeatable)")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--verbose", action="store_true", help="print every scene, not only wrong ones")
    options = parser.parse_args()
    kinds = options.kind or KINDS
    results: list[CheckResult] = []
    with ProcessPoolExecutor(options.workers) as pool:
        jobs = {
            pool.submit(run_trial, options.seed, number, kind := kinds[number % len(kinds)]): f"{number} {kind}"
            for number in range(options.scenes)
        }
        completed = as_completed(jobs)
        try:
            for job in track(completed, "gauntlet", total=len(jobs), console=Console(stderr=True)):
                results += job.result()
        except KeyboardInterrupt:
            # Report the finished scenes, and name the unfinished ones.
            print("not finished:", *(name for job, name in jobs.items() if job.running()), sep="\n  ")
            pool.shutdown(wait=False, cancel_futures=True)
    for result in sorted(results, key=lambda result: (result.kind, result.scene)):
        if result.outcome == "wrong" or options.verbose:
            coverage = f"{result.inside / result.points:.0%}" if result.points else "-"
            print(f"{result.outcome:8} {result.check} {result.scene} {coverage}: {result.note}")
    return print_summary(results)


def print_summary(all_results: list[CheckResult]) -> int:
    """Print a row for each check and kind of test; return the exit code."""
    groups: dict[tuple[str, str], list[CheckResult]] = defaultdict(list)
    for result in all_results:
        groups[result.check, result.kind].append(result)
    table = Table(
        "check",
        "kind of test",
        "scenes",
        "points",
        "within 95 % bounds",
        "median bound",
        "correct",
        "warned",
        "refused",
        "wrong",
    )
    failed = False
    for (check, kind), results in sorted(groups.items()):
        points = sum(result.points for result in results)
        inside = sum(result.inside for result in results)
        counts = [sum(result.outcome == outcome for result in results) for outcome in OUTCOMES]
        coverage = inside / points if points else np.nan
        max_coverage = MAX_COVERAGE if check in CHECKS_WITHOUT_TOLERANCES else 1.0
        failed |= counts[-1] > 0 or (points > 0 and not MIN_COVERAGE <= coverage <= max_coverage)
        bounds = [result.relative_bound for result in results if result.points and np.isfinite(result.relative_bound)]
        median_bound = f"{np.median(bounds):.2%}" if bounds else "-"
        table.add_row(check, kind, str(len(results)), str(points), f"{coverage:.1%}", median_bound, *map(str, counts))
    Console(width=140).print(table)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
