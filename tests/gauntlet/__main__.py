"""Compare the analysis with the truth on random scenes: ``python -m tests.gauntlet --scenes 300 --seed 7``.

Prints a table by judge and kind of test. Exit code 1: an answer was wrong without a warning, or the share of points
within their 95 % bounds is too small or too large.
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

# Share of the points within their 95 % bounds, over all scenes of a kind. Bounds that always hold are too wide,
# except where they contain the limit of a data sheet, which no sensor exceeds.
FEWEST_INSIDE, MOST_INSIDE = 0.90, 0.99
NARROW = ("responses, as built",)
OUTCOMES = ("right", "warned", "refused", "wrong")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=270, help="how many scenes (default: 270)")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other scenes")
    parser.add_argument("--kind", action="append", choices=KINDS, help="only this kind of test (repeatable)")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--verbose", action="store_true", help="print every scene, not only wrong ones")
    given = parser.parse_args()
    kinds = given.kind or KINDS
    found: list[Verdict] = []
    with ProcessPoolExecutor(given.workers) as pool:
        jobs = {
            pool.submit(run_trial, given.seed, number, kind := kinds[number % len(kinds)]): f"{number} {kind}"
            for number in range(given.scenes)
        }
        done = as_completed(jobs)
        try:
            for job in track(done, "gauntlet", total=len(jobs), console=Console(stderr=True)):
                found += job.result()
        except KeyboardInterrupt:
            # Report the finished scenes, and name those that were running.
            print("running:", *(name for job, name in jobs.items() if job.running()), sep="\n  ")
            pool.shutdown(wait=False, cancel_futures=True)
    for verdict in sorted(found, key=lambda verdict: (verdict.kind, verdict.scene)):
        if verdict.outcome == "wrong" or given.verbose:
            share = f"{verdict.inside / verdict.points:.0%}" if verdict.points else "-"
            print(f"{verdict.outcome:8} {verdict.judge} {verdict.scene} {share}: {verdict.note}")
    return print_summary(found)


def print_summary(found: list[Verdict]) -> int:
    groups: dict[tuple[str, str], list[Verdict]] = defaultdict(list)
    for verdict in found:
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
        share = inside / points if points else np.nan
        most = MOST_INSIDE if judge in NARROW else 1.0
        failed |= counts[-1] > 0 or (points > 0 and not FEWEST_INSIDE <= share <= most)
        widths = [v.width for v in verdicts if v.points and np.isfinite(v.width)]
        width = f"{np.median(widths):.2%}" if widths else "-"
        table.add_row(judge, kind, str(len(verdicts)), str(points), f"{share:.1%}", width, *map(str, counts))
    Console(width=140).print(table)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
