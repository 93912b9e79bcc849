"""Estimates of the unknowns, and their covariance."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy

from analysis.fitting.problem import Group, Problem
from analysis.fitting.start import initial_unknowns
from rig.arrays import Array, ComplexArray

Report = Callable[[str], None]

# Coverage factor of 95 % intervals.
COVERAGE_FACTOR = 1.96
# Model errors, relative to the local peak, that successive fits assume: without them, the fit of a narrow resonance
# far from the solution has no gradient toward the resonance that was measured.
_MODEL_ERRORS = (0.1, 0.01, 0.0)
# The same from random initial values, which are used if modes were not identified or led to no solution.
_MODEL_ERRORS_RANDOM = (0.3, 0.1, 0.01, 0.0)
# Standard deviation of the logarithms of random initial values from the guess.
_RANDOM_SD = 0.15
# Number of random initial values.
_RANDOM_STARTS = 8
# Mean square of the residuals above which the structure is searched from random initial values.
_MAX_STRUCTURE_VARIANCE = 4.0
# Mean square of the residuals above which the stated errors do not explain them.
_MAX_NOISE_VARIANCE = 1.3
# Model errors of the first fits of the dampers.
_MODEL_ERRORS_DAMPERS = (0.2, 0.05)
# The smallest model error: large residuals have little weight, so that a point in another motion has little effect.
_ROBUST_MODEL_ERROR = 1e-6
# Factors of the initial masses and clearances of all dampers, tried if the values of the scene lead to no solution.
_MASS_FACTORS = (1.0, 0.7, 0.4, 1.5)
_CLEARANCE_FACTORS = (0.6, 1.7, 0.3)
# Factor of the clearances with which no damper reaches its ceiling.
_UNREACHED_CLEARANCE_FACTOR = 30.0
# Mean square of the residuals up to which the orbits explain the curves; noise alone leaves slightly below 1.
_MAX_EXPLAINED_SQUARE = 1.5
# Upper limit of each squared residual in the robust cost.
_MAX_SQUARE = 9.0
# Squared residual of a point without a motion.
_FAILED_SQUARE = 1e6
# Robust cost of initial values that fail at about half of the points.
_HALF_FAILED_COST = 4.5
# Rounds of fitting all unknowns, each after a search for other motions at outliers.
_ROUNDS = 4
# Number of clusters of neighboring frequencies in a group whose residuals may have a common cause.
_CLUSTERS = 40


@dataclass(frozen=True)
class Estimate:
    """A solution.

    `factor`: F of the covariance ``F F^T``, priors included, from the stated errors or from the residuals, whichever
    is larger; shape (unknowns, columns).
    """

    x: Array  # shape (unknowns,)
    factor: Array
    # mean square of the residuals in standard deviations; 1 if the stated errors explain them
    variance: float

    @property
    def deviation(self) -> Array:
        """Standard deviations, shape (unknowns,)."""
        return np.asarray(np.linalg.norm(self.factor, axis=1))

    @property
    def correlation(self) -> Array:
        """Correlation coefficients, shape (unknowns, unknowns)."""
        unit = self.factor / self.deviation[:, None]
        return np.asarray(unit @ unit.T)


def estimate(problem: Problem, report: Report) -> Estimate:
    """Estimate the unknowns: first of the structure from linear recordings, then of the dampers, then all together."""
    linear_groups = [group for group in problem.groups if group.tones is None]
    report("structure")
    x = _estimate_structure(problem, linear_groups) if linear_groups else problem.start.copy()
    damper_groups = [group for group in problem.groups if group.tones is not None]
    if damper_groups:
        report("dampers")
        x = _estimate_dampers(problem, x, damper_groups, bool(linear_groups), report)
    return Estimate(x, *_covariance(problem, x))


def _estimate_dampers(
    problem: Problem, structure: Array, damper_groups: Sequence[Group], structure_known: bool, report: Report
) -> Array:
    """Estimate all unknowns with the dampers from several starts, the scene's values first; the best result is kept.

    A ceiling with impacts and a ceiling out of reach are different optima, so that both are tried.
    """
    best, lowest_cost, motions = structure, np.inf, [group.motions() for group in damper_groups]
    begin = structure
    # Quantity of each unknown of a damper; "" for all others.
    names = ["" if parameter.damper is None else parameter.quantity for parameter in problem.parameters]
    names += [""] * (problem.size - len(names))
    bounded = "clearance" in names
    starts = [(1.0, 1.0), *product(_MASS_FACTORS, _CLEARANCE_FACTORS if bounded else (1.0,))]
    for mass, clearance in [*starts, (1.0, _UNREACHED_CLEARANCE_FACTOR)] if bounded else starts:
        if lowest_cost < _MAX_EXPLAINED_SQUARE and clearance < _UNREACHED_CLEARANCE_FACTOR:
            continue
        is_unreached = clearance == _UNREACHED_CLEARANCE_FACTOR
        if is_unreached:
            begin = best
        report("all")
        for group, state in zip(damper_groups, motions, strict=True):
            group.restore(state)
        factors = {"mass": mass, "mass_ratio": mass, "clearance": clearance}
        x = begin + np.log([factors.get(name, 1.0) for name in names])
        # The prior would pull an unreached ceiling back.
        active = [k for k, name in enumerate(names) if not is_unreached or name != "clearance"]
        # First roughly, with the structure fixed if linear recordings determine it.
        rough = [k for k in active if names[k] or not structure_known]
        for model_error in _MODEL_ERRORS_DAMPERS if rough else ():
            x = solve(problem, x, damper_groups, model_error, rough, 6)
        if rough:
            problem.residual(x, damper_groups)
        # If a ceiling explains the curves, an unreached ceiling that fails at half of the points is not refined.
        refuted = lowest_cost < _MAX_EXPLAINED_SQUARE and _robust_cost(problem, x, damper_groups) > _HALF_FAILED_COST
        for round_number in range(0 if refuted else _ROUNDS):
            scene = problem.scene(x)
            changed = [group.choose_motions(problem, x, scene) for group in damper_groups]
            if not any(changed) and round_number > 0:
                break
            model_error = _MODEL_ERRORS[-2] if round_number == 0 else _ROBUST_MODEL_ERROR
            x = solve(problem, x, problem.groups, model_error, active, 8)
            x = solve(problem, x, problem.groups, 0.0, active, 12)
        cost = _robust_cost(problem, x, damper_groups)
        # A single point does not prove ceiling impacts, because its motion may be of another type.
        if cost < lowest_cost + _MAX_SQUARE * is_unreached / min(group.used.size for group in damper_groups):
            best, lowest_cost, motions = x, cost, [group.motions() for group in damper_groups]
    for group, state in zip(damper_groups, motions, strict=True):
        group.restore(state)
    problem.residual(best, problem.groups)
    return best


def _robust_cost(problem: Problem, x: Array, damper_groups: Sequence[Group]) -> float:
    """Compute the mean square of the residuals of all points, each limited by the Geman-McClure function.

    S. Geman, D. McClure, Bulletin of the International Statistical Institute 52 (1987) 5-21.
    """
    scene, costs = problem.scene(x), []
    for group in damper_groups:
        residual = problem.predicted(x, group, scene) - group.curves.value
        white = np.einsum("nij,jn->ni", group.curves.whiten, residual)
        square = np.nan_to_num(abs(white) ** 2 / 2.0, nan=_FAILED_SQUARE)
        costs.append((square / (1.0 + square / _MAX_SQUARE)).ravel())
    return float(np.mean(np.concatenate(costs)))


def _estimate_structure(problem: Problem, linear_groups: Sequence[Group]) -> Array:
    """Estimate the structure from linear recordings: from their modes, else from random starts around the guess."""
    best = initial_unknowns(problem, linear_groups)
    for model_error in _MODEL_ERRORS:
        best = solve(problem, best, linear_groups, model_error)
    lowest_square = mean_square(problem, best, linear_groups)
    active = [k for k, parameter in enumerate(problem.parameters) if parameter.place[0] == "structure"]
    generator = np.random.default_rng(0)
    for number in range(_RANDOM_STARTS):
        if lowest_square < _MAX_STRUCTURE_VARIANCE:
            break
        x = problem.start.copy()
        x[active] += generator.normal(0.0, _RANDOM_SD * min(number, 1), len(active))
        for model_error in _MODEL_ERRORS_RANDOM:
            x = solve(problem, x, linear_groups, model_error, max_evaluations=15)
        if (square := mean_square(problem, x, linear_groups)) < lowest_square:
            best, lowest_square = x, square
    return best


def solve(
    problem: Problem,
    x: Array,
    groups: Sequence[Group],
    model_error: float,
    active: Sequence[int] | None = None,
    max_evaluations: int = 30,
) -> Array:
    """Minimize the squared residuals over active unknowns, from x."""
    free_indices = list(range(problem.size) if active is None else active)

    def all_unknowns(values: Array) -> Array:
        out = x.copy()
        out[free_indices] = values
        return out

    solution = scipy.optimize.least_squares(
        lambda values: problem.residual(all_unknowns(values), groups, model_error),
        x[free_indices],
        jac=lambda values: problem.jacobian(all_unknowns(values), groups, model_error, free_indices),
        x_scale="jac",
        loss={0.0: "linear", _ROBUST_MODEL_ERROR: "cauchy"}.get(model_error, "soft_l1"),
        max_nfev=max_evaluations,
        ftol=1e-8 if model_error == 0.0 else 1e-3,
        xtol=1e-10,
        gtol=1e-10,
    )
    best = all_unknowns(solution.x)
    # The last trial need not be the solution: evaluate it, so that the stored motions are those of the solution.
    problem.residual(best, groups, model_error)
    return best


def mean_square(problem: Problem, x: Array, groups: Sequence[Group], model_error: float = 0.0) -> float:
    """Compute the mean square of the residuals of some groups, in standard deviations."""
    residuals = problem.residual(x, groups, model_error)[: -problem.size]
    return float(np.mean(residuals**2)) if residuals.size else 0.0


def _covariance(problem: Problem, x: Array) -> tuple[Array, float]:
    """Return a factor of the covariance of the unknowns, as in `Estimate`, and the mean square of the residuals.

    Systematic errors shift the unknowns; each shift is added. Residuals larger than the stated errors enlarge the
    covariance by their mean square. Residuals with common causes, between responses and over neighboring
    frequencies, are counted by cluster (K.-Y. Liang, S. L. Zeger, Longitudinal data analysis using generalized
    linear models, Biometrika 73 (1986)); the larger covariance is used.
    """
    shifts: list[Array] = []
    data, scores, square, count = np.zeros((0, problem.size)), [np.diag(1.0 / problem.prior_sd)], 0.0, 0
    score_covariance = np.zeros((problem.size, problem.size))
    for group in problem.groups:
        jacobian = problem.jacobian(x, [group])[: -problem.size]
        residuals = problem.residual(x, [group])[: -problem.size]
        used = int(group.used.sum())
        data = np.asarray(np.linalg.qr(np.concatenate([data, jacobian]), mode="r"))
        score_covariance += _score_covariance(group, jacobian)
        shifts += [jacobian.T @ error for error in _systematic_errors(group)]
        square += float(residuals @ residuals)
        count += residuals.size
        order = np.argsort(group.curves.frequency[group.used], kind="stable")
        rank = np.empty(used, dtype=int)
        rank[order] = np.arange(used)
        width = 1 if group.curves.level is not None else max(1, used // _CLUSTERS)
        cluster = np.tile(np.repeat(rank // width, residuals.size // (2 * used)), 2)
        clusters = range(cluster.max() + 1)
        columns = [jacobian[cluster == number].T @ residuals[cluster == number] for number in clusters]
        scores.append(np.stack(columns, axis=1))
    variance = square / max(count - problem.size, 1)
    # Factor F of the inverse F F^T of the normal matrix with the prior precision.
    bread = np.linalg.inv(np.linalg.qr(np.concatenate([data, np.diag(1.0 / problem.prior_sd)]), mode="r"))
    size, axes = np.linalg.eigh(score_covariance)
    root = axes * np.sqrt(np.maximum(size, 0.0) * max(variance, 1.0))
    stated = bread @ (bread.T @ np.concatenate([root, np.diag(1.0 / problem.prior_sd)], axis=1))
    inflation = np.ones(problem.size)
    if variance > _MAX_NOISE_VARIANCE or all(group.curves.level is not None for group in problem.groups):
        clustered = bread @ (bread.T @ np.concatenate(scores, axis=1))
        inflation = np.maximum(np.linalg.norm(clustered, axis=1) / np.linalg.norm(stated, axis=1), 1.0)
    systematic = bread @ (bread.T @ np.array(shifts).T)
    return np.concatenate([inflation[:, None] * stated, systematic], axis=1), variance


def _systematic_errors(group: Group) -> Iterator[Array]:
    """Yield the whitened residuals of errors that are equal at all lines: gain and phase of each response.

    Each is uniformly distributed within its limit, so that its standard deviation is limit / sqrt(3).
    """
    curves, used = group.curves, group.used

    def whitened(errors: ComplexArray) -> ComplexArray:
        return np.asarray(np.einsum("nij,jn->ni", curves.whiten[used], errors[:, used]).ravel())

    for k in range(len(curves.sensors)):
        errors = np.zeros_like(curves.value)
        size = np.maximum(abs(curves.value[k]), 1e-300)
        errors[k] = curves.smooth[k] / np.sqrt(3.0) * curves.value[k] / size
        white = whitened(errors)
        yield np.concatenate([white.real, white.imag])
        yield np.concatenate([-white.imag, white.real])
    # Noise adds to the power of the reference: all responses are too small, without a phase error.
    white = whitened(curves.common / np.sqrt(3.0) * curves.value)
    yield np.concatenate([white.real, white.imag])


def _score_covariance(group: Group, jacobian: Array) -> Array:
    """Compute the covariance of the scores ``J^T r`` of a group from random errors, including common errors."""
    curves, used = group.curves, group.used
    if curves.errors.reference is None:
        # Whitened errors have unit variance; the uncertainty of the variance itself is in the weights.
        return np.asarray(curves.errors.shared * (jacobian.T @ jacobian))
    slopes = jacobian.reshape(2, int(used.sum()), len(curves.sensors), -1)
    white = slopes[0] + 1j * slopes[1]
    weights = np.einsum("nij,nip->njp", curves.whiten[used].conj(), white)
    deviation = curves.rough[:, used].T[..., None] / np.sqrt(3.0)
    rough = (deviation * weights).reshape(-1, weights.shape[2])
    errors = curves.errors.at(used)
    return errors.of_sums(weights) + max(frf.uncertainty.shared for frf in curves.frfs) * (rough.conj().T @ rough).real
