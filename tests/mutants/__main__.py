"""Mutation testing: change the code in places that matter, and count the changes that the tests detect: `make mutants`.

Each mutation is made in a copy of the checkout. A seed chooses among all mutations of a place:
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
from tests.mutants.trial import Trial, try_place

# Smallest share of the mutations of a place that its tests must detect.
MIN_SCORE = 0.85


def main() -> int:
    """Try the mutations; exit code 1 if the tests of a place detect too few."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="another seed chooses other mutations")
    parser.add_argument("--each", type=int, default=25, help="mutations of a place")
    parser.add_argument("--only", choices=PLACES, action="append", help="only this place; may be repeated")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    places = options.only or list(PLACES)
    trials: list[Trial] = []
    # One process for each place, because each works in its own folder.
    with ProcessPoolExecutor(options.workers, get_context("spawn"), max_tasks_per_child=1) as pool:
        running = [pool.submit(try_place, place, options.each, options.seed) for place in places]
        for job in track(as_completed(running), "mutants", len(places), console=Console(stderr=True)):
            trials += job.result()
            for each in job.result():
                if not each.detected:
                    print(f"not detected, {each.place}, {each.module}:\n{each.change}", flush=True)
                    print(f"{each.equivalent or 'reason unknown'}\n", flush=True)
    return print_summary(trials, places)


def print_summary(trials: list[Trial], places: list[str]) -> int:
    table = Table("place", "mutations", "detected", "not detected", "equivalent", "score")
    scores = []
    for place in places:
        detected = sum(each.detected for each in trials if each.place == place)
        undetected = [each for each in trials if each.place == place and not each.detected]
        equivalent = sum(bool(each.equivalent) for each in undetected)
        survivors = len(undetected) - equivalent
        scores.append(detected / (detected + survivors))
        counts = (detected + len(undetected), detected, survivors, equivalent)
        table.add_row(place, *map(str, counts), f"{scores[-1]:.0%}")
    Console().print(table)
    return 0 if min(scores) >= MIN_SCORE else 1


if __name__ == "__main__":
    sys.exit(main())
