"""Answers to questions about dampers: computed by workers, kept in a table, never computed twice."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, fields
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from rig.damper_design.choice import Choice, Question, Trial
from rig.damper_design.worst_peak import Peak
from rig.kept_table import KeptTable
from rig.workers import Workers

#: Tells what came of a choice, as far as it is known.
Computed = Callable[[Choice], Trial | None]

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
        CSV file with all answers, for one structure and one level each, as soon as they are there; what stands there
        of the same question is believed.
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
        self._workers, self._progress = workers, progress
        self._done, self._total = 0, total
        self._table = None if table is None else KeptTable(table, _HEADER, "designs")
        self._known = {} if self._table is None else _known(self._table.rows)

    def trial(self, question: Question, choice: Choice) -> Trial | None:
        """Give the worst peaks of a choice if they are known."""
        peaks = [self._known.get((part.digest, choice)) for part in question.parts]
        found, levels = [peak for peak in peaks if peak is not None], len(question.levels)
        if len(found) < len(peaks):
            return None
        return Trial(choice, tuple(max(found[level::levels]) for level in range(levels)))

    def of(self, question: Question, choices: Sequence[Choice]) -> list[Trial]:
        """Try each choice."""
        found = self.follow(question, [lambda _: choices])
        return [found[choice] for choice in choices]

    def follow(
        self, question: Question, searches: Sequence[Callable[[Computed], Iterable[Choice]]]
    ) -> dict[Choice, Trial]:
        """Answer what searches want to know, until none wants more.

        Parameters
        ----------
        question : Question
            What they ask.
        searches : sequence of callable
            Each says, from the trials that are known, which choices it wants to know: all that it came by, and those
            that it waits for. It is asked again after every answer, so that no worker waits for one search while
            another wants something.

        Returns
        -------
        dict
            What came of each choice that was wanted, in the order of the choices.
        """
        asked: set[Choice] = set()
        pieces: list[tuple[Question, Choice]] = []

        def ask() -> None:
            for choice in chain.from_iterable(search(partial(self.trial, question)) for search in searches):
                if choice not in asked:
                    asked.add(choice)
                    missing = [part for part in question.parts if self.trial(part, choice) is None]
                    self._done += len(question.parts) - len(missing)
                    pieces.extend((part, choice) for part in missing)

        ask()
        for number, peak in self._workers.compute(_worst, pieces):
            part, choice = pieces[number]
            self._known[part.digest, choice] = peak
            if self._table is not None:
                self._table.append(_row(part.digest, choice, peak))
            self._done += 1
            if self._progress is not None:
                self._progress(self._done, max(self._total, self._done + 1))
            if self.trial(question, choice) is not None:
                ask()
        trials = [self.trial(question, choice) for choice in sorted(asked)]
        return {trial.choice: trial for trial in trials if trial is not None}

    def put_in_order(self) -> None:
        """Sort the table: the same answers make the same file, in whatever order they came."""
        if self._table is not None:
            self._table.put_in_order(_row(*asked, peak) for asked, peak in sorted(self._known.items()))


def _known(rows: Sequence[Sequence[str]]) -> dict[tuple[str, Choice], Peak]:
    known = {}
    for row in rows:
        try:
            bodies, masses, clearances = (each.split() for each in row[1:4])
            choice = Choice(tuple(map(int, bodies)), tuple(map(float, masses)), tuple(map(float, clearances)))
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
            continue
        known[row[0], choice] = peak
    return known


def _row(digest: str, choice: Choice, peak: Peak) -> list[Any]:
    lists = [" ".join(map(repr, each)) for each in astuple(choice)]
    return [digest, *lists, repr(choice.mass), *map(repr, astuple(peak))]


def _worst(asked: tuple[Question, Choice]) -> Peak:
    question, choice = asked
    return question.worst(choice)
