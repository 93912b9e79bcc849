"""Which values recordings cannot separate: those that may change together without changing the curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.fitting.estimate import CONFIDENCE, Estimate
from analysis.fitting.problem import Problem

# Half a 95 % interval in a direction, from which on it is reported; and a share in it that counts, of the largest.
_WIDE, _SHARE = 0.02, 0.3


def together(problem: Problem, found: Estimate, statuses: Sequence[str]) -> tuple[str, ...]:
    """Name the values that move together in the directions that the data leave open, the widest first.

    The directions are the principal axes of the covariance of the parameters' logarithms.
    """
    count = len(problem.parameters)
    known = [k for k in range(count) if statuses[k] != "undetermined"]
    lines = []
    for k in range(count):
        if statuses[k] == "undetermined":
            one = problem.parameters[k]
            hidden = one.damper is not None and not any(group.tones is not None for group in problem.groups)
            why = " (no recording in which its damper moves)" if hidden else ""
            lines.append(
                f"{one.key} is not determined by these recordings{why}; it stays about where it was."
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
        way = "by one factor" if (signs > 0).all() or (signs < 0).all() else "against each other"
        cause = _calibrations(problem, found, members[0])
        lines.append(f"{names} may move together, {way}, by {half:.1%} without the curves showing it{cause}.")
    return tuple(lines)


def _calibrations(problem: Problem, found: Estimate, parameter: int) -> str:
    """Name the sensors whose tolerance decides a value."""
    count = len(problem.parameters)
    related = found.correlation[parameter]
    names = [sensor.name for k, sensor in enumerate(problem.sensors) if abs(related[count + k]) > 0.7]
    return f" (only the calibration of {', '.join(names)} decides)" if names else ""
