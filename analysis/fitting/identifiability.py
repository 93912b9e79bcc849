"""What the recordings determine: combinations of values that leave the curves unchanged, and damping by sweep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.fitting.estimate import COVERAGE_FACTOR, Estimate, solved
from analysis.fitting.problem import Problem
from rig.arrays import Array

# Minimum half width of a 95 % interval along a principal axis that is reported, relative to the values.
_MIN_HALF_WIDTH = 0.02
# Values are named if their components of the axis exceed this ratio to the largest component.
_MIN_COMPONENT_RATIO = 0.3
# A sensor limits a value if the correlation of their errors is at least this.
_MIN_CORRELATION = 0.7


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


def damping_by_level(problem: Problem, found: Estimate) -> tuple[LevelDamping, ...]:
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
        x = solved(problem, found.x, [group], 0.0, active, 8)
        jacobian = problem.jacobian(x, [group], 0.0, active)
        residuals = problem.residual(x, [group])[: -problem.size]
        variance = max(float(np.mean(residuals**2)), 1.0)
        root = np.linalg.inv(np.linalg.qr(jacobian, mode="r"))
        half = COVERAGE_FACTOR * np.sqrt(variance) * np.linalg.norm(root, axis=1)
        value, known = problem.values(x)[active], half < 0.5
        size = (2.0 * np.pi * curves.frequency) ** (2 if curves.reference in ("table", "force") else 0)
        acceleration = float((size * curves.level * abs(curves.value)).max())
        value, bound = np.where(known, value, np.nan), np.where(known, value * half, np.nan)
        out.append(LevelDamping(curves.label, group.tones is not None, acceleration, keys, value, bound))
    problem.residual(found.x, problem.groups)
    return tuple(out)


def coupled_values(problem: Problem, found: Estimate, statuses: Sequence[str]) -> tuple[str, ...]:
    """Describe the combinations of values that the data do not determine, widest interval first.

    The directions are the principal axes of the covariance of the parameters' logarithms.
    """
    count, moving = len(problem.parameters), any(group.tones is not None for group in problem.groups)
    known = [k for k in range(count) if statuses[k] != "undetermined"]
    lines = []
    for k in sorted({*range(count)} - {*known}):
        hidden = problem.parameters[k].damper is not None and not moving
        why = " (no recording in which its damper moves)" if hidden else ""
        lines.append(
            f"{problem.parameters[k].key} is not determined by these recordings{why}; it keeps about its initial value."
        )
    if not known:
        return tuple(lines)
    axes, deviations, _ = np.linalg.svd(found.factor[known], full_matrices=False)
    half_widths = COVERAGE_FACTOR * deviations * abs(axes).max(axis=0)
    for k in np.argsort(-half_widths, kind="stable"):
        axis = axes[:, k]
        named = np.flatnonzero(abs(axis) > _MIN_COMPONENT_RATIO * abs(axis).max())
        if half_widths[k] < _MIN_HALF_WIDTH or named.size == 1:
            continue
        relation = "by one factor" if abs(np.sign(axis[named]).sum()) == named.size else "against each other"
        correlation = found.correlation[known[named[0]], count:]
        sensors = [
            s.name for s, r in zip(problem.sensors, correlation, strict=False) if abs(r) > _MIN_CORRELATION
        ]
        cause = f" (only the calibration of {', '.join(sensors)} decides)" if sensors else ""
        names = ", ".join(problem.parameters[known[index]].key for index in named)
        lines.append(
            f"{names} may change together, {relation}, by {half_widths[k]:.1%} without the curves showing it{cause}."
        )
    return tuple(lines)
