"""Faults by the hundred in the places that matter, and whether the tests notice: `make mutants`.

Each fault is made in a copy of the checkout, never in it. A seed chooses among all that a place offers:
`python -m tests.mutants --seed 2 --only filters --each 40`.
"""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from rich.console import Console
from rich.progress import track
from rich.table import Table

from tests.mutants.places import PLACES
from tests.mutants.trial import Found, try_place

# Share of the faults in a place that its tests must notice.
ENOUGH = 0.85


def main() -> int:
    """Try the faults; exit code 1 where the tests of a place notice too few."""
    words = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    words.add_argument("--seed", type=int, default=1, help="another seed chooses other faults")
    words.add_argument("--each", type=int, default=25, help="faults in a place")
    words.add_argument("--only", choices=PLACES, action="append", help="this place; may be repeated")
    words.add_argument("--workers", type=int, default=os.cpu_count())
    told = words.parse_args()
    places = told.only or list(PLACES)
    found: list[Found] = []
    # A process for each place, as each works in a folder of its own.
    with ProcessPoolExecutor(told.workers, get_context("spawn"), max_tasks_per_child=1) as pool:
        running = [pool.submit(try_place, place, told.each, told.seed) for place in places]
        for job in track(as_completed(running), "mutants", len(places), console=Console(stderr=True)):
            found += job.result()
            for each in job.result():
                if not each.noticed:
                    print(f"not noticed, {each.place}, {each.module}:\n{each.change}", flush=True)
                    print(f"{each.equivalent or 'no reason is known'}\n", flush=True)
    return _tell(found, places)


def _tell(found: list[Found], places: list[str]) -> int:
    table = Table("place", "faults", "noticed", "not noticed", "change nothing", "score")
    scores = []
    for place in places:
        noticed = sum(each.noticed for each in found if each.place == place)
        missed = [each for each in found if each.place == place and not each.noticed]
        equivalent = sum(bool(each.equivalent) for each in missed)
        survivors = len(missed) - equivalent
        scores.append(noticed / (noticed + survivors))
        counts = (noticed + len(missed), noticed, survivors, equivalent)
        table.add_row(place, *map(str, counts), f"{scores[-1]:.0%}")
    Console().print(table)
    return 0 if min(scores) >= ENOUGH else 1


if __name__ == "__main__":
    sys.exit(main())
