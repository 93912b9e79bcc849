"""Identifiability: combinations of values that leave the curves unchanged, and damping by sweep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.fitting.estimate import COVERAGE_FACTOR, Estimate, solve
from analysis.fitting.problem import Problem
from rig.arrays import Array

# Smallest relative half width of a 95 % interval along a principal axis that is reported.
_MIN_HALF_WIDTH = 0.02
# Components of a principal axis above this ratio to the largest are named.
_MIN_COMPONENT_RATIO = 0.3
# A sensor limits a value if their errors have at least this correlation.
_MIN_CORRELATION = 0.7
# Largest half width of a 95 % interval of damping, relative, that counts as determined.
_MAX_HALF_WIDTH = 0.5


@dataclass(frozen=True)
class LevelDamping:
    """Damping of the structure, estimated from one sweep.

    `value`, `bound`, shape (keys,): damping and its 95 % bound; NaN where the sweep does not determine it.
    """

    label: str  # recording and setting
    damped: bool  # whether dampers moved. The model contains their dissipation; these values do not
    acceleration: float  # largest acceleration of a measured body, m/s²
    keys: tuple[str, ...]  # keys of the damping in the scene
    value: Array
    bound: Array


def damping_by_level(problem: Problem, estimated: Estimate) -> tuple[LevelDamping, ...]:
    """Fit only the damping to each sweep; empty for a single sweep."""
    active = [k for k, parameter in enumerate(problem.parameters) if "damping" in parameter.place]
    tones = [group for group in problem.groups if group.curves.level is not None]
    if not active or len(tones) < 2:
        return ()
    keys = tuple(problem.parameters[k].key for k in active)
    out = []
    for group in tones:
        curves = group.curves
        assert curves.level is not None
        x = solve(problem, estimated.x, [group], 0.0, active, 8)
        jacobian = problem.jacobian(x, [group], 0.0, active)
        residuals = problem.residual(x, [group])[: -problem.size]
        variance = max(float(np.mean(residuals**2)), 1.0)
        root = np.linalg.inv(np.linalg.qr(jacobian, mode="r"))
        half_width = COVERAGE_FACTOR * np.sqrt(variance) * np.linalg.norm(root, axis=1)
        value, is_determined = problem.values(x)[active], half_width < _MAX_HALF_WIDTH
        to_acceleration = (2.0 * np.pi * curves.frequency) ** (2 if curves.reference in ("table", "force") else 0)
        acceleration = float((to_acceleration * curves.level * abs(curves.value)).max())
        value, bound = np.where(is_determined, value, np.nan), np.where(is_determined, value * half_width, np.nan)
        out.append(LevelDamping(curves.label, group.tones is not None, acceleration, keys, value, bound))
    problem.residual(estimated.x, problem.groups)
    return tuple(out)


def coupled_values(problem: Problem, estimated: Estimate, statuses: Sequence[str]) -> tuple[str, ...]:
    """Describe the combinations of values that the data do not determine, widest interval first.

    The directions are the principal axes of the covariance of the parameters' logarithms.
    """
    count, moving = len(problem.parameters), any(group.tones is not None for group in problem.groups)
    determined = [k for k in range(count) if statuses[k] != "undetermined"]
    undetermined = []
    for k in sorted({*range(count)} - {*determined}):
        never_moves = problem.parameters[k].damper is not None and not moving
        reason = " (no recording in which its damper moves)" if never_moves else ""
        undetermined.append(
            f"{problem.parameters[k].key} is not determined by these recordings{reason}; it keeps about its initial "
            "value."
        )
    if not determined:
        return tuple(undetermined)
    coupled = []
    axes, deviations, _ = np.linalg.svd(estimated.factor[determined], full_matrices=False)
    for deviation, axis in zip(deviations, axes.T, strict=True):
        half_width = COVERAGE_FACTOR * float(deviation) * float(abs(axis).max())
        members = np.flatnonzero(abs(axis) > _MIN_COMPONENT_RATIO * abs(axis).max())
        if half_width < _MIN_HALF_WIDTH or members.size == 1:
            continue
        signs = np.sign(axis[members])
        direction = "by the same factor" if abs(signs.sum()) == members.size else "in opposite directions"
        related = estimated.correlation[determined[members[0]]][count:]
        sensors = [s.name for s, r in zip(problem.sensors, related, strict=False) if abs(r) > _MIN_CORRELATION]
        cause = f" (their values depend on the calibration of {', '.join(sensors)})" if sensors else ""
        names = ", ".join(problem.parameters[determined[k]].key for k in members)
        line = f"{names} can change {direction} by up to {half_width:.1%} with no visible change of the curves{cause}."
        coupled.append((half_width, line))
    return *undetermined, *(line for _, line in sorted(coupled, key=lambda entry: -entry[0]))
