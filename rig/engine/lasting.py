"""Contact that lasts: a bed of its own on spring-dampers at floor and ceiling, which push and never pull.

The force on the bed is -k (z - o) - c z' (z the gap, o the height of the wall) while it is within the wall and the
force points away from it; nothing jumps but the force. Three guards see to that:

- a free bed touches where its gap to a wall falls to zero;
- it is released where the force falls to zero, with a dashpot before the overlap is undone;
- a released bed that is still within the wall (`recovering`) is pressed again if the force law rises to zero, and is
  free when the overlap is undone. The latter changes no force and is no event.

All three are linear in the state, which holds the gap as a coordinate.
"""

from __future__ import annotations

import math

import numpy as np

from rig.arrays import Array
from rig.engine.flow import Flow, Model
from rig.engine.state import (
    CEILING,
    CEILING_TOUCH,
    FLIGHT,
    FLOOR,
    FLOOR_TOUCH,
    RELEASE,
    Log,
    State,
    note,
    toggle,
)
from rig.engine.workspace import Workspace
from rig.numerics.bernstein import LENGTH, first_crossing
from rig.numerics.complementarity import ROUNDING
from rig.numerics.jit import compiled, inlined

#: What a guard's crossing means, beside the walls `FLOOR` and `CEILING` that a bed touches.
RELEASED, FREE = 0, 3
#: A force below this part of the spring's and the dashpot's is one that they cancel to.
FORCELESS = 1e-6
#: One below this part of what would turn the bed round is the rounding of its gap.
FEIGNED = 1e-9


@inlined
def gap_of(model: Model, z: Array, j: int) -> float:
    """Height of a bed above its floor, m."""
    return z[model.bed[j]]


@inlined
def opening(model: Model, z: Array, j: int) -> float:
    """Rate of the gap, m/s."""
    return z[model.first_velocity + model.bed[j]]


@inlined
def overlap(model: Model, z: Array, j: int, wall: int) -> float:
    """How deep a bed is within a wall, m; negative outside."""
    gap = gap_of(model, z, j)
    return -gap if wall == FLOOR else gap - model.clearance[j]


@inlined
def push(model: Model, z: Array, j: int, wall: int) -> float:
    """Force with which a wall pushes, N; negative where it would pull."""
    closing = -opening(model, z, j) if wall == FLOOR else opening(model, z, j)
    stiffness, damping = model.wall_stiffness[j, wall - 1], model.wall_damping[j, wall - 1]
    return stiffness * overlap(model, z, j, wall) + damping * closing


@inlined
def push_rate(model: Model, z: Array, j: int, wall: int) -> float:
    """Rate of that force, N/s; needs the accelerations behind the state."""
    bend = z[model.behind + model.bed[j]]
    rate = model.wall_stiffness[j, wall - 1] * opening(model, z, j) + model.wall_damping[j, wall - 1] * bend
    return -rate if wall == FLOOR else rate


@inlined
def _forceless(model: Model, z: Array, j: int, wall: int) -> bool:
    """Whether a wall's force is at the zero that its guard has just found.

    Only an impact elsewhere, through a full mass matrix, opens or closes a contact at any other force. Without a
    dashpot, or nearly so, there is nothing for the spring's force to cancel: it is what rounding leaves of the overlap.
    """
    spring = model.wall_stiffness[j, wall - 1] * abs(overlap(model, z, j, wall))
    dashpot = model.wall_damping[j, wall - 1] * abs(opening(model, z, j))
    return abs(push(model, z, j, wall)) <= FORCELESS * (spring + dashpot) + _feigned(model, z, j, wall)


@inlined
def _feigned(model: Model, z: Array, j: int, wall: int) -> float:
    """Force that the rounding of a gap may feign at a wall, N: a part of speed times sqrt(stiffness mass)."""
    return FEIGNED * abs(opening(model, z, j)) * math.sqrt(model.wall_stiffness[j, wall - 1] * model.mass[j])


@inlined
def lowest_guard(model: Model, state: State, z: Array, j: int) -> float:
    """Smallest of the guards of a bed at a state; that of one which is recovering counts as zero."""
    mode = state.mode[j]
    if mode != FLIGHT:
        return push(model, z, j, mode)
    if state.recovering[j] != FLIGHT:
        return 0.0
    gap = gap_of(model, z, j)
    return min(gap, model.clearance[j] - gap)


@inlined
def _series_of(
    model: Model, workspace: Workspace, j: int, length: float, on_gap: float, on_speed: float, offset: float
) -> float:
    """Series of on_gap (z - offset) + on_speed z' over `length` step lengths; returns the size of its terms."""
    series = workspace.series
    bed = model.bed[j]
    size = abs(on_gap) * offset
    power = 1.0
    for k in range(LENGTH):
        by_gap = on_gap * workspace.tableau[k, bed] * power
        by_speed = on_speed * workspace.tableau[k, model.first_velocity + bed] * power
        series[k] = by_gap + by_speed
        size += abs(by_gap) + abs(by_speed)
        power *= length
    series[0] -= on_gap * offset
    return size


@inlined
def crossing(workspace: Workspace, start: int, size: float) -> tuple[float, int]:
    """First crossing of the guard in `workspace.series`, whose terms have a size: (tau, ambiguous)."""
    return first_crossing(
        workspace.series, start, ROUNDING * size, workspace.work, workspace.spans, workspace.bernstein
    )


@compiled
def examine_lasting(
    model: Model, state: State, workspace: Workspace, j: int, length: float
) -> tuple[float, int, int]:
    """First change of a lasting contact in a step: (fraction of the step, what, ambiguous)."""
    mode, wall = state.mode[j], state.recovering[j]
    known = state.multiplicity[j]
    clearance = model.clearance[j]
    if mode == FLIGHT and wall == FLIGHT:
        size = _series_of(model, workspace, j, length, 1.0, 0.0, 0.0)
        tau, ambiguous = crossing(workspace, max(known, 0), size)
        what = FLOOR
        if clearance < np.inf:
            size = _series_of(model, workspace, j, length, -1.0, 0.0, clearance)
            at_ceiling, more = crossing(workspace, max(-known, 0), size)
            ambiguous += more
            if at_ceiling < tau:
                tau, what = at_ceiling, CEILING
        return tau, what, ambiguous
    wall = wall if mode == FLIGHT else mode
    up = 1.0 if wall == FLOOR else -1.0
    away = up if mode == FLIGHT else -up
    offset = 0.0 if wall == FLOOR else clearance
    stiffness, damping = model.wall_stiffness[j, wall - 1], model.wall_damping[j, wall - 1]
    size = _series_of(model, workspace, j, length, away * stiffness, away * damping, offset)
    tau, ambiguous = crossing(workspace, max(known, 0), size)
    if mode != FLIGHT:
        return tau, RELEASED, ambiguous
    what = wall
    size = _series_of(model, workspace, j, length, -up, 0.0, offset)
    undone, more = crossing(workspace, 0, size)
    if undone <= tau:
        tau, what = undone, FREE
    return tau, what, ambiguous + more


@compiled
def change_lasting(flow: Flow, model: Model, state: State, log: Log, j: int, what: int) -> None:
    """Damper j touches a wall, is released by it, or has left it altogether."""
    if what == FREE:
        state.multiplicity[j] = 1 if state.recovering[j] == FLOOR else -1
        state.recovering[j] = FLIGHT
        return
    ceiling = state.mode[j] == CEILING if what == RELEASED else what == CEILING
    wall = CEILING if ceiling else FLOOR
    forceless = 1 if _forceless(model, state.z, j, wall) else 0
    if what == RELEASED:
        state.mode[j] = FLIGHT
        spring = model.wall_stiffness[j, wall - 1] * overlap(model, state.z, j, wall)
        if spring > _feigned(model, state.z, j, wall):
            state.recovering[j] = wall
            state.multiplicity[j] = forceless
        else:
            state.multiplicity[j] = -1 if ceiling else 1
        note(log, j, RELEASE, 0.0)
    else:
        closing = opening(model, state.z, j) if ceiling else -opening(model, state.z, j)
        state.mode[j] = wall
        state.recovering[j] = FLIGHT
        state.multiplicity[j] = forceless
        note(log, j, CEILING_TOUCH if ceiling else FLOOR_TOUCH, closing)
    toggle(flow, model, state, j + model.mass.shape[0] if ceiling else j)
