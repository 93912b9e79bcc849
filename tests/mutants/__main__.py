"""Mutation testing: change the code of important modules, and count the changes that the tests detect: `make mutants`.

A mutation is a small change of one line. Each mutation is made in a copy of the checkout. A group consists of modules
with their tests. The seed chooses among all mutations of a group: `python -m tests.mutants --seed 2 --only filters
--each 40`.
"""

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from rich.console import Console
from rich.progress import track
from rich.table import Table

from tests.mutants.groups import GROUPS
from tests.mutants.trial import Trial, try_group

# The tests of a group must detect at least this fraction of its mutations; equivalent mutations do not count.
MIN_SCORE = 0.85


def main() -> int:
    """Try the mutations; exit code 1 if the tests of a group detect too few."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="another seed chooses other mutations")
    parser.add_argument("--each", type=int, default=25, help="number of mutations of each group")
    parser.add_argument("--only", choices=GROUPS, action="append", help="only this group; may be repeated")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    groups = options.only or list(GROUPS)
    trials: list[Trial] = []
    # One process for each group, because each works in its own folder.
    with ProcessPoolExecutor(options.workers, get_context("spawn"), max_tasks_per_child=1) as pool:
        jobs = [pool.submit(try_group, group, options.each, options.seed) for group in groups]
        for job in track(as_completed(jobs), "mutants", len(groups), console=Console(stderr=True)):
            trials += job.result()
            for trial in job.result():
                if not trial.detected:
                    print(f"not detected, {trial.group}, {trial.module}:\n{trial.change}", flush=True)
                    print(f"{trial.equivalent or 'reason unknown'}\n", flush=True)
    return print_summary(trials, groups)


def print_summary(trials: list[Trial], groups: list[str]) -> int:
    """Print a row for each group; return the exit code."""
    table = Table("group", "mutations", "detected", "not detected", "equivalent", "score")
    scores = []
    for group in groups:
        detected = sum(trial.detected for trial in trials if trial.group == group)
        undetected = [trial for trial in trials if trial.group == group and not trial.detected]
        equivalent = sum(bool(trial.equivalent) for trial in undetected)
        survivors = len(undetected) - equivalent
        scores.append(detected / (detected + survivors))
        counts = (detected + len(undetected), detected, survivors, equivalent)
        table.add_row(group, *map(str, counts), f"{scores[-1]:.0%}")
    Console().print(table)
    return 0 if min(scores) >= MIN_SCORE else 1


if __name__ == "__main__":
    sys.exit(main())
