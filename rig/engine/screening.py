"""Proofs that guards have no zero over a step, from values and slopes at its ends.

A guard is a gap or a contact force; its zero is a contact change. The time in a step is tau, relative to its length.
The proof is by cubic Hermite interpolation: the cubic through a guard's values and slopes at both ends of the step
exceeds the error of the interpolation. This error has a bound that is proportional to the bound of the guard's fourth
derivative.

For short steps, an envelope is tested first: an upper limit of the magnitude of each state. While every state is within
its envelope, a guard that exceeds its margin at both ends of a step is positive over the step. The margins are computed
once for an envelope.
"""

from __future__ import annotations

import numpy as np

from rig.arrays import Array
from rig.engine.finite_contact import bed_gap, gap_rate, lowest_guard, overlap, wall_force, wall_force_rate
from rig.engine.flow import TERMS, Flow, Model
from rig.engine.state import FLIGHT, FLOOR, State
from rig.engine.workspace import Workspace
from rig.numerics.complementarity import ROUNDING
from rig.numerics.jit import inlined_kernel
from rig.numerics.simd import affine_product

#: Kinds of guard of a damper.
FLOOR_GAP, CEILING_GAP, CONTACT_FORCE = 1, 2, 0
#: Ratio of the bound of a fifth derivative, times the step length, to the bound of the fourth derivative.
FIFTH_DERIVATIVE_FACTOR = TERMS - 5
#: Ratio of a new envelope to the magnitudes of the state.
ENVELOPE_FACTOR = 2.0
# A factor, because divisions take longer than multiplications.
_THIRD = 1.0 / 3.0
# Largest error of the cubic Hermite interpolant, relative to the bound of the fourth derivative.
_HERMITE_ERROR = 1.0 / 384.0
# The same error after division of guard and cubic by tau^2.
_DEFLATED_HERMITE_ERROR = 1.0 / 72.0


@inlined_kernel
def _margin(value: float, slope: float, value_new: float, slope_new: float, error: float, multiplicity: int) -> float:
    """Return a lower bound that is positive only if a guard with these values and slopes has no zero on 0 < tau <= 1.

    `value`, `slope`: at the start of the step; `value_new`, `slope_new`: at its end; `error`: bound of the guard's
    fourth derivative; `multiplicity`: of its zero at tau = 0. All derivatives are with respect to tau.

    The interpolant differs from the guard by at most tau^2 (1 - tau)^2 / 24 times `error`. The Bernstein coefficients
    of the interpolant bound it from below. For a guard that starts with a zero of multiplicity 2 or more, the first two
    coefficients are zero, and tau^2 is divided out.
    """
    third_coefficient = value_new - slope_new * _THIRD
    end = value_new - error * _HERMITE_ERROR
    if multiplicity >= 2:
        return min(third_coefficient - error * _DEFLATED_HERMITE_ERROR, end)
    if not end > 0.0:
        return end
    return min(min(value, value + slope * _THIRD), third_coefficient) - error * _HERMITE_ERROR


@inlined_kernel
def _recovery_may_end(model: Model, state: State, workspace: Workspace, j: int, duration: float, error: float) -> bool:
    """Return whether a recovering bed (released, but still overlapping the wall) may touch the wall or become free.

    `duration`: of the step, s; `error`: bound of the fourth derivative of the gap with respect to tau, m.
    """
    wall, z, new = state.recovering[j], state.z, workspace.end_state
    slope, slope_new = (
        -wall_force_rate(model, z, j, wall) * duration,
        -wall_force_rate(model, new, j, wall) * duration,
    )
    stiffness, damping = model.wall_stiffness[j, wall - 1], model.wall_damping[j, wall - 1]
    force_error = (stiffness + damping * FIFTH_DERIVATIVE_FACTOR / model.step) * error
    margin = _margin(-wall_force(model, z, j, wall), slope, -wall_force(model, new, j, wall), slope_new, force_error, 0)
    if margin <= 0.0:
        return True
    signed_duration = -duration if wall == FLOOR else duration
    slope, slope_new = signed_duration * gap_rate(model, z, j), signed_duration * gap_rate(model, new, j)
    return _margin(overlap(model, z, j, wall), slope, overlap(model, new, j, wall), slope_new, error, 0) <= 0.0


@inlined_kernel
def _contact_may_change(
    model: Model, state: State, workspace: Workspace, j: int, duration: float, error: float
) -> bool:
    """Return whether a guard of a finite-duration contact is not proven free of zeros.

    `duration`: of the step, s; `error`: bound of the guard's fourth derivative with respect to tau.
    """
    mode, z, new = state.mode[j], state.z, workspace.end_state
    if mode != FLIGHT:
        slope, slope_new = (
            wall_force_rate(model, z, j, mode) * duration,
            wall_force_rate(model, new, j, mode) * duration,
        )
        return (
            _margin(wall_force(model, z, j, mode), slope, wall_force(model, new, j, mode), slope_new, error, 0) <= 0.0
        )
    if state.recovering[j] != FLIGHT:
        return _recovery_may_end(model, state, workspace, j, duration, error)
    gap, gap_new = bed_gap(model, z, j), bed_gap(model, new, j)
    slope, slope_new = gap_rate(model, z, j) * duration, gap_rate(model, new, j) * duration
    multiplicity = state.multiplicity[j]
    if _margin(gap, slope, gap_new, slope_new, error, multiplicity) <= 0.0:
        return True
    clearance = model.clearance[j]
    if clearance == np.inf:
        return False
    return _margin(clearance - gap, -slope, clearance - gap_new, -slope_new, error, -multiplicity) <= 0.0


@inlined_kernel
def screen(
    model: Model, state: State, workspace: Workspace, first_acceleration: int, length: float, duration: float
) -> tuple[int, int]:
    """Return the dampers whose guards are not proven free of zeros over the step.

    `length`, `duration`: of the step, relative to a full step and in seconds.

    Returns `unproven`: bit j is set if the gap to the floor, the contact force, or any guard of a finite-duration
    contact of damper j may have a zero; `unproven_ceilings`: the same for the gap to the ceiling.
    """
    unproven = unproven_ceilings = 0
    speed_change = model.gravity * duration
    quartic = length**4
    for j in range(model.mass.shape[0]):
        error = workspace.bound[j] * quartic
        mode = state.mode[j]
        multiplicity = 0
        if model.bed[j] >= 0:
            if _contact_may_change(model, state, workspace, j, duration, error):
                unproven |= 1 << j
            continue
        if mode == FLIGHT:
            position, velocity = model.position[j], model.velocity[j]
            value = state.height[j] - state.z[position]
            slope = (state.speed[j] - state.z[velocity]) * duration
            value_new = (
                state.height[j] + duration * (state.speed[j] - 0.5 * speed_change) - workspace.end_state[position]
            )
            slope_new = (state.speed[j] - speed_change - workspace.end_state[velocity]) * duration
            multiplicity = state.multiplicity[j]
            clearance = model.clearance[j]
            if clearance < np.inf:
                margin = _margin(clearance - value, -slope, clearance - value_new, -slope_new, error, -multiplicity)
                if margin <= 0.0:
                    unproven_ceilings |= 1 << j
        else:
            index = first_acceleration + model.position[j]
            value = model.gravity + state.z[index]
            value_new = model.gravity + workspace.end_state[index]
            slope = state.z[index + model.first_velocity] * length
            slope_new = workspace.end_state[index + model.first_velocity] * length
            if mode != FLOOR:
                value, slope, value_new, slope_new = -value, -slope, -value_new, -slope_new
        if _margin(value, slope, value_new, slope_new, error, multiplicity) <= 0.0:
            unproven |= 1 << j
    return unproven, unproven_ceilings


@inlined_kernel
def reset_envelope(flow: Flow, workspace: Workspace) -> None:
    """Set the envelope to zero, so that the next state widens it."""
    for i in range(flow.rates_constant.shape[1]):
        workspace.envelope[i] = 0.0


@inlined_kernel
def widen_envelope(flow: Flow, table_index: int, z: Array, workspace: Workspace) -> None:
    """Widen the envelope to contain a state, and compute the margins for it and the configuration."""
    columns = flow.rates_constant.shape[1]
    for i in range(columns):
        workspace.envelope[i] = max(workspace.envelope[i], ENVELOPE_FACTOR * abs(z[i]))
    affine_product(flow.margin, flow.margin_constant, table_index, workspace.envelope, columns, workspace.margin)


@inlined_kernel
def above_margins(model: Model, state: State, margin: Array, z: Array, columns: int, duration: float) -> bool:
    """Return whether every guard exceeds its margin at the state z with its accelerations.

    `columns`: number of states, after which the accelerations are stored; `duration`: time of z from now, s.
    """
    for j in range(model.mass.shape[0]):
        if model.bed[j] >= 0:
            lowest = lowest_guard(model, state, z, j)
        elif state.mode[j] == FLIGHT:
            height = state.height[j] + duration * (state.speed[j] - 0.5 * model.gravity * duration)
            gap = height - z[model.position[j]]
            lowest = min(gap, model.clearance[j] - gap) - 2 * ROUNDING * abs(height)
        else:
            lowest = model.gravity + z[columns + model.position[j]]
            if state.mode[j] != FLOOR:
                lowest = -lowest
        if not lowest > margin[j]:
            return False
    return True
