"""Mutation testing: change the code of important modules, and count the changes that the tests detect: `make mutants`.

A mutation is a small change of one line. Each is made in a copy of the checkout. A place is a group of modules with
their tests. The seed chooses among all mutations of a place:
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

# Smallest fraction of the mutations of a place that its tests must detect; equivalent mutations do not count.
MIN_SCORE = 0.85


def main() -> int:
    """Try the mutations; exit code 1 if the tests of a place detect too few."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="another seed chooses other mutations")
    parser.add_argument("--each", type=int, default=25, help="number of mutations of each place")
    parser.add_argument("--only", choices=PLACES, action="append", help="only this place; may be repeated")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    places = options.only or list(PLACES)
    trials: list[Trial] = []
    # One process for each place, because each works in its own folder.
    with ProcessPoolExecutor(options.workers, get_context("spawn"), max_tasks_per_child=1) as pool:
        jobs = [pool.submit(try_place, place, options.each, options.seed) for place in places]
        for job in track(as_completed(jobs), "mutants", len(places), console=Console(stderr=True)):
            trials += job.result()
            for trial in job.result():
                if not trial.detected:
                    print(f"not detected, {trial.place}, {trial.module}:\n{trial.change}", flush=True)
                    print(f"{trial.equivalent or 'reason unknown'}\n", flush=True)
    return print_summary(trials, places)


def print_summary(trials: list[Trial], places: list[str]) -> int:
    """Print a row for each place; return the exit code."""
    table = Table("place", "mutations", "detected", "not detected", "equivalent", "score")
    scores = []
    for place in places:
        detected = sum(trial.detected for trial in trials if trial.place == place)
        undetected = [trial for trial in trials if trial.place == place and not trial.detected]
        equivalent = sum(bool(trial.equivalent) for trial in undetected)
        survivors = len(undetected) - equivalent
        scores.append(detected / (detected + survivors))
        counts = (detected + len(undetected), detected, survivors, equivalent)
        table.add_row(place, *map(str, counts), f"{scores[-1]:.0%}")
    Console().print(table)
    return 0 if min(scores) >= MIN_SCORE else 1


if __name__ == "__main__":
    sys.exit(main())
