"""Commands a user waits for, as processor time and as a ratio to recording: `python -m tests.benchmarks.answers`.

Each command is a process of its own with compiled code in the cache, as on a user's second call. The reference is
`daq record fig8-three-dampers` of an earlier commit, run with the packages installed here.
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

from tests.benchmarks.checkouts import checked_out

REFERENCE = "789067b"
SCENE = "fig8-three-dampers"


@dataclass(frozen=True)
class Wait:
    """A command and the time that it may take: a ratio to the reference recording, or seconds."""

    words: tuple[str, ...]
    ratio: float | None = None
    seconds: float | None = None


WAITS = (
    Wait(("daq", "record", SCENE, "-o", "a.mcap", "--overwrite"), ratio=1 / 2.5),
    Wait(("analysis", "frf", "a.mcap", "--overwrite"), ratio=0.25),
    Wait(("analysis", "modes", "a.mcap", "--overwrite"), ratio=0.3),
    Wait(("analysis", "dampers", "a.mcap", "--overwrite"), ratio=0.6),
    Wait(("analysis", "report", "a.mcap", "--overwrite"), ratio=1.0),
    Wait(("daq", "record", "fig10b-no-damper", "-o", "b.mcap", "--overwrite")),
    Wait(("analysis", "decay", "b.mcap", "--overwrite"), seconds=2.0),
    Wait(("daq", "info", "a.mcap"), seconds=0.3),
    Wait(("rig", "simulate", SCENE, "--duration", "0.1 s"), seconds=0.6),
    Wait(("rig", "explain", SCENE), seconds=0.6),
    Wait(("analysis", "--help"), seconds=0.6),
)


def processor_time(words: Sequence[str], folder: Path, environment: Mapping[str, str]) -> float:
    """Run a command of the product and return its user and system time, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", *words]
    subprocess.run(command, cwd=folder, env=dict(environment), check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def fastest(words: Sequence[str], folder: Path, tree: Path, runs: int = 2) -> float:
    """Return the shortest of some runs after one that fills the cache, with the packages of a tree."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}
    # A user's second call finds compiled modules.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    times = [processor_time(words, folder, environment) for _ in range(1 + runs)]
    return min(times[1:])


def row(wait: Wait, time: float, reference: float) -> str:
    """One line of the table.

    >>> row(Wait(("daq", "info", "a.mcap"), seconds=0.3), 0.45, 10.0)
    'daq info a.mcap                                        0.45   0.045  MISSED (0.3 s)'
    """
    goal = ""
    if wait.ratio is not None:
        goal = f"{'reached' if time <= wait.ratio * reference else 'MISSED'} ({wait.ratio:.2g})"
    elif wait.seconds is not None:
        goal = f"{'reached' if time <= wait.seconds else 'MISSED'} ({wait.seconds:g} s)"
    return (
        f"{' '.join(wait.words).removesuffix(' --overwrite'):50s} {time:8.2f} {time / reference:7.3f}  {goal}"
    )


def main() -> None:
    """Measure and print the table."""
    here = Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with checked_out(REFERENCE, folder / "reference") as tree:
            reference = fastest(("daq", "record", SCENE, "-o", "r.mcap", "--overwrite"), folder, tree)
        print(f"daq record {SCENE} at {REFERENCE}: {reference:.2f} s of processor time")
        print(f"{'command':50s} {'time / s':>8s} {'ratio':>7s}  goal")
        for wait in WAITS:
            print(row(wait, fastest(wait.words, folder, here), reference), flush=True)


if __name__ == "__main__":
    main()
