"""Classification of a damper's periodic motion; Types I to III are those of Inoue, Yokomichi and Hiraki (2011)."""

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.engine.trajectory import Trajectory
from rig.core.laws.events import CEILING, CEILING_IMPACT, CEILING_TOUCH, FLOOR_IMPACT, FLOOR_TOUCH, SEPARATION, SLIP
from rig.core.system.hybrid_system import HybridSystem

#: The damper stays at the upper wall if the contact is longer than this multiple of the duration of an isolated
#: contact.
MIN_STAY_RATIO = 2.0


def motion_types(trajectory: Trajectory, system: HybridSystem, n_periods: int, segment_duration: float) -> list[str]:
    """Classify the motion of every element (damper or joint) over one repetition of a steady-state motion.

    `trajectory`: one repetition; `n_periods`: number of drive periods after which the motion repeats, 0 if it does not;
    `segment_duration`: duration of a segment of the trajectory [s].

    Returns one of these types for each element: "riding" (at rest on its wall, or sticking, throughout), "linear" (not
    at rest at the start, and no impacts), "k slips per n" (no impacts), "I" (one impact on the lower wall per period),
    "II" (one impact on each wall per period, no stay at the upper wall), "III" (as "II", but with a stay), "k per n" (k
    impacts in n periods), "irregular" (no repetition). The start of a finite-duration contact is an impact. Only
    dampers have types I to III; contacts of a joint are "k per n".
    """
    times = trajectory.event_segment * segment_duration + trajectory.event_offset
    cycle = len(trajectory.state) * segment_duration
    events_of_elements = [trajectory.event_damper == j for j in range(len(system.elements))]
    return [
        type_of(trajectory.event_kind[events], times[events], system, j, n_periods, cycle)
        for j, events in enumerate(events_of_elements)
    ]


def type_of(
    kinds: NDArray[np.int64], times: Array, system: HybridSystem, element: int, n_periods: int, cycle: float
) -> str:
    """Classify the motion of an element (from 0) by its events over `n_periods`, in total `cycle` seconds."""
    lower_impacts = np.count_nonzero((kinds == FLOOR_IMPACT) | (kinds == FLOOR_TOUCH))
    upper_impacts = np.count_nonzero((kinds == CEILING_IMPACT) | (kinds == CEILING_TOUCH))
    if n_periods == 0:
        return "irregular"
    if lower_impacts + upper_impacts == 0:
        slips = np.count_nonzero(kinds == SLIP)
        if slips:
            return f"{slips} slips per {n_periods}"
        return "riding" if system.elements[element].law.starts_at_rest else "linear"
    every_period = n_periods == 1 and lower_impacts == 1 and not system.elements[element].is_joint
    if every_period and upper_impacts == 0:
        return "I"
    if every_period and upper_impacts == 1:
        return "III" if _stays_at_upper_wall(kinds, times, system, element, cycle) else "II"
    return f"{lower_impacts + upper_impacts} per {n_periods}"


def _stays_at_upper_wall(
    kinds: NDArray[np.int64], times: Array, system: HybridSystem, damper: int, cycle: float
) -> bool:
    """Return whether the damper stays at the upper wall after its impact."""
    impact = int(np.flatnonzero(np.isin(kinds, (CEILING_IMPACT, CEILING_TOUCH)))[0])
    following = (impact + 1) % len(kinds)
    if kinds[impact] == CEILING_IMPACT:
        return bool(kinds[following] in (SEPARATION, SLIP) and times[following] != times[impact])
    stay = times[following] - times[impact] + (cycle if following < impact else 0.0)
    return bool(stay > MIN_STAY_RATIO * system.duration_and_restitution(damper, CEILING)[0])


def element_labels(elements: int, joints: int) -> list[str]:
    """Return the labels of all dampers and joints; `joints`: number of joints, the last elements.

    >>> element_labels(3, 1)
    ['damper 1', 'damper 2', 'joint 1']
    """
    dampers = elements - joints
    return [*(f"damper {k}" for k in range(1, dampers + 1)), *(f"joint {k}" for k in range(1, joints + 1))]


def describe_motion(motion: NDArray[np.str_], joints: int) -> str:
    """Describe the types of motion of all elements but those that are always linear, shape (elements, points).

    >>> describe_motion(np.array([["I", "riding"], ["linear", "1 per 1"], ["linear", "linear"]]), 2)
    'damper 1: I, riding; joint 1: linear, 1 per 1'
    >>> describe_motion(np.array([["I", "riding"]]), 0)
    'I, riding'
    """
    texts = [", ".join(dict.fromkeys(types)) for types in motion.tolist()]
    if len(texts) > 1:
        labeled = zip(element_labels(len(texts), joints), texts, strict=True)
        return "; ".join(f"{label}: {text}" for label, text in labeled if text != "linear") or "linear"
    return texts[0] if texts else "linear"


def combined_type(types: list[str]) -> str:
    """Combine the types of motion of all dampers; "linear" without dampers that can hit a wall.

    >>> combined_type(["I", "II", "I"])
    'I/II'
    >>> combined_type(["linear", "riding"]), combined_type([])
    ('riding', 'linear')
    """
    return "/".join(sorted(set(types) - {"linear"})) or "linear"
