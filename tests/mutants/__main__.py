"""Faults by the hundred in the places that matter, and whether the tests notice: `make mutants`.

Each fault is made in a copy of the checkout, never in it. Where a module offers more faults than are asked for, a
seed chooses: `python -m tests.mutants --seed 2 --only filters --each 30`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from rich.console import Console
from rich.progress import track
from rich.table import Table

from tests.mutants.places import EQUIVALENT, PLACES
from tests.mutants.trial import Found, try_module

# Share of the faults in a place that its tests must notice.
ENOUGH = 0.85


def main() -> int:
    """Try the faults; exit code 1 where the tests of a place notice too few."""
    words = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    words.add_argument("--seed", type=int, default=1, help="another seed chooses other faults")
    words.add_argument("--each", type=int, default=20, help="most faults in a module")
    words.add_argument("--only", choices=PLACES, action="append", help="this place; may be repeated")
    words.add_argument("--workers", type=int, default=os.cpu_count())
    told = words.parse_args()
    jobs = [
        (place, module, tests, told.each, told.seed)
        for place in told.only or PLACES
        for module, tests in PLACES[place].items()
    ]
    found: list[Found] = []
    # A process for each module, as each works in a folder of its own.
    with ProcessPoolExecutor(told.workers, get_context("spawn"), max_tasks_per_child=1) as pool:
        running = [pool.submit(try_module, *job) for job in jobs]
        for job in track(as_completed(running), "mutants", len(jobs), console=Console(stderr=True)):
            found += job.result()
            for each in job.result():
                if not each.noticed:
                    print(f"not noticed, {each.place}, {each.module}:\n{each.change}\n", flush=True)
    return _tell(found)


def _tell(found: list[Found]) -> int:
    groups: dict[str, list[bool]] = defaultdict(list)
    for each in found:
        if each.noticed or not any(text in each.change for text in EQUIVALENT):
            groups[each.place].append(each.noticed)
    table = Table("place", "faults", "noticed")
    for place, noticed in groups.items():
        table.add_row(place, str(len(noticed)), f"{sum(noticed) / len(noticed):.0%}")
    Console().print(table)
    return 1 if any(sum(noticed) < ENOUGH * len(noticed) for noticed in groups.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
