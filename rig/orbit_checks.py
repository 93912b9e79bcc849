"""Whether an orbit that meets its equations is a motion: nothing else may happen between its events."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.orbit_problem import Plan
from rig.shooting import (
    CEILING,
    CEILING_BOUNCE,
    FLOOR,
    FLOOR_BOUNCE,
    SEPARATION,
    WITH_LAST,
    Equations,
)

Array = NDArray[np.float64]

# Relative to g/w^2 (gaps), to g (accelerations) and to 1/w (times).
ROUNDING = 1e-9
# In radians of the drive; a damper thrown for so short was accelerated by 1 + 1e-5 of gravity.
SHORTEST_FLIGHT = 0.02


def lowest(left: Array, right: Array, slope_left: Array, slope_right: Array) -> Array:
    """Find the smallest value, over intervals, of the cubic through values and slopes at their ends.

    Slopes are times the interval's length.     Where the cubic has no minimum inside, the smaller end value.
    """
    # In t from 0 to 1: p(t) = left + slope_left t + c t^2 + d t^3.
    c = 3 * (right - left) - 2 * slope_left - slope_right
    d = 2 * (left - right) + slope_left + slope_right
    with np.errstate(all="ignore"):
        root = np.sqrt(np.maximum(c * c - 3 * d * slope_left, 0))
        # The root of p' at which p'' > 0, in the form without cancellation.
        t = np.where(c > 0, -slope_left / (c + root), (root - c) / (3 * d))
        value = left + t * (slope_left + t * (c + t * d))
    inside = (slope_left < 0) & (slope_right > 0) & (t > 0) & (t < 1)
    return np.where(inside, value, np.minimum(left, right))


def flaw(
    plan: Plan, equations: Equations, instants: Array, times: Array, guards: Array, closing: Array
) -> str:
    """Say what makes an orbit impossible; "" for one that is possible.

    Parameters
    ----------
    plan : Plan
    equations : Equations
    instants : ndarray, shape (events,)
        Of the events [s].
    times, guards : ndarray
        From `rig.shooting.sample`.
    closing : ndarray, shape (events,)
        Closing speeds of the impacts.
    """
    sequence, omega, gravity = plan.sequence, equations.omega, equations.gravity
    events = len(sequence.kind)
    length = gravity / omega**2
    brief = _vanishing_flight(plan, instants, omega)
    if brief:
        return brief
    stretches = range(events) if events else range(1)
    for s in stretches:
        k = s + 1 if events else 0
        if (times[s, -1] - times[s, 0]) * omega < -ROUNDING:
            return f"{_event(plan, s)} and {_event(plan, (s + 1) % events)} change order"
        for j in range(len(equations.position)):
            found = _stretch_flaw(
                plan, k, s, j, times[s], guards[s, :, j], equations.clearance[j], length, gravity
            )
            if found:
                return found
    for e in range(events):
        kind, j = sequence.kind[e], int(sequence.damper[e])
        name = f"damper {j + 1}"
        # q'' + g of the damper's body right after the event, from the curvature of its gap in flight.
        if kind in (CEILING_BOUNCE, FLOOR_BOUNCE, WITH_LAST):
            gap = guards[e, :2, j]
            step = times[e, 1] - times[e, 0]
            lifts = (gap[1, 1] - gap[0, 1]) / step if step > 0 else 0.0
            ceiling = kind == CEILING_BOUNCE or (kind == WITH_LAST and sequence.wall[e, j] == 2)
            if (lifts if ceiling else -lifts) > ROUNDING * gravity:
                where = "ceiling" if ceiling else "floor"
                return f"{name} stays at the {where}"
        if kind == SEPARATION:
            before = guards[e - 1, -1, j, 1] * (1 if sequence.wall[e, j] == 1 else -1)
            if before > ROUNDING * gravity * omega:
                return f"{name} is not released"
        elif kind != WITH_LAST and closing[e] < -ROUNDING * gravity / omega:
            return f"{name} leaves the wall that it should hit"
    return ""


def _vanishing_flight(plan: Plan, instants: Array, omega: float) -> str:
    """Name a flight about to vanish; at length 0 its equations say nothing, so a curve ends before."""
    sequence = plan.sequence
    for e in np.flatnonzero(np.isin(sequence.kind, (SEPARATION, WITH_LAST))):
        own = np.flatnonzero(sequence.damper == sequence.damper[e])
        landing = own[(np.searchsorted(own, e) + 1) % len(own)]
        length = (instants[landing] - instants[e]) * omega % (2 * np.pi * plan.repetition)
        same = (sequence.kind[landing] == FLOOR) == (sequence.wall[e, sequence.damper[e]] == 1)
        if same and sequence.kind[landing] in (FLOOR, CEILING) and length < SHORTEST_FLIGHT:
            return f"the flight of damper {sequence.damper[e] + 1} vanishes"
    return ""


def _event(plan: Plan, index: int) -> str:
    return f"event {plan.label.split()[index]}"


def _stretch_flaw(
    plan: Plan,
    k: int,
    s: int,
    j: int,
    times: Array,
    guard: Array,
    clearance: float,
    length: float,
    gravity: float,
) -> str:
    """Look for what damper j may not do in stretch k."""
    wall = plan.sequence.wall[k, j]
    step = times[1] - times[0]
    value, slope = guard[:, 0], guard[:, 1] * step
    if wall:
        sign = 1.0 if wall == 1 else -1.0
        if (
            lowest(sign * value[:-1], sign * value[1:], sign * slope[:-1], sign * slope[1:]).min()
            < -ROUNDING * gravity
        ):
            return f"damper {j + 1} leaves the {'floor' if wall == 1 else 'ceiling'} early"
        return ""
    # At the ends of a stretch a damper may touch the wall that it leaves or hits there.
    if _touches(value, slope, length):
        return f"damper {j + 1} hits the floor early"
    if np.isfinite(clearance) and _touches(clearance - value, -slope, length):
        return f"damper {j + 1} hits the ceiling early"
    return ""


def _touches(value: Array, slope: Array, length: float) -> bool:
    low = lowest(value[:-1], value[1:], slope[:-1], slope[1:])
    low[0] = np.inf if slope[0] >= 0 and slope[1] >= 0 else low[0]
    inside = value[1:-1].min() if len(value) > 2 else np.inf
    dips = (slope[:-1] < 0) & (slope[1:] > 0)
    return bool(min(inside, low[dips].min(initial=np.inf)) < -ROUNDING * length)
