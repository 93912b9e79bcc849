"""Answers to questions about dampers: computed by workers, kept in a table, never computed twice."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import astuple, fields
from functools import lru_cache
from pathlib import Path

from rig.damper_design.choice import Choice, Question, Trial
from rig.damper_design.worst_peak import Peak
from rig.errors import RunError
from rig.workers import Workers

Known = dict[Choice, Peak]
Task = tuple[Question, Choice, Known]

_HEADER = [
    "question",
    "bodies",
    "masses_kg",
    "clearances_m",
    "mass_kg",
    *(field.name for field in fields(Peak)),
]


class Answers:
    """Peaks of choices, from a table or from workers.

    Parameters
    ----------
    workers : Workers
        They compute what is not known.
    table : Path or None
        CSV file with all answers, each as soon as those before it are there; what stands there of the same question
        is believed.
    progress : callable or None
        Called with the pieces of work done and of all, as far as that can be known.
    total : int
        About how many pieces there will be.

    Raises
    ------
    RunError
        If the table cannot be written.
    """

    def __init__(
        self, workers: Workers, table: Path | None, progress: Callable[[int, int], None] | None, total: int
    ) -> None:
        self._workers, self._table, self._progress = workers, table, progress
        self._done, self._total = 0, total
        self._known: dict[str, Known] = {}
        # Whether the table ends within a line, as a kill may leave it.
        self._torn = False
        if table is not None:
            try:
                self._read(table)
            except OSError as error:
                raise RunError(
                    f"cannot write {table}: {error.strerror}; choose another place with -o"
                ) from None

    def known(self, question: Question) -> Known:
        """Give the answers to a question so far."""
        return self._known.setdefault(_digest(question), {})

    def of(self, question: Question, choices: Sequence[Choice]) -> list[Peak]:
        """Give the worst peak of each choice."""
        known = self.known(question)
        missing = [choice for choice in dict.fromkeys(choices) if choice not in known]
        self._done += len(choices) - len(missing)
        self.found_by(_worst, question, missing)
        return [known[choice] for choice in choices]

    def found_by(
        self, search: Callable[[Task], list[Trial]], question: Question, starts: Sequence[Choice]
    ) -> None:
        """Search from each start, knowing what is known of the same bodies and masses."""
        known = self.known(question)
        tasks = [
            (
                question,
                start,
                {c: p for c, p in known.items() if (c.bodies, c.masses) == (start.bodies, start.masses)},
            )
            for start in starts
        ]
        ready: dict[int, list[Trial]] = {}
        kept = 0
        for number, trials in self._workers.compute(search, tasks):
            ready[number] = trials
            # In the order in which they were asked for, whoever is quicker: the same table wherever it is computed.
            while kept in ready:
                new = [trial for trial in ready.pop(kept) if trial.choice not in known]
                known.update((trial.choice, trial.peak) for trial in new)
                self._keep(_digest(question), new)
                kept += 1
            self._done += 1
            if self._progress is not None:
                self._progress(self._done, max(self._total, self._done + 1))

    def _keep(self, digest: str, trials: Sequence[Trial]) -> None:
        if self._table is None or not trials:
            return
        with self._table.open("a", newline="", encoding="utf-8") as file:
            if self._torn:
                file.write("\n")
                self._torn = False
            writer = csv.writer(file, lineterminator="\n")
            for trial in trials:
                choice = trial.choice
                lists = [" ".join(map(repr, each)) for each in astuple(choice)]
                writer.writerow([digest, *lists, repr(choice.mass), *map(repr, astuple(trial.peak))])

    def _read(self, path: Path) -> None:
        if not path.exists():
            with path.open("x", newline="", encoding="utf-8") as file:
                csv.writer(file, lineterminator="\n").writerow(_HEADER)
        with path.open(newline="", encoding="utf-8", errors="replace") as file:
            lines = file.readlines()
        rows = list(csv.reader(lines))
        self._torn = not lines[-1].endswith("\n") if lines else False
        if rows[:1] != [_HEADER]:
            raise RunError(f"{path}: is no table of designs; move it, or choose another place with -o")
        for row in rows[1:]:
            try:
                bodies, masses, clearances = (each.split() for each in row[1:4])
                choice = Choice(
                    tuple(map(int, bodies)), tuple(map(float, masses)), tuple(map(float, clearances))
                )
                size, frequency, level, body, acceleration, simulated = row[5:]
                peak = Peak(
                    float(size),
                    float(frequency),
                    float(level),
                    int(body),
                    float(acceleration),
                    float(simulated),
                )
            except ValueError:
                # The last line of a search that was killed may be torn.
                continue
            self._known.setdefault(row[0], {})[choice] = peak


@lru_cache(maxsize=256)
def _digest(question: Question) -> str:
    """Name a question by all that its answers depend on."""
    scenes = [scene.to_yaml() for scene in question.scenes]
    told = (
        scenes, question.levels, question.band, question.bodies, question.restitution, question.density,
    )  # fmt: skip
    return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


def _worst(task: Task) -> list[Trial]:
    question, choice, _ = task
    return [Trial(choice, question.worst(choice))]
