"""The structure's own damping estimated from each sweep alone: whether it depends on level or dampers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.fitting.estimate import CONFIDENCE, Estimate, solved
from analysis.fitting.problem import Problem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LevelDamping:
    """Damping of the structure, estimated from one sweep.

    Attributes
    ----------
    label : str
        Recording and setting.
    damped : bool
        Whether dampers moved; what they took out is in the model, and not in these values.
    acceleration : float
        Largest acceleration of a measured body, m/s².
    keys : tuple of str
        Of the damping in the scene.
    value, bound : ndarray, shape (keys,)
        And its 95 % bound; NaN where the sweep does not determine it.
    """

    label: str
    damped: bool
    acceleration: float
    keys: tuple[str, ...]
    value: Array
    bound: Array


def damping_by_level(problem: Problem, found: Estimate) -> tuple[LevelDamping, ...]:
    """Fit the damping anew to each sweep, all else held; nothing where there is but one."""
    active = [k for k, one in enumerate(problem.parameters) if "damping" in one.place]
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
