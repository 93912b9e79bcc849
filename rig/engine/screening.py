"""Proofs that guards have no zero over a step, so that the search for contact events can be omitted.

A guard is a gap or a contact force; its zero is a contact event. The time in a step is tau, relative to its length.
The proof is by cubic Hermite interpolation: a guard is positive if the cubic through its values and slopes at both ends
of the step exceeds the error of the interpolation. This error is at most a fixed fraction of the bound of the guard's
fourth derivative.

For short steps, a coarser test comes first. The *envelope* is an upper bound of the magnitude of each state. While
every state is within its envelope, a guard that exceeds its *margin* at both ends of a step is positive over the step.
The margins are computed once for an envelope.
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
CONTACT_FORCE, FLOOR_GAP, CEILING_GAP = 0, 1, 2
#: The fifth derivative with respect to tau is at most this multiple of the bound of the fourth. Both are sums over the
#: terms tau^k up to k = TERMS - 1; for one term the ratio at tau = 1 is k - 4, at most TERMS - 5.
FIFTH_DERIVATIVE_FACTOR = TERMS - 5
#: A new envelope is this multiple of the magnitudes of the state.
ENVELOPE_FACTOR = 2.0
# A factor, because divisions take longer than multiplications.
_THIRD = 1.0 / 3.0
# The error of the cubic Hermite interpolant, tau^2 (1 - tau)^2 / 24, is at most this fraction of the bound of the
# fourth derivative.
_HERMITE_ERROR = 1.0 / 384.0
# After division by tau^2, it is at most (1 - tau) / 24, and the cubic is 3 c_2 (1 - tau) + c_3 tau with its last two
# Bernstein coefficients c_2 and c_3. So c_2 must exceed 1/72 of the fourth derivative's bound.
_DEFLATED_HERMITE_ERROR = 1.0 / 72.0


@inlined_kernel
def _lower_bound(
    value: float, slope: float, value_end: float, slope_end: float, fourth_derivative: float, multiplicity: int
) -> float:
    """Return a bound that is positive only if a guard with these values and slopes has no zero on 0 < tau <= 1.

    `value`, `slope`: at the start of the step; `value_end`, `slope_end`: at its end; `fourth_derivative`: bound of its
    magnitude; `multiplicity`: multiplicity of the zero at tau = 0, negative for the other wall. Derivatives are by tau.

    The smallest Bernstein coefficient of the interpolant bounds it from below. If the guard starts with a zero of
    multiplicity 2 or more, the first two coefficients are zero, and guard and interpolant are divided by tau^2.
    """
    third_coefficient = value_end - slope_end * _THIRD
    end = value_end - fourth_derivative * _HERMITE_ERROR
    if multiplicity >= 2:
        return min(third_coefficient - fourth_derivative * _DEFLATED_HERMITE_ERROR, end)
    if not end > 0.0:
        return end
    return min(min(value, value + slope * _THIRD), third_coefficient) - fourth_derivative * _HERMITE_ERROR


@inlined_kernel
def _recovery_may_end(
    model: Model, state: State, workspace: Workspace, j: int, duration: float, fourth_derivative: float
) -> bool:
    """Return whether a recovering damper (released, but still overlapping the wall) may touch it or become free.

    `duration`: duration of the step, s; `fourth_derivative`: bound of the gap's fourth derivative by tau, m.
    """
    wall, z, z_end = state.recovering[j], state.z, workspace.end_state
    slope = -wall_force_rate(model, z, j, wall) * duration
    slope_end = -wall_force_rate(model, z_end, j, wall) * duration
    stiffness, damping = model.wall_stiffness[j, wall - 1], model.wall_damping[j, wall - 1]
    force_fourth_derivative = (stiffness + damping * FIFTH_DERIVATIVE_FACTOR / model.step) * fourth_derivative
    force, force_end = wall_force(model, z, j, wall), wall_force(model, z_end, j, wall)
    if _lower_bound(-force, slope, -force_end, slope_end, force_fourth_derivative, 0) <= 0.0:
        return True
    signed_duration = -duration if wall == FLOOR else duration
    slope, slope_end = signed_duration * gap_rate(model, z, j), signed_duration * gap_rate(model, z_end, j)
    start, end = overlap(model, z, j, wall), overlap(model, z_end, j, wall)
    return _lower_bound(start, slope, end, slope_end, fourth_derivative, 0) <= 0.0


@inlined_kernel
def _contact_may_change(
    model: Model, state: State, workspace: Workspace, j: int, duration: float, fourth_derivative: float
) -> bool:
    """Return whether a guard of a finite-duration contact may have a zero.

    `duration`: duration of the step, s; `fourth_derivative`: bound of the guard's fourth derivative by tau.
    """
    contact, z, z_end = state.contact[j], state.z, workspace.end_state
    if contact != FLIGHT:
        slope = wall_force_rate(model, z, j, contact) * duration
        slope_end = wall_force_rate(model, z_end, j, contact) * duration
        force, force_end = wall_force(model, z, j, contact), wall_force(model, z_end, j, contact)
        return _lower_bound(force, slope, force_end, slope_end, fourth_derivative, 0) <= 0.0
    if state.recovering[j] != FLIGHT:
        return _recovery_may_end(model, state, workspace, j, duration, fourth_derivative)
    gap, gap_end = bed_gap(model, z, j), bed_gap(model, z_end, j)
    slope, slope_end = gap_rate(model, z, j) * duration, gap_rate(model, z_end, j) * duration
    multiplicity = state.multiplicity[j]
    if _lower_bound(gap, slope, gap_end, slope_end, fourth_derivative, multiplicity) <= 0.0:
        return True
    clearance = model.clearance[j]
    if clearance == np.inf:
        return False
    return (
        _lower_bound(clearance - gap, -slope, clearance - gap_end, -slope_end, fourth_derivative, -multiplicity) <= 0.0
    )


@inlined_kernel
def screen(
    model: Model, state: State, workspace: Workspace, first_acceleration: int, length: float, duration: float
) -> tuple[int, int]:
    """Return the dampers whose guards may have a zero over the step, as bit masks.

    `length`, `duration`: of the step, relative to a full step and in seconds.

    Returns `unproven`: bit j is set if the gap to the floor, the contact force, or any guard of a finite-duration
    contact of damper j may have a zero; `unproven_ceilings`: the same for the gap to the ceiling.
    """
    unproven = unproven_ceilings = 0
    velocity_change = model.gravity * duration  # of free fall, downwards
    # The bounds are for a full step, with derivatives with respect to the time relative to it.
    fourth_power = length**4
    for j in range(model.mass.shape[0]):
        fourth_derivative = workspace.bound[j] * fourth_power
        contact = state.contact[j]
        multiplicity = 0
        if model.gap_coordinate[j] >= 0:
            if _contact_may_change(model, state, workspace, j, duration, fourth_derivative):
                unproven |= 1 << j
            continue
        if contact == FLIGHT:
            position_index, velocity_index = model.position_index[j], model.velocity_index[j]
            value = state.height[j] - state.z[position_index]
            slope = (state.velocity[j] - state.z[velocity_index]) * duration
            value_end = (
                state.height[j]
                + duration * (state.velocity[j] - 0.5 * velocity_change)
                - workspace.end_state[position_index]
            )
            slope_end = (state.velocity[j] - velocity_change - workspace.end_state[velocity_index]) * duration
            multiplicity = state.multiplicity[j]
            clearance = model.clearance[j]
            if clearance < np.inf:
                lower_bound = _lower_bound(
                    clearance - value, -slope, clearance - value_end, -slope_end, fourth_derivative, -multiplicity
                )
                if lower_bound <= 0.0:
                    unproven_ceilings |= 1 << j
        else:
            index = first_acceleration + model.position_index[j]
            value = model.gravity + state.z[index]
            value_end = model.gravity + workspace.end_state[index]
            slope = state.z[index + model.first_velocity] * length
            slope_end = workspace.end_state[index + model.first_velocity] * length
            if contact != FLOOR:
                value, slope, value_end, slope_end = -value, -slope, -value_end, -slope_end
        if _lower_bound(value, slope, value_end, slope_end, fourth_derivative, multiplicity) <= 0.0:
            unproven |= 1 << j
    return unproven, unproven_ceilings


@inlined_kernel
def reset_envelope(flow: Flow, workspace: Workspace) -> None:
    """Set the envelope to zero; the next state widens it."""
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
        if model.gap_coordinate[j] >= 0:
            lowest = lowest_guard(model, state, z, j)
        elif state.contact[j] == FLIGHT:
            height = state.height[j] + duration * (state.velocity[j] - 0.5 * model.gravity * duration)
            gap = height - z[model.position_index[j]]
            lowest = min(gap, model.clearance[j] - gap) - 2 * ROUNDING * abs(height)
        else:
            lowest = model.gravity + z[columns + model.position_index[j]]
            if state.contact[j] != FLOOR:
                lowest = -lowest
        if not lowest > margin[j]:
            return False
    return True
