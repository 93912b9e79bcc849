"""Inject hundreds of faults: kills, damaged files, full disks and invalid input: `make soak`.

Every case has a number, which reproduces it: `python -m tests.soak --only damage --seed 1234 --cases 1`.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn

from tests.soak.cases import KINDS, Bench
from tests.soak.command import PACKAGES, Ended

matplotlib.use("agg")

# Number of cases of each kind by default.
CASES = {
    "kills": 200,
    "starts": 100,
    "studies": 40,
    "damage": 400,
    "disks": 100,
    "scenes": 150,
    "commands": 60,
    "words": 100,
    "recordings": 150,
    "imports": 150,
}


@dataclass
class Tally:
    """Results of the cases of a kind."""

    cases: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    memory: int = 0
    seconds: float = 0.0

    def add(self, number: int, ended: Ended, further: list[str]) -> None:
        """Count a case and print its faults."""
        faults = ended.faults + further
        self.cases += 1
        self.faults.update(faults)
        self.memory, self.seconds = max(self.memory, ended.memory), max(self.seconds, ended.seconds)
        if faults:
            last_line = (ended.output.strip().splitlines() or [""])[-1]
            print(f"  {number}: {' '.join(ended.command)!r}: {', '.join(faults)}: {last_line[:160]!r}", flush=True)


def main() -> int:
    """Run the cases and print the table; exit code 1 with any fault, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="number of the first case of each kind")
    parser.add_argument("--only", choices=KINDS, action="append", help="only this kind; may be repeated")
    parser.add_argument("--cases", type=int, help="number of cases of each kind")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop each kind after this time")
    options = parser.parse_args()
    # A shell starts background commands with interrupts ignored; Ctrl-C must print the table.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Most commands run in forks of this process, so that their imports happen once, here.
    for package in PACKAGES:
        __import__(f"{package}.cli")
    tallies: dict[str, Tally] = {}
    try:
        with tempfile.TemporaryDirectory(prefix="soak-") as folder, progress_bar() as progress:
            print("making the recordings to be damaged", file=sys.stderr)
            bench = Bench(Path(folder))
            for kind in options.only or KINDS:
                tallies[kind] = Tally()
                numbers = range(options.seed, options.seed + (options.cases or CASES[kind]))
                _run(bench, kind, numbers, 60.0 * options.minutes, tallies[kind], progress)
    except KeyboardInterrupt:
        print("\ninterrupted; so far:")
        print_table(tallies)
        return 130
    print_table(tallies)
    return 1 if any(tally.faults for tally in tallies.values()) else 0


def _run(bench: Bench, kind: str, numbers: Sequence[int], seconds: float, tally: Tally, progress: Progress) -> None:
    """Run the cases of a kind until their time limit."""
    print(f"{kind}:", flush=True)
    task, deadline = progress.add_task(kind, total=len(numbers)), time.monotonic() + seconds
    for number in numbers:
        if time.monotonic() > deadline:
            break
        tally.add(number, *KINDS[kind](bench, random.Random(number)))
        progress.update(task, advance=1, refresh=True)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Show the progress of each kind, without a thread, which a fork could interrupt while it writes."""
    columns = *Progress.get_default_columns(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), auto_refresh=False) as progress:
        yield progress


def print_table(tallies: dict[str, Tally]) -> None:
    """Print the table."""
    print(f"\n{'kind':12}{'cases':>7}{'longest s':>11}{'most MB':>9}   faults")
    for kind, tally in tallies.items():
        faults = ", ".join(f"{count} {fault}" for fault, count in tally.faults.items()) or "none"
        print(f"{kind:12}{tally.cases:7}{tally.seconds:11.1f}{tally.memory / 1e6:9.0f}   {faults}")


if __name__ == "__main__":
    sys.exit(main())
