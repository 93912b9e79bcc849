"""Times of commands, absolute and relative to a reference recording: `python -m tests.benchmarks.command_times`.

Each command runs in a separate process with compiled code in the cache, as at a user's second call. The reference is
`daq record fig8-three-dampers` with the code of an earlier commit and the third-party packages of this environment.
Commands that use all cores have a limit of elapsed time, the others of processor time. The last rows are the first
calls on a machine, with an empty cache of compiled code.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from tests.benchmarks.checkouts import temporary_checkout

REFERENCE_COMMIT = "789067b"
SCENE = "fig8-three-dampers"
# Placeholder in a command for a folder that is new in each run: otherwise a study would continue an earlier run.
NEW_FOLDER = "{new}"
# Calls that compile, in this order: the engine, two dampers in one body, a periodic orbit.
FIRST_CALLS = {
    "engine": f"import rig; rig.simulate({SCENE!r}, duration=0.1)",
    "two dampers in one body": (
        "import rig; scene = rig.load('fig9'); "
        "rig.simulate(scene.replace(dampers=[*scene.dampers, scene.dampers[0]]), duration=0.1)"
    ),
    "periodic orbit": "import rig; rig.periodic_orbit('fig9', 49.6)",
}
# The first of these calls takes at most the first of these elapsed times, and all calls together at most the second, s.
MAX_FIRST_CALL_S = 15.0
MAX_FIRST_CALLS_S = 45.0


class Times(NamedTuple):
    """Processor time and elapsed time of a command, s."""

    processor: float
    elapsed: float


@dataclass(frozen=True)
class Command:
    """A command and the limits of its times.

    `max_ratio`: limit of the processor time relative to the reference recording; `max_seconds`: of the processor time,
    s; `max_elapsed`: of the elapsed time, s. `runs`: number of measured runs.
    """

    arguments: tuple[str, ...]
    max_ratio: float | None = None
    max_seconds: float | None = None
    max_elapsed: float | None = None
    runs: int = 2

    @property
    def name(self) -> str:
        """The command without its output options."""
        has_new_folder = any(NEW_FOLDER in argument for argument in self.arguments)
        end = self.arguments.index("-o") if has_new_folder else len(self.arguments)
        return " ".join(argument for argument in self.arguments[:end] if argument != "--overwrite")

    def exceeded_limits(self, times: Times, reference: float) -> str | None:
        """Return the exceeded limits as text, "" if there are none, None without limits.

        `reference`: processor time of the reference recording, s.
        """
        limits = (
            (self.max_ratio, times.processor / reference, ""),
            (self.max_seconds, times.processor, " s"),
            (self.max_elapsed, times.elapsed, " s elapsed"),
        )
        applicable = [(limit, value, unit) for limit, value, unit in limits if limit is not None]
        exceeded = [f"{limit:.3g}{unit}" for limit, value, unit in applicable if value > limit]
        return ", ".join(exceeded) if applicable else None

    def all_limits(self) -> str:
        """Return all limits as text."""
        limits = ((self.max_ratio, ""), (self.max_seconds, " s"), (self.max_elapsed, " s elapsed"))
        return ", ".join(f"{limit:.3g}{unit}" for limit, unit in limits if limit is not None)


GUESS = "structure.masses=[0.8 kg, 0.7 kg, 0.6 kg]"
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
    *(Command((package, "--help"), max_seconds=0.6) for package in ("rig", "daq", "analysis")),
    Command(
        ("rig", "design", "fig9", "--budget", "100 g", "--levels", "1.5N,3N,6N", "-o", NEW_FOLDER), max_elapsed=10.0
    ),
    Command(
        (
            "analysis", "fit", "recordings/demo-sweep-no-damper.mcap", "bare-structure", "--set", GUESS,
            "-o", f"{NEW_FOLDER}.yaml", "--overwrite",
        ),
        max_elapsed=2.0,
    ),
    Command(("analysis", "paper", "-o", NEW_FOLDER), max_elapsed=45.0, runs=1),
    Command(("rig", "cost", "fig9", "-o", NEW_FOLDER), max_elapsed=6.0),
    Command(("analysis", "cost", "fig9", "-o", NEW_FOLDER), max_seconds=20.0),
    Command(("rig", "map", "fig9", "-o", NEW_FOLDER), max_elapsed=5.0),
)  # fmt: skip


def run_times(command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> Times:
    """Run a Python command and return its times; the processor time includes the processes that it starts."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, *command], cwd=folder, env=dict(environment), check=True, capture_output=True)
    elapsed, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return Times(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, elapsed)


def environment_of(code: Path, **variables: str) -> dict[str, str]:
    """Return the environment of a process that runs the code of a folder."""
    environment = {**os.environ, "PYTHONPATH": str(code), "OPENBLAS_NUM_THREADS": "1", **variables}
    # A user's second call finds compiled modules.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return environment


def shortest_times(arguments: Sequence[str], folder: Path, code: Path, runs: int = 2) -> Times:
    """Return the shortest times of some runs with the code of a folder, after a run that fills the cache."""
    environment, times = environment_of(code), []
    for _ in range(1 + runs):
        new = str(Path(tempfile.mkdtemp(dir=folder)) / "new")
        command = ["-m", *(argument.replace(NEW_FOLDER, new) for argument in arguments)]
        times.append(run_times(command, folder, environment))
    return Times(*(min(values) for values in zip(*times[1:], strict=True)))


def table_row(command: Command, times: Times, reference: float) -> str:
    """Return one line of the table.

    >>> command = Command(("daq", "info", "a.mcap"), max_seconds=0.3)
    >>> table_row(command, Times(0.45, 0.5), 10.0)
    'daq info a.mcap                                              0.45   0.045     0.50  ABOVE 0.3 s'
    >>> table_row(Command(("rig", "map", "fig9", "-o", NEW_FOLDER), max_elapsed=5.0), Times(8.0, 4.5), 10.0)
    'rig map fig9                                                 8.00   0.800     4.50  within 5 s elapsed'
    """
    exceeded = command.exceeded_limits(times, reference)
    verdict = "" if exceeded is None else f"ABOVE {exceeded}" if exceeded else f"within {command.all_limits()}"
    processor, elapsed = times
    return f"{command.name[:55]:55s} {processor:9.2f} {processor / reference:7.3f} {elapsed:8.2f}  {verdict}".rstrip()


def first_calls(folder: Path, code: Path) -> Iterator[tuple[Command, Times]]:
    """Measure the first calls on a machine and their sum, with their limits."""
    environment = environment_of(code, NUMBA_CACHE_DIR=str(folder / "compiled"))
    total = Times(0.0, 0.0)
    for number, (name, source) in enumerate(FIRST_CALLS.items()):
        times = run_times(("-c", source), folder, environment)
        total = Times(*map(sum, zip(total, times, strict=True)))
        yield Command((f"first use: {name}",), max_elapsed=None if number else MAX_FIRST_CALL_S), times
    yield Command(("first use: all of these",), max_elapsed=MAX_FIRST_CALLS_S), total


def main() -> None:
    """Measure and print the table, and the commands whose limits are exceeded."""
    repository = Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "recordings").symlink_to(repository / "recordings")
        with temporary_checkout(REFERENCE_COMMIT, folder / "reference") as reference_code:
            record = ("daq", "record", SCENE, "-o", "r.mcap", "--overwrite")
            reference = shortest_times(record, folder, reference_code).processor
        print(f"daq record {SCENE} at {REFERENCE_COMMIT}: {reference:.2f} s of processor time")
        print(f"{'command':55s} {'CPU / s':>9s} {'ratio':>7s} {'wall / s':>8s}  limit")
        warm_calls = (
            (command, shortest_times(command.arguments, folder, repository, command.runs)) for command in COMMANDS
        )
        too_slow = []
        for command, times in chain(warm_calls, first_calls(folder, repository)):
            print(table_row(command, times, reference), flush=True)
            if command.exceeded_limits(times, reference):
                too_slow.append(command.name)
        print(f"above their limits: {', '.join(too_slow) or 'none'}")


if __name__ == "__main__":
    main()
