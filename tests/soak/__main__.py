"""Inject hundreds of faults into commands: kills, damaged files, full disks and invalid input (`make soak`).

A command must report a fault without a traceback, and must not lose or change files. Every case has a number, which
reproduces it: `python -m tests.soak --only damage --seed 1234 --cases 1`.
"""

import argparse
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn

from tests.soak.cases import KINDS, Workspace
from tests.soak.command import PACKAGES, CommandResult

matplotlib.use("agg")

# Default number of cases of each kind.
CASES = {
    "kills": 200,
    "writing": 200,
    "starts": 100,
    "studies": 40,
    "damage": 400,
    "disks": 100,
    "scenes": 150,
    "commands": 60,
    "words": 100,
    "recordings": 150,
    "imports": 150,
    "servers": 40,
    "attacks": 60,
}


@dataclass
class Tally:
    """Results of the cases of a kind; memory [bytes] and seconds are the largest of a command."""

    cases: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    memory: int = 0
    seconds: float = 0.0

    def add(self, number: int, result: CommandResult, file_faults: list[str]) -> None:
        """Count a case and print its faults."""
        faults = result.faults + file_faults
        self.cases += 1
        self.faults.update(faults)
        self.memory, self.seconds = max(self.memory, result.memory), max(self.seconds, result.seconds)
        if faults:
            last_line = (result.output.strip().splitlines() or [""])[-1]
            print(f"  {number}: {' '.join(result.command)!r}: {', '.join(faults)}: {last_line[:160]!r}", flush=True)


def main() -> int:
    """Run the cases and print the table; exit code 1 with any fault, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="number of the first case of each kind")
    parser.add_argument("--only", choices=KINDS, action="append", help="only this kind; may be repeated")
    parser.add_argument("--cases", type=int, help="number of cases of each kind")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop each kind after this time")
    options = parser.parse_args()
    # A shell starts background commands with interrupts ignored, but Ctrl-C must print the table.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Most commands run in forks of this process: import their packages once, here.
    for package in PACKAGES:
        __import__(f"{package}.commands.cli")
    tallies: dict[str, Tally] = {}
    try:
        with tempfile.TemporaryDirectory(prefix="soak-") as folder, progress_bar() as progress:
            workspace = Workspace(Path(folder))
            for kind in options.only or KINDS:
                tallies[kind] = Tally()
                numbers = range(options.seed, options.seed + (options.cases or CASES[kind]))
                run_cases(workspace, kind, numbers, 60.0 * options.minutes, tallies[kind], progress)
    except KeyboardInterrupt:
        print("\ninterrupted; results of the finished cases:")
        print_table(tallies)
        return 130
    print_table(tallies)
    return 1 if any(tally.faults for tally in tallies.values()) else 0


def run_cases(workspace, kind, numbers, seconds, tally, progress):
    """Run the cases of a kind until their time limit."""
    print(f"{kind}:", flush=True)
    task, deadline = progress.add_task(kind, total=len(numbers)), time.monotonic() + seconds
    for number in numbers:
        if time.monotonic() > deadline:
            break
        tally.add(number, *KINDS[kind](workspace, random.Random(number)))
        progress.update(task, advance=1, refresh=True)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Show the progress of each kind without a thread: a fork could interrupt it while it writes."""
    columns = *Progress.get_default_columns(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), auto_refresh=False) as progress:
        yield progress


def print_table(tallies: dict[str, Tally]) -> None:
    """Print a row for each kind."""
    print(f"\n{'kind':12}{'cases':>7}{'max s':>11}{'max MB':>9}   faults")
    for kind, tally in tallies.items():
        faults = ", ".join(f"{count} {fault}" for fault, count in tally.faults.items()) or "none"
        print(f"{kind:12}{tally.cases:7}{tally.seconds:11.1f}{tally.memory / 1e6:9.0f}   {faults}")


if __name__ == "__main__":
    sys.exit(main())
