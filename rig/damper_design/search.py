"""The search for the best dampers: a grid over places, masses and clearances, then the best of it made better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from rig.damper_design.answers import Answers, Known, Task
from rig.damper_design.choice import FINE, Choice, Question, Space, Trial
from rig.damper_design.worst_peak import Peak

#: Shares of the mass that may be added, and clearances between smallest and largest, of the grid.
SHARES = (1.0, 0.5, 0.25)
CLEARANCES = 10
#: Choices of each mass that are tried at once.
BATCH = 4
#: Trials about the best clearance of a place and a mass, and, for each unknown, with all dampers different.
REFINEMENTS, POLISHING = 8, 25
#: Places whose best is made better so.
POLISHED = 2
#: Largest ratio of two dampers' masses: where one does best alone, the others are to be next to nothing.
UNEVEN = 300.0
#: Places whose best on the grid is at most this much worse than the best of all are looked at closely.
PROMISING = 1.4
#: How many of the best are compared in the end.
COMPARED = 3


def pieces(space: Space) -> int:
    """Count the pieces of a search, as far as that can be known."""
    grid = len(space.places) * len(SHARES) * CLEARANCES
    return int(1.4 * grid) + len(space.places) + len(SHARES) + COMPARED


def search(question: Question, space: Space, answers: Answers) -> Trial:
    """Find the dampers with the smallest worst peak.

    Returns
    -------
    Trial
        The best, its peak computed on a finer grid of frequencies.
    """
    grid = {(place, share): _row(space, place, share) for place, share in product(space.places, SHARES)}
    _bounded(question, grid, answers)
    known = answers.known(question)

    def best_of(place: tuple[int, ...], share: float) -> Choice:
        return min((choice for choice in grid[place, share] if choice in known), key=known.__getitem__)

    refine = partial(_refine, step=_step(space), bounds=space.clearance)
    full = [best_of(place, SHARES[0]) for place in space.places if set(grid[place, SHARES[0]]) & set(known)]
    limit = PROMISING * min(known[choice].size for choice in full)
    lighter = [
        [c for (_, s), row in grid.items() if s == share for c in row if c in known] for share in SHARES[1:]
    ]
    starts = [choice for choice in full if known[choice].size <= limit]
    answers.found_by(refine, question, starts + [min(row, key=known.__getitem__) for row in lighter])
    if len(space.places[0]) > 1:
        best: dict[tuple[int, ...], Choice] = {}
        for choice in sorted(known, key=known.__getitem__):
            best.setdefault(choice.bodies, choice)
        answers.found_by(partial(_polish, bounds=space.clearance), question, [*best.values()][:POLISHED])
    # A coarse grid of frequencies may have missed a peak: the first three are compared on a fine one.
    first = sorted(known, key=known.__getitem__)[:COMPARED]
    peaks = answers.of(replace(question, density=FINE), first)
    return min(map(Trial, first, peaks), key=lambda trial: trial.peak)


def front(trials: Sequence[Trial]) -> list[Trial]:
    """Trials that none with as little mass is better than, from light to heavy (Pareto's front)."""
    found: list[Trial] = []
    for trial in sorted(trials, key=lambda trial: (round(trial.choice.mass, 9), trial.peak)):
        if not found or trial.peak.size < found[-1].peak.size:
            found.append(trial)
    return found


def chart(
    question: Question, choice: Choice, factors: Sequence[float], levels: Sequence[float], answers: Answers
) -> list[list[Peak]]:
    """Peaks of a choice with all clearances changed by each factor (rows) at each level (columns)."""
    choices = [replace(choice, clearances=tuple(factor * c for c in choice.clearances)) for factor in factors]
    nominal = replace(question, scenes=question.scenes[:1])
    columns = [answers.of(replace(nominal, levels=(level,)), choices) for level in levels]
    return [list(row) for row in zip(*columns, strict=True)]


def _step(space: Space) -> float:
    """Distance of the grid's clearances in the logarithm."""
    return float(np.log(space.clearance[1] / space.clearance[0])) / (CLEARANCES - 1)


def _row(space: Space, place: tuple[int, ...], share: float) -> list[Choice]:
    """Choices of all clearances, the same for each damper."""
    count = len(place)
    masses = (share * space.mass / count,) * count
    return [Choice(place, masses, (c,) * count) for c in np.geomspace(*space.clearance, CLEARANCES).tolist()]


def _bounded(
    question: Question, grid: dict[tuple[tuple[int, ...], float], list[Choice]], answers: Answers
) -> None:
    """Try all of the grid that may be the best of its mass: the peak at one level is at most the worst of all."""
    middle = replace(
        question, scenes=question.scenes[:1], levels=(question.levels[len(question.levels) // 2],)
    )
    every = [choice for row in grid.values() for choice in row]
    least = {c: peak.size for c, peak in zip(every, answers.of(middle, every), strict=True)}
    waiting = {
        share: sorted((c for (_, s), row in grid.items() if s == share for c in row), key=least.__getitem__)
        for share in SHARES
    }
    best = dict.fromkeys(SHARES, np.inf)
    while any(waiting.values()):
        batch = {share: waiting[share][:BATCH] for share in SHARES}
        peaks = answers.of(question, [choice for choices in batch.values() for choice in choices])
        for share, choices in batch.items():
            best[share] = min([best[share], *(peak.size for peak in peaks[: len(choices)])])
            peaks = peaks[len(choices) :]
            waiting[share] = [c for c in waiting[share][BATCH:] if least[c] < best[share]]


class _Asked:
    """Asks a question, and remembers the answers in the order in which they came."""

    def __init__(self, question: Question, known: Known) -> None:
        self.question, self.known, self.trials = question, dict(known), list[Trial]()

    def __call__(self, choice: Choice) -> float:
        if choice not in self.known:
            self.known[choice] = self.question.worst(choice)
        self.trials.append(Trial(choice, self.known[choice]))
        return self.known[choice].size


def _refine(task: Task, step: float, bounds: tuple[float, float]) -> list[Trial]:
    """Change the clearance, the same for each damper, by golden sections and parabolas, at most a step."""
    question, start, known = task
    asked, middle = _Asked(question, known), np.log(start.clearances[0])

    def at(x: float) -> float:
        return asked(replace(start, clearances=(float(np.exp(x)),) * len(start.bodies)))

    ends = np.clip([middle - step, middle + step], *np.log(bounds))
    minimize_scalar(at, bounds=ends, method="bounded", options={"maxiter": REFINEMENTS, "xatol": 2e-3})
    return asked.trials


def _polish(task: Task, bounds: tuple[float, float]) -> list[Trial]:
    """Let every damper have its own clearance and share of the mass: simplex method of Nelder and Mead."""
    question, start, known = task
    asked, count = _Asked(question, known), len(start.bodies)

    def at(x: np.ndarray) -> float:
        shares = np.exp(np.append(x[count:], 0.0))
        masses = start.mass * shares / shares.sum()
        return asked(Choice(start.bodies, tuple(masses.tolist()), tuple(np.exp(x[:count]).tolist())))

    shares = np.log(np.array(start.masses[:-1]) / start.masses[-1])
    first = np.concatenate([np.log(start.clearances), shares])
    corners = np.vstack([first, first + np.diag([0.25] * count + [0.3] * (count - 1))])
    limits = [tuple(np.log(bounds))] * count + [(-np.log(UNEVEN), np.log(UNEVEN))] * (count - 1)
    minimize(
        at, first, method="Nelder-Mead", bounds=limits,
        options={"initial_simplex": corners, "maxfev": POLISHING * first.size, "xatol": 2e-3, "fatol": np.inf},
    )  # fmt: skip
    return asked.trials
