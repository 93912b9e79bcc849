"""Identifiability of a fit: combinations of values that leave the curves unchanged, and the damping of each sweep."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from analysis.core.fitting.estimate import Estimate, solve
from analysis.core.fitting.problem import Problem
from rig.core.base.arrays import Array
from rig.core.results import format_percent
from rig.core.results.uncertainty import COVERAGE_FACTOR

# A combination of parameters is reported if its relative expanded uncertainty is at least this value.
_MIN_RELATIVE_EXPANDED = 0.02
# Smallest listed component of a combination, relative to the largest; all would make the list unreadable.
_MIN_COMPONENT_RATIO = 0.3
# A sensor is named if the correlation of its error with the error of a parameter is at least this value: half of the
# variance is then common (0.7² = 0.49).
_MIN_CORRELATION = 0.7
# Damping is determined if its relative expanded uncertainty is below this value.
_MAX_RELATIVE_EXPANDED = 0.5


@dataclass(frozen=True)
class LevelDamping:
    """Damping of the structure without its dampers, estimated from one sweep."""

    label: str  # recording and level
    dampers_move: bool  # whether dampers could move in the sweep
    acceleration: float  # largest acceleration of a measured body [m/s²]
    keys: tuple[str, ...]  # keys of the damping in the scene
    value: Array  # in SI; NaN where the sweep does not determine it, shape (keys,)
    expanded: Array  # expanded uncertainty, shape (keys,)


def damping_by_level(problem: Problem, estimated: Estimate) -> tuple[LevelDamping, ...]:
    """Return the damping fitted to each sweep alone, with all other values fixed; empty for a single sweep."""
    active = [k for k, parameter in enumerate(problem.parameters) if "damping" in parameter.key_path]
    sweeps = [group for group in problem.groups if group.curves.level is not None]
    if not active or len(sweeps) < 2:
        return ()
    keys = tuple(problem.parameters[k].key for k in active)
    by_level = []
    for group in sweeps:
        curves = group.curves
        assert curves.level is not None
        x = solve(problem, estimated.x, [group], 0.0, active, max_evaluations=8)
        jacobian = problem.jacobian(x, [group], 0.0, active)
        residuals = problem.residual(x, [group])[: -problem.size]
        variance = max(float(np.mean(residuals**2)), 1.0)
        # The covariance is inverse_r inverse_r^T, with the factor R of the QR decomposition.
        inverse_r = np.linalg.inv(np.linalg.qr(jacobian, mode="r"))
        relative_expanded = COVERAGE_FACTOR * np.sqrt(variance) * np.linalg.norm(inverse_r, axis=1)
        value, is_determined = problem.values(x)[active], relative_expanded < _MAX_RELATIVE_EXPANDED
        acceleration = float(((2.0 * np.pi * curves.frequency) ** 2 * curves.level * abs(curves.value)).max())
        value, expanded = (np.where(is_determined, each, np.nan) for each in (value, value * relative_expanded))
        by_level.append(LevelDamping(curves.label, group.orbits is not None, acceleration, keys, value, expanded))
    # This evaluation of the residuals restores the orbits of the estimate.
    problem.residual(estimated.x, problem.groups)
    return tuple(by_level)


def describe_coupled_values(
    problem: Problem, estimated: Estimate, statuses: Sequence[str], largest_gaps: Mapping[int, float]
) -> tuple[str, ...]:
    """Describe the values that the data do not determine, then the poorly determined combinations, the worst first.

    The combinations are the principal axes of the covariance of the parameters' unknowns (see `problem`). `statuses`:
    as in `Fitted`. `largest_gaps`: by parameter, the largest gap [m] of a damper that never hit its ceiling, which is a
    lower bound of its clearance.
    """
    count, moving = len(problem.parameters), any(group.orbits is not None for group in problem.groups)
    determined = [k for k in range(count) if statuses[k] != "undetermined"]
    undetermined = []
    for k in sorted({*range(count)} - {*determined}):
        if k in largest_gaps:
            undetermined.append(
                f"{problem.parameters[k].key} is at least {1e3 * largest_gaps[k]:.3g} mm. No upper limit is "
                "determined, because the damper does not hit its ceiling in these recordings. Record at a higher level."
            )
            continue
        never_moves = problem.parameters[k].damper is not None and not moving
        reason = " (no recording in which its damper moves)" if never_moves else ""
        undetermined.append(
            f"{problem.parameters[k].key} is not determined by these recordings{reason}; it stays near its initial "
            "value."
        )
    if not determined:
        return tuple(undetermined)
    coupled = []
    axes, deviations, _ = np.linalg.svd(estimated.factor[determined], full_matrices=False)
    for deviation, axis in zip(deviations, axes.T, strict=True):
        relative_expanded = COVERAGE_FACTOR * float(deviation) * float(abs(axis).max())
        large = np.flatnonzero(abs(axis) > _MIN_COMPONENT_RATIO * abs(axis).max())
        if relative_expanded < _MIN_RELATIVE_EXPANDED or large.size == 1:
            continue
        signs = np.sign(axis[large])
        direction = "by the same factor" if abs(signs.sum()) == large.size else "in opposite directions"
        correlations = estimated.correlation[determined[large[0]]][count:]
        sensors = [
            sensor.name
            for sensor, correlation in zip(problem.sensors, correlations, strict=False)
            if abs(correlation) > _MIN_CORRELATION
        ]
        cause = f" (their values depend on the calibration of {', '.join(sensors)})" if sensors else ""
        names = ", ".join(problem.parameters[determined[k]].key for k in large)
        line = (
            f"{names} can change {direction}, by up to {format_percent(relative_expanded)}, with no visible change of "
            f"the curves{cause}."
        )
        coupled.append((relative_expanded, line))
    return *undetermined, *(line for _, line in sorted(coupled, key=lambda entry: -entry[0]))
