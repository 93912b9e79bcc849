"""Evaluation of candidate designs: workers compute the worst peaks, a table stores them for later searches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple
from functools import partial
from pathlib import Path
from typing import Any

from rig.damper_design.choice import Choice, Objective, Trial
from rig.damper_design.worst_peak import Peak
from rig.progress import CountProgress
from rig.study import StoredValues, Study
from rig.workers import Workers

#: Function that returns the trial of a candidate design, or None if it is not computed yet.
KnownTrials = Callable[[Choice], Trial | None]
#: An objective for one structure at one level (`Objective.subproblems`), and a candidate design.
Piece = tuple[Objective, Choice]


class Evaluator:
    """Provider of the worst peaks of candidate designs, from a table or from workers.

    Workers compute the peaks that are missing in `table`, a CSV file with a row for each design, structure and level.
    Each result is added to it at once. `total`: approximate number of pieces, for `progress`. Raises `RunError` if the
    table cannot be written.
    """

    def __init__(self, workers: Workers, table: Path | None, progress: CountProgress | None, total: int) -> None:
        self._workers, self._progress = workers, progress
        self._finished, self._total = 0, total
        self._stored = StoredValues(STUDY, table)

    def trial(self, objective: Objective, choice: Choice) -> Trial | None:
        """Return the worst peaks of a design, or None if one of them is not computed yet."""
        peaks = [self._stored.values.get((subproblem.digest, choice)) for subproblem in objective.subproblems]
        known, levels = [peak for peak in peaks if peak is not None], len(objective.levels)
        if len(known) < len(peaks):
            return None
        # The subproblems are in the order of structures, then levels.
        return Trial(choice, tuple(max(known[level::levels]) for level in range(levels)))

    def compute(self, objective: Objective, choices: Sequence[Choice]) -> list[Trial]:
        """Compute the worst peaks of each design."""
        trials = self.run_searches(objective, [lambda _: choices])
        return [trials[choice] for choice in choices]

    def run_searches(
        self, objective: Objective, searches: Sequence[Callable[[KnownTrials], Iterable[Choice]]]
    ) -> dict[Choice, Trial]:
        """Compute the designs that several searches need, until all searches are finished.

        `searches`: functions of the known results. Each returns the designs that it has used, and those for which it
        waits. It is called again after each result for which it waits, so that no worker is idle while a search needs a
        design. Returns the trials, sorted by design.
        """
        requested: set[Choice] = set()
        pieces: list[Piece] = []
        # Designs for which each search waits.
        awaited: list[set[Choice]] = [set() for _ in searches]

        def request_designs(numbers: Iterable[int]) -> None:
            for number in numbers:
                choices = list(searches[number](partial(self.trial, objective)))
                awaited[number] = {choice for choice in choices if self.trial(objective, choice) is None}
                for choice in choices:
                    if choice not in requested:
                        requested.add(choice)
                        needed = [(subproblem, choice) for subproblem in objective.subproblems]
                        missing = [piece for piece in needed if piece not in self._stored]
                        self._finished += len(needed) - len(missing)
                        pieces.extend(missing)

        request_designs(range(len(searches)))
        for number, peak in self._workers.compute(_compute, pieces):
            self._stored.add(pieces[number], peak)
            self._finished += 1
            if self._progress is not None:
                self._progress(self._finished, max(self._total, self._finished + 1))
            choice = pieces[number][1]
            if self.trial(objective, choice) is not None:
                request_designs([k for k, designs in enumerate(awaited) if choice in designs])
        trials = [self.trial(objective, choice) for choice in sorted(requested)]
        return {trial.choice: trial for trial in trials if trial is not None}

    def sort(self) -> None:
        """Sort the table, so that the file does not depend on the order in which results arrived."""
        self._stored.sort()


def _compute(piece: Piece) -> Peak:
    objective, choice = piece
    return objective.worst(choice)


def _to_row(key: tuple[str, Choice], peak: Peak) -> list[Any]:
    digest, choice = key
    lists = [" ".join(map(repr, row_values)) for row_values in astuple(choice)]
    return [digest, *lists, repr(choice.mass), *map(repr, astuple(peak))]


def _parse_row(row: list[str]) -> tuple[tuple[str, Choice], Peak]:
    bodies, masses, clearances = (row_values.split() for row_values in row[1:4])
    choice = Choice(tuple(map(int, bodies)), tuple(map(float, masses)), tuple(map(float, clearances)))
    compliance, frequency, level, body, acceleration, irregular_share = row[5:]
    peak = Peak(
        float(compliance), float(frequency), float(level), int(body), float(acceleration), float(irregular_share)
    )
    return (row[0], choice), peak


STUDY: Study[Piece, Peak] = Study(
    "designs",
    # Digest of the objective, choice, total mass, and the `Peak` (size: compliance; simulated: irregular share).
    (
        "question", "bodies", "masses_kg", "clearances_m", "mass_kg",
        "size", "frequency", "level", "body", "acceleration", "simulated",
    ),
    _compute,
    lambda piece: (piece[0].digest, piece[1]),
    _to_row,
    _parse_row,
)  # fmt: skip
