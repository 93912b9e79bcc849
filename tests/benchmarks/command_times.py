"""Processor time of commands, absolute and relative to a recording: `python -m tests.benchmarks.command_times`.

Each command runs in a separate process with compiled code in the cache, as at a user's second call. The reference is
`daq record fig8-three-dampers` with the code of an earlier commit and the third-party packages of this environment.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.checkouts import temporary_checkout

REFERENCE = "789067b"
SCENE = "fig8-three-dampers"


@dataclass(frozen=True)
class Command:
    """A command and its largest time: relative to the reference recording, or in seconds."""

    words: tuple[str, ...]
    max_ratio: float | None = None
    max_seconds: float | None = None


COMMANDS = (
    Command(("daq", "record", SCENE, "-o", "a.mcap", "--overwrite"), max_ratio=1 / 2.5),
    Command(("analysis", "frf", "a.mcap", "--overwrite"), max_ratio=0.25),
    Command(("analysis", "modes", "a.mcap", "--overwrite"), max_ratio=0.3),
    Command(("analysis", "dampers", "a.mcap", "--overwrite"), max_ratio=0.6),
    Command(("analysis", "report", "a.mcap", "--overwrite"), max_ratio=1.0),
    Command(("daq", "record", "fig10b-no-damper", "-o", "b.mcap", "--overwrite")),
    Command(("analysis", "decay", "b.mcap", "--overwrite"), max_seconds=2.0),
    Command(("daq", "info", "a.mcap"), max_seconds=0.3),
    Command(("rig", "simulate", SCENE, "--duration", "0.1 s"), max_seconds=0.6),
    Command(("rig", "explain", SCENE), max_seconds=0.6),
    Command(("analysis", "--help"), max_seconds=0.6),
)


def processor_time(words: Sequence[str], folder: Path, environment: Mapping[str, str]) -> float:
    """Run a shotrig command and return its user and system time, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", *words]
    subprocess.run(command, cwd=folder, env=dict(environment), check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def shortest_time(words: Sequence[str], folder: Path, code: Path, runs: int = 2) -> float:
    """Return the shortest time of some runs with the code of a folder, after one run that fills the cache."""
    environment = {**os.environ, "PYTHONPATH": str(code), "OPENBLAS_NUM_THREADS": "1"}
    # A user's second call finds compiled modules.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    times = [processor_time(words, folder, environment) for _ in range(1 + runs)]
    return min(times[1:])


def table_row(command: Command, time: float, reference: float) -> str:
    """Return one line of the table.

    >>> table_row(Command(("daq", "info", "a.mcap"), max_seconds=0.3), 0.45, 10.0)
    'daq info a.mcap                                        0.45   0.045  MISSED (0.3 s)'
    """
    goal = ""
    if command.max_ratio is not None:
        goal = f"{'reached' if time <= command.max_ratio * reference else 'MISSED'} ({command.max_ratio:.2g})"
    elif command.max_seconds is not None:
        goal = f"{'reached' if time <= command.max_seconds else 'MISSED'} ({command.max_seconds:g} s)"
    return f"{' '.join(command.words).removesuffix(' --overwrite'):50s} {time:8.2f} {time / reference:7.3f}  {goal}"


def main() -> None:
    """Measure and print the table."""
    repository = Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with temporary_checkout(REFERENCE, folder / "reference") as reference_code:
            reference = shortest_time(("daq", "record", SCENE, "-o", "r.mcap", "--overwrite"), folder, reference_code)
        print(f"daq record {SCENE} at {REFERENCE}: {reference:.2f} s of processor time")
        print(f"{'command':50s} {'time / s':>8s} {'ratio':>7s}  goal")
        for command in COMMANDS:
            print(table_row(command, shortest_time(command.words, folder, repository), reference), flush=True)


if __name__ == "__main__":
    main()
