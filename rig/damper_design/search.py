"""Search for the best dampers: a grid over locations, masses and clearances, then local refinement."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from rig.damper_design.answers import Answers, Computed
from rig.damper_design.choice import FINE, Choice, Question, Space, Trial
from rig.damper_design.ranking import EQUAL_RATIO, merit, rank_trials
from rig.damper_design.worst_peak import Peak

#: The grid: shares of the largest added mass, and number of clearances between smallest and largest.
SHARES = (1.0, 0.5, 0.25)
CLEARANCES = 10
#: Designs of each mass that are computed concurrently.
AHEAD = 3
#: Trials around the best clearance of a location and mass.
REFINEMENTS = 8
#: Trials per unknown when all dampers differ.
POLISHING = 25
#: Locations whose best design is refined with all dampers different.
POLISHED = 2
#: Largest ratio of two dampers' masses. Large, so that a single damper can dominate if that is the optimum.
LARGEST_MASS_RATIO = 300.0
#: Largest ratio of the peak at a location to the best peak on the grid for which the location is refined.
PROMISING = 1.4
#: The same ratio for the smaller masses, and for all locations with several different dampers.
CLOSE = 1.25
#: Largest number of locations refined for each smaller mass.
REFINED_LIGHT = 2
#: Relative rounding difference of two sums of the same masses.
ROUNDING = 1e-9
#: Initial ratio of the clearances of two dampers in one body.
CLEARANCE_RATIO = 1.1
#: Number of best designs in the final comparison.
COMPARED = 3


def pieces(question: Question, space: Space) -> int:
    """Estimate the number of pieces of a search."""
    grid, each = len(space.places) * len(SHARES) * (CLEARANCES + 1), len(question.parts)
    return grid + int(0.4 * grid * each) + (len(space.places) + 2 * len(SHARES)) * REFINEMENTS * each


def search(question: Question, space: Space, answers: Answers) -> tuple[Trial, list[Trial]]:
    """Search for the dampers with the smallest worst peak at each mass; ties are resolved as in `rank_trials`.

    Returns `best`, best design, with its peaks on a finer grid of frequencies; `trials`, all designs computed,
    including the best.
    """
    grid = [[c for place in space.places for c in _row(space, place, share)] for share in SHARES]
    tried = _grid_trials(question, grid, answers)
    rows = [rank_trials(tried[c] for c in row if c in tried) for row in grid]
    starts = [
        start
        for number, row in enumerate(rows)
        for start in _best_of_places(row, CLOSE if number else PROMISING)[: REFINED_LIGHT if number else None]
    ]
    refine = partial(_refine, step=_step(space), bounds=space.clearance)
    tried |= answers.follow(question, [partial(_requests, refine, start) for start in starts])
    if space.dampers > 1:
        rows = [rank_trials(tried[c] for c in tried if _same_mass(c, row[0].choice)) for row in rows]
        starts = [
            start
            for number, row in enumerate(rows)
            for start in _multiple(_best_of_places(row, CLOSE))[: 1 if number else POLISHED]
        ]
        polish = partial(_polish, bounds=space.clearance)
        tried |= answers.follow(question, [partial(_requests, polish, start) for start in starts])
        first = [
            rank_trials(tried[c] for c in tried if _same_mass(c, row[0].choice))[0].choice for row in rows
        ]
        fewer = [choice.without_lightest() for choice in _multiple(first) if choice.has_ceiling]
        tried |= answers.follow(question, [partial(_requests, refine, each) for each in fewer])
    # A coarse frequency grid may miss a peak, so the first three designs are compared on a fine grid. The first
    # design without its lightest damper, whose mass may be negligible, and the best of each smaller mass are
    # compared too.
    fine, closely = replace(question, density=FINE), set[Choice]()
    while first := [choice for choice in _first(tried.values(), space) if choice not in closely]:
        tried |= {trial.choice: trial for trial in answers.of(fine, first)}
        closely |= set(first)
    return rank_trials(tried.values())[0], list(tried.values())


def _first(trials: Iterable[Trial], space: Space) -> list[Choice]:
    """Return the best designs, the first of them without its lightest damper, and the best of each smaller mass."""
    trials = list(trials)
    first = [trial.choice for trial in rank_trials(trials)[:COMPARED]]
    if len(first[0].bodies) > 1:
        first.append(first[0].without_lightest())
    for share in SHARES[1:]:
        light = [trial for trial in trials if trial.choice.mass <= (1.0 + ROUNDING) * share * space.mass]
        first += [trial.choice for trial in rank_trials(light)[:1]]
    return list(dict.fromkeys(first))


def _same_mass(one: Choice, other: Choice) -> bool:
    return abs(one.mass - other.mass) <= ROUNDING * other.mass


def _multiple(choices: Iterable[Choice]) -> list[Choice]:
    """Select designs with more than one damper."""
    return [choice for choice in choices if len(choice.bodies) > 1]


def _step(space: Space) -> float:
    """Logarithmic spacing of the clearances of the grid."""
    return float(np.log(space.clearance[1] / space.clearance[0])) / (CLEARANCES - 1)


def _row(space: Space, place: tuple[int, ...], share: float) -> list[Choice]:
    """Designs with all clearances of the grid, equal in each body, and the design without ceilings."""
    count, (low, high) = len(place), space.clearance
    # Identical dampers in one body would move identically until rounding errors separate them.
    ratios = [CLEARANCE_RATIO ** place[:k].count(body) for k, body in enumerate(place)]
    first = Choice(place, (share * space.mass / count,) * count, tuple(ratios))
    row = [first.wider(c) for c in np.geomspace(low, high / max(ratios), CLEARANCES).tolist()]
    # Two dampers without ceilings in one body move as one damper of their total mass.
    return row if len(set(place)) < count or not space.without_ceiling else [*row, first.without_ceiling()]


def _best_of_places(row: Sequence[Trial], within: float) -> list[Choice]:
    """Return the best design with ceilings of each location; peaks are at most `within` times the best peak."""
    best: dict[tuple[int, ...], Choice] = {}
    for trial in row:
        if trial.choice.has_ceiling and trial.peak.size <= within * row[0].peak.size:
            best.setdefault(trial.choice.bodies, trial.choice)
    return list(best.values())


def _grid_trials(question: Question, grid: Sequence[list[Choice]], answers: Answers) -> dict[Choice, Trial]:
    """Compute designs that may be the best of their row; the peak at one level is a lower bound of the worst peak."""
    middle = question.parts[len(question.levels) // 2]
    every = [choice for row in grid for choice in row]
    least = {trial.choice: trial.peak for trial in answers.of(middle, every)}
    rows = [sorted(row, key=least.__getitem__) for row in grid]
    return answers.follow(question, [partial(_branch_and_bound, row, least) for row in rows])


def _branch_and_bound(
    row: Sequence[Choice], least: Mapping[Choice, Peak], computed: Computed
) -> Iterator[Choice]:
    """Yield designs that may be the best of a row sorted by lower bound (branch and bound)."""
    # Each result is used `AHEAD` designs later, so that the set of computed designs does not depend on worker speed.
    best = np.inf
    for number, choice in enumerate(row):
        if number >= AHEAD:
            trial = computed(row[number - AHEAD])
            if trial is None:
                return
            best = min(best, trial.peak.size)
        if least[choice].size >= EQUAL_RATIO * best:
            return
        yield choice


class _Unknown(Exception):
    """A search needs a design that has not been computed yet."""


def _requests(search: Callable[..., object], start: Choice, computed: Computed) -> list[Choice]:
    """Return the designs that a search requests, up to the first whose result is unknown."""
    # The search restarts each time and uses the stored results up to the first unknown design.
    requested = []

    def cost(choice: Choice) -> float:
        requested.append(choice)
        trial = computed(choice)
        if trial is None:
            raise _Unknown
        return merit(trial)

    with suppress(_Unknown):
        search(start, cost)
    return requested


def _refine(start: Choice, cost: Callable[[Choice], float], step: float, bounds: tuple[float, float]) -> None:
    """Optimize a common factor of all clearances within one step, by golden sections and parabolas."""
    middle = np.log(start.clearances[0])

    def at(x: float) -> float:
        return cost(start.wider(float(np.exp(x - middle))))

    limits = np.log([bounds[0], bounds[1] * start.clearances[0] / max(start.clearances)])
    ends = np.clip([middle - step, middle + step], *limits)
    minimize_scalar(at, bounds=ends, method="bounded", options={"maxiter": REFINEMENTS, "xatol": 2e-3})


def _polish(start: Choice, cost: Callable[[Choice], float], bounds: tuple[float, float]) -> None:
    """Optimize the clearance and mass share of every damper by the Nelder-Mead simplex method."""
    count = len(start.bodies)

    def at(x: np.ndarray) -> float:
        shares = np.exp(np.append(x[count:], 0.0))
        masses = start.mass * shares / shares.sum()
        return cost(Choice(start.bodies, tuple(masses.tolist()), tuple(np.exp(x[:count]).tolist())))

    shares = np.log(np.array(start.masses[:-1]) / start.masses[-1])
    first = np.concatenate([np.log(start.clearances), shares])
    corners = np.vstack([first, first + np.diag([0.25] * count + [0.3] * (count - 1))])
    limits = [tuple(np.log(bounds))] * count + [(-np.log(LARGEST_MASS_RATIO), np.log(LARGEST_MASS_RATIO))] * (
        count - 1
    )
    minimize(
        at, first, method="Nelder-Mead", bounds=limits,
        options={"initial_simplex": corners, "maxfev": POLISHING * first.size, "xatol": 2e-3, "fatol": np.inf},
    )  # fmt: skip
