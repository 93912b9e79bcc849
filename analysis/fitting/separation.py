"""Damping of the structure from each sweep alone, which shows whether it depends on level or dampers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.fitting.estimate import CONFIDENCE, Estimate, solved
from analysis.fitting.problem import Problem
from rig.arrays import Array


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
    out = []
    for group in tones:
        curves = group.curves
        assert curves.level is not None
        x = solved(problem, found.x, [group], 0.0, active, 8)
        jacobian = problem.jacobian(x, [group], 0.0, active)
        misses = problem.residual(x, [group])[: -problem.size]
        variance = max(float(np.mean(misses**2)), 1.0)
        root = np.linalg.inv(np.linalg.qr(jacobian, mode="r"))
        half = CONFIDENCE * np.sqrt(variance) * np.linalg.norm(root, axis=1)
        value = problem.values(x)[active]
        size = (2.0 * np.pi * curves.frequency) ** (2 if curves.reference in ("table", "force") else 0)
        out.append(
            LevelDamping(
                curves.label,
                group.tones is not None,
                float((size * curves.level * abs(curves.value)).max()),
                tuple(problem.parameters[k].key for k in active),
                np.where(half < 0.5, value, np.nan),
                np.where(half < 0.5, value * half, np.nan),
            )
        )
    problem.residual(found.x, problem.groups)
    return tuple(out)
