"""Evaluation of candidate designs: workers compute the worst peaks, and a table stores the peaks for later searches.

A *choice* is a candidate design: bodies, masses and clearances of the dampers. A *trial* is a choice and its computed
worst peaks. A *job* is the computation of one worst peak: of one choice, for one structure at one level.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple
from functools import partial
from pathlib import Path
from typing import Any

from rig.core.base.errors import RunError
from rig.core.base.output_files import prepare_outputs
from rig.core.base.progress import CountProgress
from rig.core.base.study import StoredValues, Study, unfinished_file
from rig.core.base.workers import Workers
from rig.studies.design.choice import Choice, Objective, Trial
from rig.studies.design.worst_peak import Peak

#: Function that returns the trial of a choice, or None if the trial is not complete.
KnownTrials = Callable[[Choice], Trial | None]
#: A search: a function that returns the choices that the search needs. A search first uses the known trials.
Search = Callable[[KnownTrials], Iterable[Choice]]
#: An objective for one structure at one level (`Objective.subproblems`), and a choice.
Job = tuple[Objective, Choice]


class Evaluator:
    """Computes trials, or reads them from a table.

    `table`: CSV file with a row for each job. Workers compute the jobs that are missing in the table. Each result is
    added to the table immediately. `total`: approximate number of jobs, for `progress`. Raises `RunError` if the table
    cannot be written, or if the path is a file of other content that may not be replaced.
    """

    def __init__(self, workers: Workers, table: Path | None, progress: CountProgress | None, total: int) -> None:
        self._workers, self._progress = workers, progress
        self._finished, self._total = 0, total
        self._table = self._unfinished = table
        if table is not None and not STUDY.is_table(table):
            # An existing file that may be replaced is kept until the new table is complete.
            prepare_outputs(table, error_type=RunError)
            self._unfinished = unfinished_file(table)
        self._stored = StoredValues(STUDY, self._unfinished)

    def trial(self, objective: Objective, choice: Choice) -> Trial | None:
        """Return the trial of a choice, or None if one of its peaks is not computed yet."""
        peaks = [self._stored.values.get((subproblem.digest, choice)) for subproblem in objective.subproblems]
        known, levels = [peak for peak in peaks if peak is not None], len(objective.levels)
        if len(known) < len(peaks):
            return None
        # The subproblems are in the order of structures, then levels.
        return Trial(choice, tuple(max(known[level::levels]) for level in range(levels)))

    def compute(self, objective: Objective, choices: Sequence[Choice]) -> list[Trial]:
        """Compute the trial of each choice."""
        trials = self.run_searches(objective, [lambda _: choices])
        return [trials[choice] for choice in choices]

    def run_searches(self, objective: Objective, searches: Sequence[Search]) -> dict[Choice, Trial]:
        """Compute the trials that several searches need, until all searches are finished.

        A search is called with a function that returns the trials computed so far. It returns the choices that it used,
        and the choices whose trials it still needs. When the trial of such a choice is complete, the search is called
        again. Workers therefore compute the next trials of one search while another search waits. Returns the trials,
        sorted by choice.
        """
        requested: set[Choice] = set()
        jobs: list[Job] = []
        # For each search, the choices whose trials are not complete.
        awaited: list[set[Choice]] = [set() for _ in searches]

        def request_choices(numbers: Iterable[int]) -> None:
            for number in numbers:
                choices = list(searches[number](partial(self.trial, objective)))
                awaited[number] = {choice for choice in choices if self.trial(objective, choice) is None}
                for choice in choices:
                    if choice not in requested:
                        requested.add(choice)
                        needed = [(subproblem, choice) for subproblem in objective.subproblems]
                        missing = [job for job in needed if job not in self._stored]
                        self._finished += len(needed) - len(missing)
                        jobs.extend(missing)

        request_choices(range(len(searches)))
        for number, peak in self._workers.compute(_compute, jobs):
            self._stored.add(jobs[number], peak)
            self._finished += 1
            if self._progress is not None:
                self._progress(self._finished, max(self._total, self._finished + 1))
            choice = jobs[number][1]
            if self.trial(objective, choice) is not None:
                request_choices([k for k, choices in enumerate(awaited) if choice in choices])
        trials = [self.trial(objective, choice) for choice in sorted(requested)]
        return {trial.choice: trial for trial in trials if trial is not None}

    def sort(self) -> None:
        """Sort the table so that the file does not depend on the order in which results arrived."""
        self._stored.sort()
        if self._table is not None and self._unfinished is not None:
            self._unfinished.replace(self._table)


def _compute(job: Job) -> Peak:
    objective, choice = job
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


STUDY: Study[Job, Peak] = Study(
    "designs",
    # Digest of the objective, choice, total mass, and fields of `Peak` (size: compliance; simulated: irregular share).
    (
        "question", "bodies", "masses_kg", "clearances_m", "mass_kg",
        "size", "frequency", "level", "body", "acceleration", "simulated",
    ),
    _compute,
    lambda job: (job[0].digest, job[1]),
    _to_row,
    _parse_row,
)  # fmt: skip
