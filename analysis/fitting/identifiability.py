"""Identifiability: combinations of values that can change without changing the curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.fitting.estimate import CONFIDENCE, Estimate
from analysis.fitting.problem import Problem

# Smallest half width of a 95 % interval along a principal axis that is reported, and the smallest component,
# relative to the largest, of a value that is named.
_WIDE, _SHARE = 0.02, 0.3


def coupled_values(problem: Problem, found: Estimate, statuses: Sequence[str]) -> tuple[str, ...]:
    """Describe the combinations of values that the data do not determine, widest interval first.

    The directions are the principal axes of the covariance of the parameters' logarithms.
    """
    count = len(problem.parameters)
    known = [k for k in range(count) if statuses[k] != "undetermined"]
    lines = []
    for k in range(count):
        if statuses[k] == "undetermined":
            parameter = problem.parameters[k]
            hidden = parameter.damper is not None and not any(
                group.tones is not None for group in problem.groups
            )
            why = " (no recording in which its damper moves)" if hidden else ""
            lines.append(
                f"{parameter.key} is not determined by these recordings{why}; it keeps about its initial value."
            )
    if not known:
        return tuple(lines)
    axes, size, _ = np.linalg.svd(found.factor[known], full_matrices=False)
    for deviation, axis in zip(size, axes.T, strict=True):
        half = CONFIDENCE * float(deviation) * float(abs(axis).max())
        members = [k for k, share in zip(known, abs(axis), strict=True) if share > _SHARE * abs(axis).max()]
        if half < _WIDE:
            break
        names = ", ".join(problem.parameters[k].key for k in members)
        if len(members) == 1:
            continue
        signs = axis[[known.index(k) for k in members]]
        relation = "by one factor" if (signs > 0).all() or (signs < 0).all() else "against each other"
        cause = _calibrations(problem, found, members[0])
        lines.append(
            f"{names} may change together, {relation}, by {half:.1%} without the curves showing it{cause}."
        )
    return tuple(lines)


def _calibrations(problem: Problem, found: Estimate, parameter: int) -> str:
    """Name the sensors whose tolerance determines a value."""
    count = len(problem.parameters)
    related = found.correlation[parameter]
    names = [sensor.name for k, sensor in enumerate(problem.sensors) if abs(related[count + k]) > 0.7]
    return f" (only the calibration of {', '.join(names)} decides)" if names else ""
