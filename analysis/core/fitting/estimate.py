"""Estimation of a fit's unknowns by nonlinear least squares, and of their covariance.

The *model error* is an assumed error of the model, relative to the local peak of a curve. The model error is reduced in
steps, because without it the fit of a narrow resonance far from the solution has no gradient toward the measured
resonance.

A *group* contains the curves of one sweep or test. An *orbit* is the periodic motion of moving dampers at one point of
a group (see `problem`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy

from analysis.core.fitting.problem import Group, Problem
from analysis.core.fitting.start import initial_unknowns
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.uncertainty import expand, standard_of_limit

# Function that is called with the name of each stage of a fit.
Report = Callable[[str], None]

# The structure is fitted several times, with these model errors in turn.
_MODEL_ERRORS = (0.1, 0.01, 0.0)
# If the modes lead to no solution, the structure is fitted from random initial values, with these model errors in turn.
_RANDOM_MODEL_ERRORS = (0.3, 0.1, 0.01, 0.0)
# Standard deviation of the random initial values of the unknowns around the parameters of the scene.
_RANDOM_SD = 0.15
# Number of fits from random initial values, which are a safeguard against local minima.
_RANDOM_STARTS = 8
# The structure is fitted from random initial values if the mean square of the residuals exceeds this value.
_MAX_STRUCTURE_VARIANCE = 4.0
# Mean square of the normalized residuals above which the residuals enlarge the intervals.
_MIN_INFLATED_VARIANCE = 1.3
# The first fits of the dampers use these model errors in turn.
_DAMPER_MODEL_ERRORS = (0.2, 0.05)
# Negligible model error that selects the Cauchy loss: points where rig and model have different orbits matter little.
_ROBUST_MODEL_ERROR = 1e-6
# Factors of the initial masses and clearances of all dampers, tried in turn if the scene's lead to no solution.
_MASS_FACTORS = (1.0, 0.7, 0.4, 1.5)
_CLEARANCE_FACTORS = (0.6, 1.7, 0.3)
# With clearances multiplied by this factor, no damper reaches its ceiling.
_UNREACHED_CLEARANCE_FACTOR = 30.0
# Largest mean square of the normalized residuals of a good fit; noise alone gives slightly below 1.
_MAX_EXPLAINED_SQUARE = 1.5
# In the robust cost, each squared residual is limited to this value: 3 standard uncertainties.
_MAX_SQUARE = 9.0
# Squared residual assigned to a point where the model has no orbit.
_FAILED_SQUARE = 1e6
# Robust cost of a model without an orbit at about half of the points.
_HALF_FAILED_COST = 4.5
# Maximum number of fits of all unknowns, each after a search for better orbits at outliers; the limit ends a cycle
# between two orbits.
_MAX_ROUNDS = 4
# Number of clusters of neighboring frequencies in a group, within which residuals may have a common cause.
_CLUSTERS = 40


@dataclass(frozen=True)
class Estimate:
    """Estimated unknowns with their covariance."""

    x: Array  # estimated unknowns of `Problem`, shape (unknowns,)
    # F of the covariance ``F F^T``, (unknowns, columns), from stated uncertainties or larger residuals
    factor: Array
    # mean square of the normalized residuals; 1 if they are consistent with the stated uncertainties
    variance: float
    # number of columns of `factor` for random errors; the other columns belong to errors with limits
    n_random: int

    def expanded(self, derivatives: Array | None = None) -> Array:
        """Return the expanded uncertainties of the unknowns, or of values from their derivatives (values, unknowns)."""
        columns = self.factor if derivatives is None else derivatives @ self.factor
        limits = abs(columns[:, self.n_random :].T) / standard_of_limit(1.0)
        return expand(np.linalg.norm(columns[:, : self.n_random], axis=1), list(limits))

    @property
    def deviation(self) -> Array:
        """Standard uncertainties of the unknowns, shape (unknowns,)."""
        return np.asarray(np.linalg.norm(self.factor, axis=1))

    @property
    def correlation(self) -> Array:
        """Correlation coefficients, shape (unknowns, unknowns)."""
        unit = self.factor / self.deviation[:, None]
        return np.asarray(unit @ unit.T)


def estimate(problem: Problem, report: Report) -> Estimate:
    """Estimate the unknowns: first of the structure from linear recordings, then of the dampers, then all together."""
    linear_groups = [group for group in problem.groups if group.orbits is None]
    report("fitting the structure")
    x = estimate_structure(problem, linear_groups) if linear_groups else problem.start.copy()
    damper_groups = [group for group in problem.groups if group.orbits is not None]
    if damper_groups:
        report("fitting the dampers")
        x = _estimate_dampers(problem, x, damper_groups, bool(linear_groups), report)
    return Estimate(x, *_covariance(problem, x))


def _estimate_dampers(
    problem: Problem, x_structure: Array, damper_groups: Sequence[Group], structure_known: bool, report: Report
) -> Array:
    """Estimate all unknowns from several initial dampers, the scene's first, and `x_structure`; return the best."""
    # The fit has separate optima with and without ceiling impacts, so initial clearances of both kinds are tried.
    best, lowest_cost, orbit_states = x_structure, np.inf, [group.orbit_state() for group in damper_groups]
    # Names of the quantities of dampers; "" for other unknowns.
    quantities = ["" if parameter.damper is None else parameter.quantity for parameter in problem.parameters]
    quantities += [""] * (problem.size - len(quantities))
    has_ceiling = "clearance" in quantities
    trials = [(1.0, 1.0), *product(_MASS_FACTORS, _CLEARANCE_FACTORS if has_ceiling else (1.0,))]
    if has_ceiling:
        trials.append((1.0, _UNREACHED_CLEARANCE_FACTOR))
    for number, (mass_factor, clearance_factor) in enumerate(trials, 1):
        is_unreached = clearance_factor == _UNREACHED_CLEARANCE_FACTOR
        if lowest_cost < _MAX_EXPLAINED_SQUARE and not is_unreached:
            continue
        report(f"fitting all values, start {number} of at most {len(trials)}")
        for group, state in zip(damper_groups, orbit_states, strict=True):
            group.restore(state)
        factors = {"mass": mass_factor, "mass_ratio": mass_factor, "clearance": clearance_factor}
        initial = best if is_unreached else x_structure
        x = initial + np.log([factors.get(quantity, 1.0) for quantity in quantities])
        # A clearance that is not reached is fixed, because the prior would return it to its initial value.
        active = [k for k, quantity in enumerate(quantities) if not is_unreached or quantity != "clearance"]
        # The first fits keep the structure fixed if linear recordings determine it.
        first_active = [k for k in active if quantities[k] or not structure_known]
        if first_active:
            for model_error in _DAMPER_MODEL_ERRORS:
                x = solve(problem, x, damper_groups, model_error, first_active, max_evaluations=6)
            problem.residual(x, damper_groups)
        # If ceiling impacts fit the curves, a trial without them that has no orbit at half of the points is abandoned.
        is_refuted = lowest_cost < _MAX_EXPLAINED_SQUARE and _robust_cost(problem, x, damper_groups) > _HALF_FAILED_COST
        for round_number in range(0 if is_refuted else _MAX_ROUNDS):
            scene = problem.scene(x)
            changed = [group.replace_outlier_orbits(problem, x, scene) for group in damper_groups]
            if not any(changed) and round_number > 0:
                break
            model_error = _MODEL_ERRORS[-2] if round_number == 0 else _ROBUST_MODEL_ERROR
            x = solve(problem, x, problem.groups, model_error, active, max_evaluations=8)
            x = solve(problem, x, problem.groups, 0.0, active, max_evaluations=12)
        cost = _robust_cost(problem, x, damper_groups)
        # A single outlier does not prove ceiling impacts, because its motion may be of a different type.
        cost_of_one_outlier = _MAX_SQUARE / min(group.is_fitted.size for group in damper_groups)
        if cost < lowest_cost + cost_of_one_outlier * is_unreached:
            best, lowest_cost, orbit_states = x, cost, [group.orbit_state() for group in damper_groups]
    for group, state in zip(damper_groups, orbit_states, strict=True):
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
        whitened = np.einsum("nij,jn->ni", group.curves.whitening, residual)
        square = np.nan_to_num(abs(whitened) ** 2 / 2.0, nan=_FAILED_SQUARE)
        costs.append((square / (1.0 + square / _MAX_SQUARE)).ravel())
    return float(np.mean(np.concatenate(costs)))


def estimate_structure(problem: Problem, linear_groups: Sequence[Group]) -> Array:
    """Estimate the unknowns from linear recordings, from their modes first, then from random initial values."""
    best = initial_unknowns(problem, linear_groups)
    for model_error in _MODEL_ERRORS:
        best = solve(problem, best, linear_groups, model_error)
    lowest_square = mean_square(problem, best, linear_groups)
    # Indices of the unknowns that start at random values.
    active = [k for k, parameter in enumerate(problem.parameters) if parameter.key_path[0] == "structure"]
    generator = np.random.default_rng(0)
    for number in range(_RANDOM_STARTS):
        if lowest_square < _MAX_STRUCTURE_VARIANCE:
            break
        x = problem.start.copy()
        # The first of these starts is the scene itself.
        x[active] += generator.normal(0.0, _RANDOM_SD * min(number, 1), len(active))
        for model_error in _RANDOM_MODEL_ERRORS:
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
    """Minimize the squared residuals of groups from the initial unknowns x; return all unknowns, shape (unknowns,).

    `model_error`: relative to the local peak; it also selects the loss function. `active`: indices of the unknowns that
    are fitted, by default all.
    """
    free_indices = list(range(problem.size) if active is None else active)

    def all_unknowns(values: Array) -> Array:
        unknowns = x.copy()
        unknowns[free_indices] = values
        return unknowns

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
    # The solver's last trial need not be the solution. This evaluation stores the orbits of the solution.
    problem.residual(best, groups, model_error)
    return best


def mean_square(problem: Problem, x: Array, groups: Sequence[Group]) -> float:
    """Compute the mean square of the normalized residuals of groups."""
    residuals = problem.residual(x, groups)[: -problem.size]
    return float(np.mean(residuals**2)) if residuals.size else 0.0


def _covariance(problem: Problem, x: Array) -> tuple[Array, float, int]:
    """Return `Estimate.factor`, `variance` (the mean square of the residuals) and `n_random`.

    The covariance is the sum of a random and a systematic part. Residuals larger than the stated uncertainties enlarge
    the random part by their mean square. Residuals with common causes, between responses and over neighboring
    frequencies, are summed by cluster before they are squared (K.-Y. Liang, S. L. Zeger, Longitudinal data analysis
    using generalized linear models, Biometrika 73 (1986)); the larger standard deviation of each unknown is used.
    """
    prior_root = np.diag(1.0 / problem.prior_sd)
    # A score is the product J^T r of Jacobian and residuals or errors; `triangular` is the R factor of the Jacobian.
    triangular, score_covariance = np.zeros((0, problem.size)), np.zeros((problem.size, problem.size))
    cluster_scores: list[Array] = [prior_root]
    systematic_scores: list[Array] = []
    square, count = 0.0, 0
    for group in problem.groups:
        jacobian = problem.jacobian(x, [group])[: -problem.size]
        residuals = problem.residual(x, [group])[: -problem.size]
        n_fitted = int(group.is_fitted.sum())
        triangular = np.asarray(np.linalg.qr(np.concatenate([triangular, jacobian]), mode="r"))
        score_covariance += _score_covariance(group, jacobian)
        systematic_scores += [jacobian.T @ error for error in _systematic_errors(group)]
        square += float(residuals @ residuals)
        count += residuals.size
        order = np.argsort(group.curves.frequency[group.is_fitted], kind="stable")
        rank = np.empty(n_fitted, dtype=int)
        rank[order] = np.arange(n_fitted)
        # Steady tones are separate measurements; the lines of other tests are not.
        cluster_size = 1 if group.curves.level is not None else max(1, n_fitted // _CLUSTERS)
        cluster = np.tile(np.repeat(rank // cluster_size, residuals.size // (2 * n_fitted)), 2)
        clusters = range(cluster.max() + 1)
        columns = [jacobian[cluster == number].T @ residuals[cluster == number] for number in clusters]
        cluster_scores.append(np.stack(columns, axis=1))
    variance = square / max(count - problem.size, 1)
    inverse_root = np.linalg.inv(np.linalg.qr(np.concatenate([triangular, prior_root]), mode="r"))

    def errors_of_unknowns(scores: Array) -> Array:
        # Multiplication by the inverse of the normal matrix, which includes the prior.
        return np.asarray(inverse_root @ (inverse_root.T @ scores))

    eigenvalues, axes = np.linalg.eigh(score_covariance)
    score_root = axes * np.sqrt(np.maximum(eigenvalues, 0.0) * max(variance, 1.0))
    stated = errors_of_unknowns(np.concatenate([score_root, prior_root], axis=1))
    inflation = np.ones(problem.size)
    if variance > _MIN_INFLATED_VARIANCE or all(group.curves.level is not None for group in problem.groups):
        clustered = errors_of_unknowns(np.concatenate(cluster_scores, axis=1))
        inflation = np.maximum(np.linalg.norm(clustered, axis=1) / np.linalg.norm(stated, axis=1), 1.0)
    systematic = errors_of_unknowns(np.array(systematic_scores).T)
    n_random = score_root.shape[1] + len(problem.parameters)
    return np.concatenate([inflation[:, None] * stated, systematic], axis=1), variance, n_random


def _systematic_errors(group: Group) -> Iterator[Array]:
    """Yield the effects on the normalized residuals of errors that are correlated over all lines."""
    curves, is_fitted = group.curves, group.is_fitted

    def whiten(errors: ComplexArray) -> ComplexArray:
        return np.asarray(np.einsum("nij,jn->ni", curves.whitening[is_fitted], errors[:, is_fitted]).ravel())

    for k in range(len(curves.sensors)):
        errors = np.zeros_like(curves.value)
        magnitude = np.maximum(abs(curves.value[k]), 1e-300)
        errors[k] = standard_of_limit(curves.correlated_limit[k]) * curves.value[k] / magnitude
        whitened = whiten(errors)
        yield np.concatenate([whitened.real, whitened.imag])
        yield np.concatenate([-whitened.imag, whitened.real])
    # Noise adds to the power of the reference. All responses are therefore too small, but have no phase error.
    whitened = whiten(standard_of_limit(curves.reference_noise_limit) * curves.value)
    yield np.concatenate([whitened.real, whitened.imag])


def _score_covariance(group: Group, jacobian: Array) -> Array:
    """Compute the covariance of the scores ``J^T r`` of a group from its random errors, shape (unknowns, unknowns)."""
    curves, is_fitted = group.curves, group.is_fitted
    if curves.errors.reference is None:
        # Whitened errors have unit variance.
        return np.asarray(curves.errors.shared * (jacobian.T @ jacobian))
    real, imaginary = jacobian.reshape(2, int(is_fitted.sum()), len(curves.sensors), -1)
    weights = np.einsum("nij,nip->njp", curves.whitening[is_fitted].conj(), real + 1j * imaginary)
    deviation = standard_of_limit(curves.line_limit[:, is_fitted].T[..., None])
    line_errors = (deviation * weights).reshape(-1, weights.shape[2])
    errors = curves.errors.at(is_fitted)
    n_shared = max(frf.uncertainty.shared for frf in curves.frfs)
    return errors.of_sums(weights) + n_shared * (line_errors.conj().T @ line_errors).real
