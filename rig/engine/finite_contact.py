"""Finite-duration contact: floor and ceiling are springs with dashpots, without adhesion.

The *bed* is the particles of a damper, modeled as one mass. Its height above its floor, the gap g, is a coordinate.
The walls are the floor, at the height g_w = 0, and the ceiling, at g_w = clearance. While the bed overlaps a wall and
the force points away from the wall, the force on the bed is -k (g - g_w) - c g' (k stiffness, c damping of the wall).
At a contact event the force may jump, but no velocity does. Three guards detect the changes. A guard is a linear
function of the state whose zero is a contact event:

- a free bed touches a wall when the gap to it falls to zero;
- the wall releases the bed when the force falls to zero; with a dashpot this is before the overlap is zero;
- a released bed that still overlaps the wall (`recovering`) touches it again when k times overlap plus c times closing
  speed rises to zero, and is free when the overlap is zero. Becoming free changes no force and is not an event.

Function arguments: `z` is the state, `j` the number of the damper from 0, `wall` is FLOOR or CEILING. `tau` is the time
in a step relative to its length. The `multiplicity` of a guard's zero at tau = 0 is the number of leading terms of its
power series that are exactly zero.
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

#: Kinds of contact event: `FLOOR` or `CEILING` if the bed touches that wall; released by its wall; free of overlap.
RELEASED, FREE = 0, 3
#: A contact force may be a rounding error of zero up to this fraction of the forces of spring and dashpot.
MAX_ZERO_FORCE_RATIO = 1e-6
#: A contact force may be a rounding error of the gap up to this fraction of speed times sqrt(stiffness mass).
GAP_ROUNDING_RATIO = 1e-9


@inlined_kernel
def bed_gap(model: Model, z: Array, j: int) -> float:
    """Return the height of a bed above its floor, m."""
    return z[model.gap_coordinate[j]]


@inlined_kernel
def gap_rate(model: Model, z: Array, j: int) -> float:
    """Return the rate of change of the gap, m/s; positive upwards."""
    return z[model.first_velocity + model.gap_coordinate[j]]


@inlined_kernel
def overlap(model: Model, z: Array, j: int, wall: int) -> float:
    """Return the overlap of a bed and a wall, m; negative if the bed is away from the wall."""
    gap = bed_gap(model, z, j)
    return -gap if wall == FLOOR else gap - model.clearance[j]


@inlined_kernel
def wall_force(model: Model, z: Array, j: int, wall: int) -> float:
    """Return the spring and dashpot force of a wall, N; a negative value (tension) is not transmitted."""
    closing_speed = -gap_rate(model, z, j) if wall == FLOOR else gap_rate(model, z, j)
    stiffness, damping = model.wall_stiffness[j, wall - 1], model.wall_damping[j, wall - 1]
    return stiffness * overlap(model, z, j, wall) + damping * closing_speed


@inlined_kernel
def wall_force_rate(model: Model, z: Array, j: int, wall: int) -> float:
    """Return the rate of change of the wall force, N/s; `z` must contain the accelerations after the state."""
    acceleration = z[model.first_acceleration + model.gap_coordinate[j]]
    rate = model.wall_stiffness[j, wall - 1] * gap_rate(model, z, j) + model.wall_damping[j, wall - 1] * acceleration
    return -rate if wall == FLOOR else rate


@inlined_kernel
def _is_zero_force(model: Model, z: Array, j: int, wall: int) -> bool:
    """Return whether the force of a wall is zero within rounding error.

    The force is zero at every release, and at every touch without a dashpot or after recovery. An exception is a
    contact that an impact of another damper opens or closes through a full mass matrix.
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
    """Return the smallest guard of a bed at the state z: a gap, m, or a wall force, N.

    It is 0 for a recovering bed, whose guards are therefore always examined (`rig.engine.screening`).
    """
    contact = state.contact[j]
    if contact != FLIGHT:
        return wall_force(model, z, j, contact)
    if state.recovering[j] != FLIGHT:
        return 0.0
    gap = bed_gap(model, z, j)
    return min(gap, model.clearance[j] - gap)


@inlined_kernel
def _guard_series(
    model: Model, workspace: Workspace, j: int, length: float, gap_factor: float, speed_factor: float, offset: float
) -> float:
    """Fill `workspace.guard_series` with the series of the guard gap_factor (g - offset) + speed_factor g'.

    `length`: length of the step, relative to a full step. Returns the sum of the magnitudes of the terms.
    """
    series = workspace.guard_series
    gap = model.gap_coordinate[j]
    magnitude = abs(gap_factor) * offset
    power = 1.0
    for k in range(N_COEFFICIENTS):
        gap_term = gap_factor * workspace.state_series[k, gap] * power
        speed_term = speed_factor * workspace.state_series[k, model.first_velocity + gap] * power
        series[k] = gap_term + speed_term
        magnitude += abs(gap_term) + abs(speed_term)
        power *= length
    series[0] -= gap_factor * offset
    return magnitude


@inlined_kernel
def find_crossing(workspace: Workspace, multiplicity: int, magnitude: float) -> tuple[float, int]:
    """Find the first crossing of the guard in `workspace.guard_series`; return the results of `first_crossing`.

    `multiplicity`: multiplicity of the guard's zero at tau = 0; `magnitude`: sum of the magnitudes of its terms.
    """
    rounding = ROUNDING * magnitude
    subdivision, spans = workspace.subdivision, workspace.spans
    return first_crossing(workspace.guard_series, multiplicity, rounding, subdivision, spans, workspace.bernstein)


@kernel
def first_contact_change(
    model: Model, state: State, workspace: Workspace, j: int, length: float
) -> tuple[float, int, int]:
    """Find the first change of the finite-duration contact of damper j in a step.

    `length`: length of the step, relative to a full step.

    Returns (tau, change, ambiguous). `tau`: fraction of the step, or `NO_CROSSING`; `change`: kind of contact event;
    `ambiguous`: number of minima of the guards that are zero within rounding error, and are not counted as crossings.
    """
    contact, wall = state.contact[j], state.recovering[j]
    multiplicity = state.multiplicity[j]
    clearance = model.clearance[j]
    if contact == FLIGHT and wall == FLIGHT:
        # `State.multiplicity` is positive for a zero of the gap to the floor, negative for the gap to the ceiling.
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
    wall = wall if contact == FLIGHT else contact
    outward = 1.0 if wall == FLOOR else -1.0  # direction from the wall into the cavity
    # The guard of a touching bed is the wall's force; the guard of a recovering bed is the negative of this force.
    sign = outward if contact == FLIGHT else -outward
    offset = 0.0 if wall == FLOOR else clearance
    stiffness, damping = model.wall_stiffness[j, wall - 1], model.wall_damping[j, wall - 1]
    magnitude = _guard_series(model, workspace, j, length, sign * stiffness, sign * damping, offset)
    tau, ambiguous = find_crossing(workspace, max(multiplicity, 0), magnitude)
    if contact != FLIGHT:
        return tau, RELEASED, ambiguous
    change = wall
    magnitude = _guard_series(model, workspace, j, length, -outward, 0.0, offset)
    free_tau, free_ambiguous = find_crossing(workspace, 0, magnitude)
    if free_tau <= tau:
        tau, change = free_tau, FREE
    return tau, change, ambiguous + free_ambiguous


@kernel
def change_contact(flow: Flow, model: Model, state: State, log: Log, j: int, change: int) -> None:
    """Apply a contact event to damper j: the bed touches a wall, is released by a wall, or no longer overlaps it."""
    if change == FREE:
        state.multiplicity[j] = 1 if state.recovering[j] == FLOOR else -1
        state.recovering[j] = FLIGHT
        return
    ceiling = state.contact[j] == CEILING if change == RELEASED else change == CEILING
    wall = CEILING if ceiling else FLOOR
    multiplicity = 1 if _is_zero_force(model, state.z, j, wall) else 0
    if change == RELEASED:
        state.contact[j] = FLIGHT
        spring_force = model.wall_stiffness[j, wall - 1] * overlap(model, state.z, j, wall)
        if spring_force > _force_rounding(model, state.z, j, wall):
            state.recovering[j] = wall
            state.multiplicity[j] = multiplicity
        else:
            state.multiplicity[j] = -1 if ceiling else 1
        log_event(log, j, RELEASE, 0.0)
    else:
        closing_speed = gap_rate(model, state.z, j) if ceiling else -gap_rate(model, state.z, j)
        state.contact[j] = wall
        state.recovering[j] = FLIGHT
        state.multiplicity[j] = multiplicity
        log_event(log, j, CEILING_TOUCH if ceiling else FLOOR_TOUCH, closing_speed)
    # The ceiling contacts are numbered after the floor contacts.
    toggle_contact(flow, model, state, j + model.mass.shape[0] if ceiling else j)
