"""Finite-duration contact: floor and ceiling are spring-dampers without adhesion.

The *bed* is the particles of a damper, modeled as one mass. Its height above its floor, the gap g, is a coordinate.
While the bed overlaps a wall at the height o and the force points away from the wall, the force on the bed is
-k (g - o) - c g' (k stiffness, c damping of the wall). At a contact change the force may jump, but no velocity does.
Three guards, which are linear in the state, detect the changes:

- a free bed touches a wall when the gap to it falls to zero;
- the wall releases the bed when the force falls to zero; with a dashpot this is before the overlap is zero;
- a released bed that still overlaps the wall (`recovering`) is touched again if the force law rises to zero, and is
  free when the overlap is zero. Becoming free changes no force and is not an event.

Function arguments: `z` is the state, `j` the number of the damper from 0, `wall` is FLOOR or CEILING.
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
    log_event,
    toggle_contact,
)
from rig.engine.workspace import Workspace
from rig.numerics.bernstein import N_COEFFICIENTS, first_crossing
from rig.numerics.complementarity import ROUNDING
from rig.numerics.jit import inlined_kernel, kernel

#: Kinds of changes, in addition to `FLOOR` and `CEILING`, which are the wall that a bed touches.
RELEASED, FREE = 0, 3
#: Largest force, relative to the forces of spring and dashpot, that may be a rounding error of their sum.
MAX_ZERO_FORCE_RATIO = 1e-6
#: Largest force, relative to speed times sqrt(stiffness mass), that may be a rounding error of the gap.
GAP_ROUNDING_RATIO = 1e-9


@inlined_kernel
def bed_gap(model: Model, z: Array, j: int) -> float:
    """Return the height of a bed above its floor, m."""
    return z[model.bed[j]]


@inlined_kernel
def gap_rate(model: Model, z: Array, j: int) -> float:
    """Return the rate of the gap, m/s."""
    return z[model.first_velocity + model.bed[j]]


@inlined_kernel
def overlap(model: Model, z: Array, j: int, wall: int) -> float:
    """Return the overlap of a bed and a wall, m; negative without contact."""
    gap = bed_gap(model, z, j)
    return -gap if wall == FLOOR else gap - model.clearance[j]


@inlined_kernel
def wall_force(model: Model, z: Array, j: int, wall: int) -> float:
    """Return the force law of a wall, N; negative where the force would be tensile."""
    closing_speed = -gap_rate(model, z, j) if wall == FLOOR else gap_rate(model, z, j)
    stiffness, damping = model.wall_stiffness[j, wall - 1], model.wall_damping[j, wall - 1]
    return stiffness * overlap(model, z, j, wall) + damping * closing_speed


@inlined_kernel
def wall_force_rate(model: Model, z: Array, j: int, wall: int) -> float:
    """Return the rate of the wall force, N/s; `z` must contain the accelerations after the state."""
    acceleration = z[model.first_acceleration + model.bed[j]]
    rate = model.wall_stiffness[j, wall - 1] * gap_rate(model, z, j) + model.wall_damping[j, wall - 1] * acceleration
    return -rate if wall == FLOOR else rate


@inlined_kernel
def _is_zero_force(model: Model, z: Array, j: int, wall: int) -> bool:
    """Return whether the force of a wall is zero within rounding.

    The force is zero at every touch and release, except where an impact of another damper opens or closes the contact
    through a full mass matrix. Without a dashpot, the force is the rounding error of the overlap times the stiffness.
    """
    spring_force = model.wall_stiffness[j, wall - 1] * abs(overlap(model, z, j, wall))
    dashpot_force = model.wall_damping[j, wall - 1] * abs(gap_rate(model, z, j))
    return abs(wall_force(model, z, j, wall)) <= MAX_ZERO_FORCE_RATIO * (
        spring_force + dashpot_force
    ) + _force_rounding(model, z, j, wall)


@inlined_kernel
def _force_rounding(model: Model, z: Array, j: int, wall: int) -> float:
    """Return the largest force that is a rounding error of the gap, N."""
    return (
        GAP_ROUNDING_RATIO * abs(gap_rate(model, z, j)) * math.sqrt(model.wall_stiffness[j, wall - 1] * model.mass[j])
    )


@inlined_kernel
def lowest_guard(model: Model, state: State, z: Array, j: int) -> float:
    """Return the smallest guard of a bed at a state: a gap, m, or a wall force, N; 0 for a recovering bed."""
    mode = state.mode[j]
    if mode != FLIGHT:
        return wall_force(model, z, j, mode)
    if state.recovering[j] != FLIGHT:
        return 0.0
    gap = bed_gap(model, z, j)
    return min(gap, model.clearance[j] - gap)


@inlined_kernel
def _guard_series(
    model: Model, workspace: Workspace, j: int, length: float, gap_factor: float, speed_factor: float, offset: float
) -> float:
    """Fill the series of the guard gap_factor (g - offset) + speed_factor g'; return the magnitude of its terms.

    `length`: duration relative to a full step.
    """
    series = workspace.guard_series
    bed = model.bed[j]
    magnitude = abs(gap_factor) * offset
    power = 1.0
    for k in range(N_COEFFICIENTS):
        gap_term = gap_factor * workspace.state_series[k, bed] * power
        speed_term = speed_factor * workspace.state_series[k, model.first_velocity + bed] * power
        series[k] = gap_term + speed_term
        magnitude += abs(gap_term) + abs(speed_term)
        power *= length
    series[0] -= gap_factor * offset
    return magnitude


@inlined_kernel
def find_crossing(workspace: Workspace, multiplicity: int, magnitude: float) -> tuple[float, int]:
    """Find the first crossing of the guard in `workspace.guard_series`; return as `first_crossing`.

    `multiplicity`: of its zero at tau = 0; `magnitude`: sum of the magnitudes of its terms.
    """
    rounding = ROUNDING * magnitude
    subdivision, spans = workspace.subdivision, workspace.spans
    return first_crossing(workspace.guard_series, multiplicity, rounding, subdivision, spans, workspace.bernstein)


@kernel
def first_contact_change(
    model: Model, state: State, workspace: Workspace, j: int, length: float
) -> tuple[float, int, int]:
    """Find the first change of a finite-duration contact in a step of a length, relative to a full step.

    Returns (fraction of the step, kind of change, number of ambiguous dips) as `first_crossing`.
    """
    mode, wall = state.mode[j], state.recovering[j]
    multiplicity = state.multiplicity[j]
    clearance = model.clearance[j]
    if mode == FLIGHT and wall == FLIGHT:
        magnitude = _guard_series(model, workspace, j, length, 1.0, 0.0, 0.0)
        tau, ambiguous = find_crossing(workspace, max(multiplicity, 0), magnitude)
        change = FLOOR
        if clearance < np.inf:
            magnitude = _guard_series(model, workspace, j, length, -1.0, 0.0, clearance)
            ceiling_tau, ceiling_ambiguous = find_crossing(workspace, max(-multiplicity, 0), magnitude)
            ambiguous += ceiling_ambiguous
            if ceiling_tau < tau:
                tau, change = ceiling_tau, CEILING
        return tau, change, ambiguous
    wall = wall if mode == FLIGHT else mode
    outward = 1.0 if wall == FLOOR else -1.0
    # The guard of a touching bed is the wall's force, that of a recovering bed its negative.
    sign = outward if mode == FLIGHT else -outward
    offset = 0.0 if wall == FLOOR else clearance
    stiffness, damping = model.wall_stiffness[j, wall - 1], model.wall_damping[j, wall - 1]
    magnitude = _guard_series(model, workspace, j, length, sign * stiffness, sign * damping, offset)
    tau, ambiguous = find_crossing(workspace, max(multiplicity, 0), magnitude)
    if mode != FLIGHT:
        return tau, RELEASED, ambiguous
    change = wall
    magnitude = _guard_series(model, workspace, j, length, -outward, 0.0, offset)
    free_tau, free_ambiguous = find_crossing(workspace, 0, magnitude)
    if free_tau <= tau:
        tau, change = free_tau, FREE
    return tau, change, ambiguous + free_ambiguous


@kernel
def change_contact(flow: Flow, model: Model, state: State, log: Log, j: int, change: int) -> None:
    """Apply a change to damper j: it touches a wall, is released by it, or becomes free of it."""
    if change == FREE:
        state.multiplicity[j] = 1 if state.recovering[j] == FLOOR else -1
        state.recovering[j] = FLIGHT
        return
    ceiling = state.mode[j] == CEILING if change == RELEASED else change == CEILING
    wall = CEILING if ceiling else FLOOR
    multiplicity = 1 if _is_zero_force(model, state.z, j, wall) else 0
    if change == RELEASED:
        state.mode[j] = FLIGHT
        spring_force = model.wall_stiffness[j, wall - 1] * overlap(model, state.z, j, wall)
        if spring_force > _force_rounding(model, state.z, j, wall):
            state.recovering[j] = wall
            state.multiplicity[j] = multiplicity
        else:
            state.multiplicity[j] = -1 if ceiling else 1
        log_event(log, j, RELEASE, 0.0)
    else:
        closing_speed = gap_rate(model, state.z, j) if ceiling else -gap_rate(model, state.z, j)
        state.mode[j] = wall
        state.recovering[j] = FLIGHT
        state.multiplicity[j] = multiplicity
        log_event(log, j, CEILING_TOUCH if ceiling else FLOOR_TOUCH, closing_speed)
    toggle_contact(flow, model, state, j + model.mass.shape[0] if ceiling else j)
