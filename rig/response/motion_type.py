"""The type of a damper's periodic motion, in the paper's terms where they apply."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.engine.contact import CEILING_IMPACT, FLOOR_IMPACT, SEPARATION
from rig.engine.trajectory import Trajectory


def motion_types(trajectory: Trajectory, dampers: int, repetition: int) -> list[str]:
    """Name the motion of every damper over one repetition of a steady motion.

    Parameters
    ----------
    course : Trajectory
        One repetition.
    repetition : int
        Its length in periods of the drive; 0 if the motion does not repeat.

    Returns
    -------
    list of str
        "riding"; "I" (one floor impact a period), "II" (one floor and one ceiling impact, no stay at the
        ceiling), "III" (the same with a stay); "k per n" for k impacts in n periods; "irregular".
    """
    return [_type(trajectory, j, repetition) for j in range(dampers)]


def _type(trajectory: Trajectory, damper: int, repetition: int) -> str:
    own = trajectory.event_damper == damper
    kinds = trajectory.event_kind[own]
    floor, ceiling = int((kinds == FLOOR_IMPACT).sum()), int((kinds == CEILING_IMPACT).sum())
    if floor + ceiling == 0:
        return "riding" if repetition else "irregular"
    if repetition == 0:
        return "irregular"
    if repetition == 1 and floor == 1 and ceiling == 0:
        return "I"
    if repetition == 1 and floor == 1 and ceiling == 1:
        return "III" if _stays_at_ceiling(trajectory, own) else "II"
    return f"{floor + ceiling} per {repetition}"


def _stays_at_ceiling(trajectory: Trajectory, own: NDArray[np.bool_]) -> bool:
    """Whether the separation after the ceiling impact comes later than the impact."""
    kinds, segments, offsets = (
        trajectory.event_kind[own],
        trajectory.event_segment[own],
        trajectory.event_offset[own],
    )
    hit = int(np.flatnonzero(kinds == CEILING_IMPACT)[0])
    after = (hit + 1) % len(kinds)
    if kinds[after] != SEPARATION:
        return False
    return bool(segments[after] != segments[hit] or offsets[after] > offsets[hit])


def overall(types: list[str]) -> str:
    """Sum up the dampers' types.

    >>> overall(["I", "II", "I"])
    'I/II'
    """
    return "/".join(sorted(set(types))) if types else "linear"
