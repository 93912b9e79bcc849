"""Search for the best dampers: a grid over locations, masses and clearances, then local refinement."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from rig.damper_design.answers import Answers, Computed
from rig.damper_design.choice import FINE_DENSITY, Choice, Question, Space, Trial
from rig.damper_design.ranking import EQUAL_RATIO, objective, rank_trials
from rig.damper_design.worst_peak import Peak

#: Added masses of the grid, relative to the largest added mass.
GRID_MASS_RATIOS = (1.0, 0.5, 0.25)
#: Number of clearances of the grid, from the smallest to the largest.
GRID_CLEARANCES = 10
#: Designs of each mass that are computed concurrently.
LOOKAHEAD = 3
#: Trials around the best clearance of a location and mass.
MAX_REFINEMENT_TRIALS = 8
#: Trials per unknown when all dampers differ.
POLISH_TRIALS_PER_UNKNOWN = 25
#: Locations whose best design is refined with all dampers different.
MAX_POLISHED_LOCATIONS = 2
#: Largest ratio of two dampers' masses. Large, so that a single damper can dominate if that is the optimum.
MAX_MASS_RATIO = 300.0
#: Largest ratio of the peak at a location to the best peak on the grid for which the location is refined.
MAX_REFINED_PEAK_RATIO = 1.4
#: The same ratio for the smaller masses, and for locations with several different dampers.
MAX_LIGHT_PEAK_RATIO = 1.25
#: Largest number of locations refined for each smaller mass.
MAX_REFINED_LOCATIONS = 2
#: Relative rounding difference of two sums of the same masses.
MASS_ROUNDING = 1e-9
#: Initial ratio of the clearances of two dampers in one body.
CLEARANCE_RATIO = 1.1
#: Number of best designs in the final comparison.
FINAL_DESIGNS = 3


def estimate_piece_count(question: Question, space: Space) -> int:
    """Estimate the number of pieces (a design at one level, for one structure) that a search computes."""
    grid, n_parts = len(space.locations) * len(GRID_MASS_RATIOS) * (GRID_CLEARANCES + 1), len(question.parts)
    return (
        grid
        + int(0.4 * grid * n_parts)
        + (len(space.locations) + 2 * len(GRID_MASS_RATIOS)) * MAX_REFINEMENT_TRIALS * n_parts
    )


def search(question: Question, space: Space, answers: Answers) -> tuple[Trial, list[Trial]]:
    """Search for the dampers with the smallest worst peak at each mass; ties are resolved as in `rank_trials`.

    Returns `best`, best design, with its peaks on a finer grid of frequencies; `trials`, all designs computed,
    including the best.
    """
    grid = [
        [c for location in space.locations for c in _grid_row(space, location, share)] for share in GRID_MASS_RATIOS
    ]
    trials = _compute_grid(question, grid, answers)
    rows = [rank_trials(trials[c] for c in row if c in trials) for row in grid]
    starts = [
        start
        for number, row in enumerate(rows)
        for start in _best_of_locations(row, MAX_LIGHT_PEAK_RATIO if number else MAX_REFINED_PEAK_RATIO)[
            : MAX_REFINED_LOCATIONS if number else None
        ]
    ]
    refine = partial(_refine, step=_clearance_step(space), bounds=space.clearance)
    trials |= answers.run_searches(question, [partial(_requested_designs, refine, start) for start in starts])
    if space.dampers > 1:
        rows = [rank_trials(trials[c] for c in trials if _same_mass(c, row[0].choice)) for row in rows]
        starts = [
            start
            for number, row in enumerate(rows)
            for start in _with_several_dampers(_best_of_locations(row, MAX_LIGHT_PEAK_RATIO))[
                : 1 if number else MAX_POLISHED_LOCATIONS
            ]
        ]
        polish = partial(_polish, bounds=space.clearance)
        trials |= answers.run_searches(question, [partial(_requested_designs, polish, start) for start in starts])
        finalists = [rank_trials(trials[c] for c in trials if _same_mass(c, row[0].choice))[0].choice for row in rows]
        fewer = [choice.without_lightest() for choice in _with_several_dampers(finalists) if choice.has_ceiling]
        trials |= answers.run_searches(question, [partial(_requested_designs, refine, choice) for choice in fewer])
    # A coarse frequency grid may miss a peak, so the first three designs are compared on a fine grid. The first
    # design without its lightest damper, whose mass may be negligible, and the best of each smaller mass are
    # compared too.
    fine_question, compared = replace(question, density=FINE_DENSITY), set[Choice]()
    while finalists := [choice for choice in _finalists(trials.values(), space) if choice not in compared]:
        trials |= {trial.choice: trial for trial in answers.compute(fine_question, finalists)}
        compared |= set(finalists)
    return rank_trials(trials.values())[0], list(trials.values())


def _finalists(trials: Iterable[Trial], space: Space) -> list[Choice]:
    """Return the best designs, the first of them without its lightest damper, and the best of each smaller mass."""
    trials = list(trials)
    finalists = [trial.choice for trial in rank_trials(trials)[:FINAL_DESIGNS]]
    if len(finalists[0].bodies) > 1:
        finalists.append(finalists[0].without_lightest())
    for share in GRID_MASS_RATIOS[1:]:
        light = [trial for trial in trials if trial.choice.mass <= (1.0 + MASS_ROUNDING) * share * space.mass]
        finalists += [trial.choice for trial in rank_trials(light)[:1]]
    return list(dict.fromkeys(finalists))


def _same_mass(choice: Choice, other: Choice) -> bool:
    return abs(choice.mass - other.mass) <= MASS_ROUNDING * other.mass


def _with_several_dampers(choices: Iterable[Choice]) -> list[Choice]:
    """Select designs with more than one damper."""
    return [choice for choice in choices if len(choice.bodies) > 1]


def _clearance_step(space: Space) -> float:
    """Return the logarithmic spacing of the clearances of the grid."""
    return float(np.log(space.clearance[1] / space.clearance[0])) / (GRID_CLEARANCES - 1)


def _grid_row(space: Space, location: tuple[int, ...], share: float) -> list[Choice]:
    """Return the designs with all clearances of the grid, equal in each body, and the design without ceilings."""
    count, (low, high) = len(location), space.clearance
    # Identical dampers in one body would move identically until rounding errors separate them.
    ratios = [CLEARANCE_RATIO ** location[:k].count(body) for k, body in enumerate(location)]
    first = Choice(location, (share * space.mass / count,) * count, tuple(ratios))
    row = [first.scale_clearances(c) for c in np.geomspace(low, high / max(ratios), GRID_CLEARANCES).tolist()]
    # Two dampers without ceilings in one body move as one damper of their total mass.
    return row if len(set(location)) < count or not space.without_ceiling else [*row, first.without_ceiling()]


def _best_of_locations(row: Sequence[Trial], within: float) -> list[Choice]:
    """Return the best design with ceilings of each location; peaks are at most `within` times the best peak."""
    best: dict[tuple[int, ...], Choice] = {}
    for trial in row:
        if trial.choice.has_ceiling and trial.peak.size <= within * row[0].peak.size:
            best.setdefault(trial.choice.bodies, trial.choice)
    return list(best.values())


def _compute_grid(question: Question, grid: Sequence[list[Choice]], answers: Answers) -> dict[Choice, Trial]:
    """Compute designs that may be the best of their row; the peak at one level is a lower bound of the worst peak."""
    middle_level = question.parts[len(question.levels) // 2]
    choices = [choice for row in grid for choice in row]
    lower_bounds = {trial.choice: trial.peak for trial in answers.compute(middle_level, choices)}
    rows = [sorted(row, key=lower_bounds.__getitem__) for row in grid]
    return answers.run_searches(question, [partial(_branch_and_bound, row, lower_bounds) for row in rows])


def _branch_and_bound(
    row: Sequence[Choice], lower_bounds: Mapping[Choice, Peak], computed: Computed
) -> Iterator[Choice]:
    """Yield designs that may be the best of a row sorted by lower bound (branch and bound)."""
    # Results are used `LOOKAHEAD` designs later, so that the set of computed designs does not depend on worker speed.
    best = np.inf
    for number, choice in enumerate(row):
        if number >= LOOKAHEAD:
            trial = computed(row[number - LOOKAHEAD])
            if trial is None:
                return
            best = min(best, trial.peak.size)
        if lower_bounds[choice].size >= EQUAL_RATIO * best:
            return
        yield choice


class _NotComputed(Exception):
    """A search needs a design that has not been computed yet."""


def _requested_designs(search: Callable[..., object], start: Choice, computed: Computed) -> list[Choice]:
    """Return the designs that a search requests, up to the first whose result is unknown."""
    # The search restarts each time and uses the stored results up to the first unknown design.
    requested = []

    def cost(choice: Choice) -> float:
        requested.append(choice)
        trial = computed(choice)
        if trial is None:
            raise _NotComputed
        return objective(trial)

    with suppress(_NotComputed):
        search(start, cost)
    return requested


def _refine(start: Choice, cost: Callable[[Choice], float], step: float, bounds: tuple[float, float]) -> None:
    """Optimize a common factor of all clearances within one step, by golden sections and parabolas."""
    middle = np.log(start.clearances[0])

    def cost_at(log_clearance: float) -> float:
        return cost(start.scale_clearances(float(np.exp(log_clearance - middle))))

    limits = np.log([bounds[0], bounds[1] * start.clearances[0] / max(start.clearances)])
    ends = np.clip([middle - step, middle + step], *limits)
    minimize_scalar(cost_at, bounds=ends, method="bounded", options={"maxiter": MAX_REFINEMENT_TRIALS, "xatol": 2e-3})


def _polish(start: Choice, cost: Callable[[Choice], float], bounds: tuple[float, float]) -> None:
    """Optimize the clearance and mass share of every damper by the Nelder-Mead simplex method."""
    count = len(start.bodies)

    def cost_at(x: np.ndarray) -> float:
        shares = np.exp(np.append(x[count:], 0.0))
        masses = start.mass * shares / shares.sum()
        return cost(Choice(start.bodies, tuple(masses.tolist()), tuple(np.exp(x[:count]).tolist())))

    shares = np.log(np.array(start.masses[:-1]) / start.masses[-1])
    initial = np.concatenate([np.log(start.clearances), shares])
    corners = np.vstack([initial, initial + np.diag([0.25] * count + [0.3] * (count - 1))])
    limits = [tuple(np.log(bounds))] * count + [(-np.log(MAX_MASS_RATIO), np.log(MAX_MASS_RATIO))] * (count - 1)
    max_trials = POLISH_TRIALS_PER_UNKNOWN * initial.size
    minimize(
        cost_at, initial, method="Nelder-Mead", bounds=limits,
        options={"initial_simplex": corners, "maxfev": max_trials, "xatol": 2e-3, "fatol": np.inf},
    )  # fmt: skip
