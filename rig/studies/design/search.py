"""Search for the best dampers: a grid over locations, masses and clearances, then local refinement.

The local searches start from the best choices of the grid (`choice` and `trial`: see `rig.studies.design.evaluator`). A
search requests choices. Workers compute the choices concurrently, and the search continues when the trials are
complete.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from rig.studies.design.choice import FINE_DENSITY, Choice, Objective, SearchSpace, Trial, rounded
from rig.studies.design.evaluator import Evaluator, KnownTrials
from rig.studies.design.ranking import EQUAL_RATIO, rank_trials, search_cost
from rig.studies.design.worst_peak import Peak

#: Added masses of the grid, relative to the largest added mass.
GRID_MASS_RATIOS = (1.0, 0.5, 0.25)
#: Number of clearances of the grid, logarithmically spaced; the best clearance is refined afterwards.
GRID_CLEARANCES = 10
#: Share of the grid that is computed at all levels, for the estimate of the progress; a lower bound excludes the other
#: choices.
TYPICAL_COMPLETED_SHARE = 0.4
#: Number of choices of each mass that are computed concurrently; more would be wasted, because the search excludes the
#: remaining choices of a row as soon as a lower bound exceeds the best peak.
LOOKAHEAD = 3
#: Maximum number of trials around the best clearance of a location and mass; the peak is flat there.
MAX_REFINEMENT_TRIALS = 8
#: Number of trials per unknown (mass and clearance of each damper) of the simplex search. A trial takes seconds.
SIMPLEX_TRIALS_PER_UNKNOWN = 25
#: Number of locations that the simplex search refines at the largest mass: the best and its competitor.
MAX_SIMPLEX_LOCATIONS = 2
#: Largest mass ratio of two dampers, so large that a single damper can dominate if that is the optimum.
MAX_MASS_RATIO = 300.0
#: A location is refined if its peak is at most this multiple of the best peak on the grid.
MAX_REFINED_PEAK_RATIO = 1.4
#: A location is refined for a smaller mass, or with several different dampers, if its peak is at most this multiple of
#: the best peak.
MAX_LIGHT_PEAK_RATIO = 1.25
#: Number of locations that are refined for each smaller mass: the best and its competitor.
MAX_REFINED_LOCATIONS = 2
#: Two sums of masses are equal if they differ by less than this fraction, which exceeds rounding errors.
MASS_ROUNDING = 1e-9
#: Initial ratio of the clearances of two dampers in one body: identical dampers would move identically until rounding
#: errors separate them.
CLEARANCE_RATIO = 1.1
# Edges of the initial simplex, in logarithms: 28 % of a clearance, and 35 % of a mass ratio.
_INITIAL_CLEARANCE_STEP = 0.25
_INITIAL_MASS_STEP = 0.3
# Tolerance of the logarithms of clearances and mass ratios that ends a search: 0.2 %.
_LOG_TOLERANCE = 2e-3
#: Number of best trials that the final comparison computes again on the fine grid, which can change their order.
FINAL_DESIGNS = 3


def estimate_job_count(objective: Objective, space: SearchSpace) -> int:
    """Estimate the number of jobs that a search computes."""
    grid_size = len(space.locations) * len(GRID_MASS_RATIOS) * (GRID_CLEARANCES + 1)
    jobs_per_choice = len(objective.subproblems)
    refinements = (len(space.locations) + 2 * len(GRID_MASS_RATIOS)) * MAX_REFINEMENT_TRIALS
    return grid_size + int(TYPICAL_COMPLETED_SHARE * grid_size * jobs_per_choice) + refinements * jobs_per_choice


def search(objective: Objective, space: SearchSpace, evaluator: Evaluator) -> tuple[Trial, list[Trial]]:
    """Search for the smallest worst peak at each mass; return the best trial, on the fine grid, and all trials."""

    def optimize_from(starts: Iterable[Choice], optimize: Callable[..., object]) -> dict[Choice, Trial]:
        return evaluator.run_searches(objective, [partial(_requested_choices, optimize, start) for start in starts])

    grid = [
        [choice for location in space.locations for choice in _grid_row(space, location, share)]
        for share in GRID_MASS_RATIOS
    ]
    trials = _compute_grid(objective, grid, evaluator)
    largest_mass, *smaller_masses = (rank_trials(trials[choice] for choice in row if choice in trials) for row in grid)
    starts = _best_of_locations(largest_mass, MAX_REFINED_PEAK_RATIO)
    for row in smaller_masses:
        starts += _best_of_locations(row, MAX_LIGHT_PEAK_RATIO)[:MAX_REFINED_LOCATIONS]
    step = float(np.log(space.clearance[1] / space.clearance[0])) / (GRID_CLEARANCES - 1)  # of the grid, logarithmic
    optimize_common_factor = partial(_optimize_common_factor, step=step, bounds=space.clearance)
    trials |= optimize_from(starts, optimize_common_factor)
    if space.max_dampers > 1:
        masses = [row[0].choice.mass for row in (largest_mass, *smaller_masses)]
        starts = []
        for mass, max_locations in zip(masses, (MAX_SIMPLEX_LOCATIONS, *[1] * len(smaller_masses)), strict=True):
            locations = _best_of_locations(_ranked_at_mass(trials, mass), MAX_LIGHT_PEAK_RATIO)
            starts += _with_several_dampers(locations)[:max_locations]
        trials |= optimize_from(starts, partial(_optimize_each_damper, bounds=space.clearance))
        finalists = [_ranked_at_mass(trials, mass)[0].choice for mass in masses]
        starts = [choice.without_lightest() for choice in _with_several_dampers(finalists) if choice.has_ceiling]
        trials |= optimize_from(starts, optimize_common_factor)
    # A coarse frequency grid may miss a peak, so the finalists are compared on a fine grid.
    fine_objective, compared = replace(objective, density=FINE_DENSITY), set[Choice]()
    while finalists := [choice for choice in _finalists(trials.values(), space) if choice not in compared]:
        trials |= {trial.choice: trial for trial in evaluator.compute(fine_objective, finalists)}
        compared |= set(finalists)
    return rank_trials(trials.values())[0], list(trials.values())


def _finalists(trials: Iterable[Trial], space: SearchSpace) -> list[Choice]:
    """Return the best choices, the best choice without its lightest damper, and the best up to each smaller mass."""
    trials = list(trials)
    finalists = [trial.choice for trial in rank_trials(trials)[:FINAL_DESIGNS]]
    if len(finalists[0].bodies) > 1:
        finalists.append(finalists[0].without_lightest())
    for share in GRID_MASS_RATIOS[1:]:
        light = [trial for trial in trials if trial.choice.mass <= (1.0 + MASS_ROUNDING) * share * space.max_mass]
        finalists += [trial.choice for trial in rank_trials(light)[:1]]
    return list(dict.fromkeys(finalists))


def _ranked_at_mass(trials: Mapping[Choice, Trial], mass: float) -> list[Trial]:
    """Return the trials with a total mass [kg], best first."""
    return rank_trials(trial for choice, trial in trials.items() if abs(choice.mass - mass) <= MASS_ROUNDING * mass)


def _with_several_dampers(choices: Iterable[Choice]) -> list[Choice]:
    """Select the choices with more than one damper."""
    return [choice for choice in choices if len(choice.bodies) > 1]


def _grid_row(space: SearchSpace, location: tuple[int, ...], share: float) -> list[Choice]:
    """Return the choices of a location with all clearances of the grid, and the choice without ceilings."""
    count, (low, high) = len(location), space.clearance
    ratios = [CLEARANCE_RATIO ** location[:k].count(body) for k, body in enumerate(location)]
    unit_clearances = Choice(location, (share * space.max_mass / count,) * count, tuple(ratios))
    row = [
        unit_clearances.scale_clearances(clearance)
        for clearance in np.geomspace(low, high / max(ratios), GRID_CLEARANCES).tolist()
    ]
    # Two dampers without ceilings in one body move as one damper of their total mass.
    return (
        row if len(set(location)) < count or not space.allows_no_ceiling else [*row, unit_clearances.without_ceiling()]
    )


def _best_of_locations(row: Sequence[Trial], max_ratio: float) -> list[Choice]:
    """Return for each location its best choice with ceilings, if its peak is at most `max_ratio` times the best."""
    best: dict[tuple[int, ...], Choice] = {}
    for trial in row:
        if trial.choice.has_ceiling and trial.peak.magnitude <= max_ratio * row[0].peak.magnitude:
            best.setdefault(trial.choice.bodies, trial.choice)
    return list(best.values())


def _compute_grid(objective: Objective, grid: Sequence[list[Choice]], evaluator: Evaluator) -> dict[Choice, Trial]:
    """Compute the choices that may be the best of their row; the peak at the middle level is a lower bound."""
    at_middle_level = objective.subproblems[len(objective.levels) // 2]
    choices = [choice for row in grid for choice in row]
    lower_bounds = {trial.choice: trial.peak for trial in evaluator.compute(at_middle_level, choices)}
    rows = [sorted(row, key=lower_bounds.__getitem__) for row in grid]
    return evaluator.run_searches(objective, [partial(_branch_and_bound, row, lower_bounds) for row in rows])


def _branch_and_bound(
    row: Sequence[Choice], lower_bounds: Mapping[Choice, Peak], known_trials: KnownTrials
) -> Iterator[Choice]:
    """Yield the choices of a row, sorted by lower bound, until no later choice can be the best (branch and bound)."""
    # A trial is used `LOOKAHEAD` choices later, so the set of computed choices does not depend on worker speed.
    smallest_peak = np.inf
    for number, choice in enumerate(row):
        if number >= LOOKAHEAD:
            trial = known_trials(row[number - LOOKAHEAD])
            if trial is None:
                return
            smallest_peak = min(smallest_peak, trial.peak.magnitude)
        if lower_bounds[choice].magnitude >= EQUAL_RATIO * smallest_peak:
            return
        yield choice


class _NotComputed(Exception):
    """A search needs a trial that is not complete."""


def _requested_choices(search: Callable[..., object], start: Choice, known_trials: KnownTrials) -> list[Choice]:
    """Return the choices that a search requests, up to the first choice without a trial."""
    # The search restarts each time, and uses the known trials up to the first missing trial.
    requested = []

    def cost(choice: Choice) -> float:
        requested.append(choice)
        trial = known_trials(choice)
        if trial is None:
            raise _NotComputed
        return search_cost(trial)

    with suppress(_NotComputed):
        search(start, cost)
    return requested


def _optimize_common_factor(
    start: Choice, cost: Callable[[Choice], float], step: float, bounds: tuple[float, float]
) -> None:
    """Optimize a common factor of all clearances in `bounds` [m] within one step of the grid, by Brent's method."""
    middle = np.log(start.clearances[0])

    def cost_at(log_clearance: float) -> float:
        return cost(start.scale_clearances(float(np.exp(log_clearance - middle))))

    limits = np.log([bounds[0], bounds[1] * start.clearances[0] / max(start.clearances)])
    interval = np.clip([middle - step, middle + step], *limits)
    minimize_scalar(
        cost_at, bounds=interval, method="bounded", options={"maxiter": MAX_REFINEMENT_TRIALS, "xatol": _LOG_TOLERANCE}
    )


def _optimize_each_damper(start: Choice, cost: Callable[[Choice], float], bounds: tuple[float, float]) -> None:
    """Optimize clearance and mass share of every damper by the Nelder-Mead simplex method; `bounds`: m."""
    count = len(start.bodies)

    def cost_at(unknowns: np.ndarray) -> float:
        clearances, shares = np.exp(unknowns[:count]), np.exp(np.append(unknowns[count:], 0.0))
        masses = start.mass * shares / shares.sum()
        return cost(Choice(start.bodies, tuple(masses.tolist()), tuple(map(rounded, clearances.tolist()))))

    log_mass_ratios = np.log(np.array(start.masses[:-1]) / start.masses[-1])
    initial = np.concatenate([np.log(start.clearances), log_mass_ratios])
    edges = [_INITIAL_CLEARANCE_STEP] * count + [_INITIAL_MASS_STEP] * (count - 1)
    simplex = np.vstack([initial, initial + np.diag(edges)])
    limits = [tuple(np.log(bounds))] * count + [(-np.log(MAX_MASS_RATIO), np.log(MAX_MASS_RATIO))] * (count - 1)
    max_trials = SIMPLEX_TRIALS_PER_UNKNOWN * initial.size
    # Only the tolerance of the unknowns ends the search: `fatol` is infinite.
    minimize(
        cost_at, initial, method="Nelder-Mead", bounds=limits,
        options={"initial_simplex": simplex, "maxfev": max_trials, "xatol": _LOG_TOLERANCE, "fatol": np.inf},
    )  # fmt: skip
