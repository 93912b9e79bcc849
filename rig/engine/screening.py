"""Proofs that guards have no zero over a step, from values and slopes at its ends.

The cubic through a guard's values and slopes at both ends of the step is positive by more than its error, which a bound
of the guard's fourth derivative limits (Hermite interpolation). For short steps an envelope of the state comes first:
while the state stays inside, margins that were computed once prove every guard positive.
"""

from __future__ import annotations

import numpy as np

from rig.arrays import Array
from rig.engine.flow import TERMS, Flow, Model
from rig.engine.lasting import gap_of, lowest_guard, opening, overlap, push, push_rate
from rig.engine.state import FLIGHT, FLOOR, State
from rig.engine.workspace import Workspace
from rig.numerics.complementarity import ROUNDING
from rig.numerics.jit import inlined
from rig.numerics.simd import combine

#: Guards of a damper.
FLOOR_GAP, CEILING_GAP, CONTACT_FORCE = 1, 2, 0
#: A bound of a fourth derivative from the terms of its series, times this, is a bound of the fifth, times a step.
MOST_OF_NEXT = TERMS - 5
#: An envelope is drawn this much wider than the state is large.
WIDER = 2.0
# Divisions take longer than multiplications.
_THIRD = 1.0 / 3.0
# Error of the cubic Hermite interpolant, times the bound of the fourth derivative: at its largest, and what is left of
# it after tau^2 is divided out.
_ERROR = 1.0 / 384.0
_ERROR_DEFLATED = 1.0 / 72.0


@inlined
def _margin(
    value: float, slope: float, value_new: float, slope_new: float, error: float, multiplicity: int
) -> float:
    """Positive if a guard with these values and slopes at both ends has no zero on (0, 1].

    The interpolant differs from the guard by at most tau^2 (1 - tau)^2 / 24 times the bound `error` of its fourth
    derivative; its Bernstein coefficients bound it from below. A guard that starts as a double zero or higher has the
    first two coefficients zero, and tau^2 can be divided out.
    """
    inner = value_new - slope_new * _THIRD
    end = value_new - error * _ERROR
    if multiplicity >= 2:
        return min(inner - error * _ERROR_DEFLATED, end)
    return min(min(value, value + slope * _THIRD), inner) - error * _ERROR if end > 0.0 else end


@inlined
def _may_recover(
    model: Model, state: State, workspace: Workspace, j: int, duration: float, error: float
) -> bool:
    """Whether a bed that is released within a wall may be pressed there again, or leave it."""
    wall, z, new = state.recovering[j], state.z, workspace.new
    slope, slope_new = -push_rate(model, z, j, wall) * duration, -push_rate(model, new, j, wall) * duration
    stiffness, damping = model.wall_stiffness[j, wall - 1], model.wall_damping[j, wall - 1]
    error_of_push = (stiffness + damping * MOST_OF_NEXT / model.step) * error
    margin = _margin(-push(model, z, j, wall), slope, -push(model, new, j, wall), slope_new, error_of_push, 0)
    if margin <= 0.0:
        return True
    sinks = -duration if wall == FLOOR else duration
    slope, slope_new = sinks * opening(model, z, j), sinks * opening(model, new, j)
    return (
        _margin(overlap(model, z, j, wall), slope, overlap(model, new, j, wall), slope_new, error, 0) <= 0.0
    )


@inlined
def _may_change(
    model: Model, state: State, workspace: Workspace, j: int, duration: float, error: float
) -> bool:
    """Whether the guards of a finite-duration contact are not proven, or are two that decide together."""
    mode, z, new = state.mode[j], state.z, workspace.new
    if mode != FLIGHT:
        slope, slope_new = push_rate(model, z, j, mode) * duration, push_rate(model, new, j, mode) * duration
        return _margin(push(model, z, j, mode), slope, push(model, new, j, mode), slope_new, error, 0) <= 0.0
    if state.recovering[j] != FLIGHT:
        return _may_recover(model, state, workspace, j, duration, error)
    gap, gap_new = gap_of(model, z, j), gap_of(model, new, j)
    slope, slope_new = opening(model, z, j) * duration, opening(model, new, j) * duration
    multiplicity = state.multiplicity[j]
    if _margin(gap, slope, gap_new, slope_new, error, multiplicity) <= 0.0:
        return True
    clearance = model.clearance[j]
    if clearance == np.inf:
        return False
    return _margin(clearance - gap, -slope, clearance - gap_new, -slope_new, error, -multiplicity) <= 0.0


@inlined
def screen(
    model: Model, state: State, workspace: Workspace, behind: int, length: float, duration: float
) -> tuple[int, int]:
    """Dampers whose guards are not proven free of zeros over the step.

    Returns `near, ceilings`, bit j is set where the floor's gap or the contact force of damper j, or any guard of a
    finite-duration contact, may have a zero; and where the ceiling's gap may.
    """
    near = ceilings = 0
    fall = model.gravity * duration
    quartic = length**4
    for j in range(model.mass.shape[0]):
        error = workspace.bound[j] * quartic
        mode = state.mode[j]
        multiplicity = 0
        if model.bed[j] >= 0:
            if _may_change(model, state, workspace, j, duration, error):
                near |= 1 << j
            continue
        if mode == FLIGHT:
            position, velocity = model.position[j], model.velocity[j]
            value = state.height[j] - state.z[position]
            slope = (state.speed[j] - state.z[velocity]) * duration
            value_new = state.height[j] + duration * (state.speed[j] - 0.5 * fall) - workspace.new[position]
            slope_new = (state.speed[j] - fall - workspace.new[velocity]) * duration
            multiplicity = state.multiplicity[j]
            clearance = model.clearance[j]
            if clearance < np.inf:
                margin = _margin(
                    clearance - value, -slope, clearance - value_new, -slope_new, error, -multiplicity
                )
                if margin <= 0.0:
                    ceilings |= 1 << j
        else:
            place = behind + model.position[j]
            value = model.gravity + state.z[place]
            value_new = model.gravity + workspace.new[place]
            slope = state.z[place + model.first_velocity] * length
            slope_new = workspace.new[place + model.first_velocity] * length
            if mode != FLOOR:
                value, slope, value_new, slope_new = -value, -slope, -value_new, -slope_new
        if _margin(value, slope, value_new, slope_new, error, multiplicity) <= 0.0:
            near |= 1 << j
    return near, ceilings


@inlined
def fold_envelope(flow: Flow, workspace: Workspace) -> None:
    """Restart the envelope."""
    for i in range(flow.rates_constant.shape[1]):
        workspace.envelope[i] = 0.0


@inlined
def draw_envelope(flow: Flow, slot: int, z: Array, workspace: Workspace) -> None:
    """Widen the envelope around a state, and fit the margins to it and to the configuration."""
    columns = flow.rates_constant.shape[1]
    for i in range(columns):
        workspace.envelope[i] = max(workspace.envelope[i], WIDER * abs(z[i]))
    combine(flow.margin, flow.margin_constant, slot, workspace.envelope, columns, workspace.margin)


@inlined
def above_margins(model: Model, state: State, margin: Array, z: Array, columns: int, duration: float) -> bool:
    """Whether every guard lies above its margin at a state with its accelerations, `duration` from now."""
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
