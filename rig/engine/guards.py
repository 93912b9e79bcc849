"""Guards over one step: proven free of zeros, or their first crossing isolated.

A guard is the gap of a damper in flight to a wall, or the contact force of a riding one. The cubic through its values
and slopes at both ends of the step is positive by more than its error, which a bound of the guard's fourth derivative
limits; otherwise its power series goes through `rig.numerics.bernstein.first_crossing`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.engine.flow import TERMS, Flow, Model
from rig.engine.lasting import examine_lasting, gap_of, lowest_guard, opening, overlap, push, push_rate
from rig.engine.power_series import expand
from rig.engine.state import AMBIGUOUS, FLIGHT, FLOOR, State
from rig.engine.workspace import Workspace
from rig.numerics.bernstein import LENGTH, NONE, first_crossing
from rig.numerics.complementarity import ROUNDING
from rig.numerics.jit import compiled, inlined
from rig.numerics.simd import combine

Array = NDArray[np.float64]

#: Guards of a damper.
FLOOR_GAP, CEILING_GAP, CONTACT_FORCE = 1, 2, 0
#: A bound of a fourth derivative from the terms of its series, times this, is one of the fifth, times a step length.
MOST_OF_NEXT = TERMS - 5


@inlined
def bound_by_tables(flow: Flow, slot: int, z: Array, workspace: Workspace) -> None:
    """Bounds of the guards over the step, from the tables."""
    for i in range(workspace.size.shape[0]):
        workspace.size[i] = abs(z[i])
    combine(
        flow.bound, flow.bound_constant, slot, workspace.size, flow.rates_constant.shape[1], workspace.bound
    )


@compiled
def bound_by_series(
    model: Model, mode: Array, tableau: Array, length: float, z: Array, new: Array, behind: int, bound: Array
) -> None:
    """Bounds of the guards over the step, and behind both states what riding dampers need, from the series itself."""
    dampers, points = model.mass.shape[0], model.first_velocity
    for j in range(dampers):
        if model.bed[j] >= 0:
            # No bound: the series itself is looked at.
            bound[j] = np.inf
            continue
        rides = mode[j] != FLIGHT
        row = model.velocity[j] if rides else model.position[j]
        place = behind + model.position[j]
        shift = 1 if rides else 0
        end = 0.0
        slope = 0.0
        fourth = 0.0
        size = 0.0
        for k in range(LENGTH - 1 - shift, -1, -1):
            # The acceleration's series is (k + 1) tableau[k + 1] / h.
            term = tableau[k + 1, row] * (k + 1) / model.step if rides else tableau[k, row]
            slope = slope * length + end
            end = end * length + term
            fourth += k * (k - 1) * (k - 2) * (k - 3) * abs(term)
            size += abs(term)
            if rides and k <= 1:
                z[place + k * points] = term
        if rides:
            new[place] = end
            new[place + points] = slope
        bound[j] = fourth
        bound[dampers + j] = size


@inlined
def _examine_flight(
    model: Model,
    state: State,
    workspace: Workspace,
    j: int,
    length: float,
    near_floor: bool,
    near_ceiling: bool,
) -> tuple[float, int, int]:
    """First wall that damper j meets in flight, of those it may: (fraction of the step, wall, ambiguous)."""
    series = workspace.series
    row = model.position[j]
    flown = model.step * length
    power = 1.0
    for k in range(LENGTH):
        series[k] = -workspace.tableau[k, row] * power
        power *= length
    series[0] += state.height[j]
    series[1] += state.speed[j] * flown
    series[2] -= 0.5 * model.gravity * flown * flown
    size = abs(state.height[j]) + flown * (abs(state.speed[j]) + model.gravity * flown)
    size += workspace.bound[model.mass.shape[0] + j]
    tau = NONE
    wall = FLOOR_GAP
    ambiguous = 0
    if near_floor:
        tau, ambiguous = first_crossing(
            series,
            max(state.multiplicity[j], 0),
            ROUNDING * size,
            workspace.work,
            workspace.spans,
            workspace.bernstein,
        )
    if near_ceiling:
        clearance = model.clearance[j]
        for k in range(LENGTH):
            series[k] = -series[k]
        series[0] += clearance
        tau_ceiling, more = first_crossing(
            series,
            max(-state.multiplicity[j], 0),
            ROUNDING * (size + clearance),
            workspace.work,
            workspace.spans,
            workspace.bernstein,
        )
        ambiguous += more
        if tau_ceiling < tau:
            tau = tau_ceiling
            wall = CEILING_GAP
    return tau, wall, ambiguous


@inlined
def _examine_ride(
    model: Model, state: State, workspace: Workspace, j: int, length: float
) -> tuple[float, int]:
    """First instant at which the contact force of damper j falls through zero: (fraction of the step, ambiguous)."""
    series = workspace.series
    row = model.velocity[j]
    sign = 1.0 if state.mode[j] == FLOOR else -1.0
    power = sign / model.step
    for k in range(LENGTH):
        series[k] = (k + 1) * workspace.tableau[k + 1, row] * power
        power *= length
    series[0] += sign * model.gravity
    size = model.gravity + workspace.bound[model.mass.shape[0] + j]
    return first_crossing(
        series,
        max(state.multiplicity[j], 0),
        ROUNDING * size,
        workspace.work,
        workspace.spans,
        workspace.bernstein,
    )


@inlined
def _margin(
    value: float, slope: float, value_new: float, slope_new: float, error: float, multiplicity: int
) -> float:
    """Positive if a guard with these values and slopes at both ends has no zero on (0, 1].

    The cubic Hermite interpolant differs from the guard by at most tau^2 (1 - tau)^2 / 24 times the bound
    `error` of its fourth derivative; its Bernstein coefficients bound it from below. A guard that starts as a
    double zero or higher has the first two coefficients zero, and tau^2 can be divided out.
    """
    inner = value_new - slope_new / 3.0
    end = value_new - error / 384.0
    if multiplicity >= 2:
        return min(inner - error / 72.0, end)
    return min(min(value, value + slope / 3.0), inner) - error / 384.0 if end > 0.0 else end


@inlined
def _may_recover(
    model: Model, state: State, workspace: Workspace, j: int, duration: float, error: float
) -> bool:
    """Whether a bed that is released within a wall may be pressed there again, or leave it, by the same test."""
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
    """Whether the guards of a contact that lasts fail the Hermite test, or are two that decide together."""
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
def first_event(
    flow: Flow,
    model: Model,
    state: State,
    workspace: Workspace,
    slot: int,
    length: float,
    duration: float,
    expanded: bool,
) -> tuple[float, int, int]:
    """Earliest event of the step over all guards that fail the Hermite test.

    Returns (fraction of `length` or NONE, damper, guard). The tableau is filled if anything is examined.
    """
    first = NONE
    which = -1
    what = 0
    behind = flow.rates_constant.shape[1]
    for j in range(model.mass.shape[0]):
        error = workspace.bound[j] * length**4
        mode = state.mode[j]
        multiplicity = 0
        near_ceiling = False
        if model.bed[j] >= 0:
            if not _may_change(model, state, workspace, j, duration, error):
                continue
            if not expanded:
                expand(flow, model, slot, state.z, workspace.tableau)
                expanded = True
            tau, guard, ambiguous = examine_lasting(model, state, workspace, j, length)
            state.counters[AMBIGUOUS] += ambiguous
            if tau < first:
                first = tau
                which = j
                what = guard
            continue
        if mode == FLIGHT:
            position, velocity = model.position[j], model.velocity[j]
            fall = model.gravity * duration
            value = state.height[j] - state.z[position]
            slope = (state.speed[j] - state.z[velocity]) * duration
            value_new = state.height[j] + duration * (state.speed[j] - 0.5 * fall) - workspace.new[position]
            slope_new = (state.speed[j] - fall - workspace.new[velocity]) * duration
            multiplicity = state.multiplicity[j]
            clearance = model.clearance[j]
            if clearance < np.inf:
                near_ceiling = (
                    _margin(
                        clearance - value, -slope, clearance - value_new, -slope_new, error, -multiplicity
                    )
                    <= 0.0
                )
        else:
            place = behind + model.position[j]
            value = model.gravity + state.z[place]
            value_new = model.gravity + workspace.new[place]
            slope = state.z[place + model.first_velocity] * length
            slope_new = workspace.new[place + model.first_velocity] * length
            if mode != FLOOR:
                value, slope, value_new, slope_new = -value, -slope, -value_new, -slope_new
        near = _margin(value, slope, value_new, slope_new, error, multiplicity) <= 0.0
        if not (near or near_ceiling):
            continue
        if not expanded:
            expand(flow, model, slot, state.z, workspace.tableau)
            expanded = True
        if mode == FLIGHT:
            tau, guard, ambiguous = _examine_flight(model, state, workspace, j, length, near, near_ceiling)
        else:
            tau, ambiguous = _examine_ride(model, state, workspace, j, length)
            guard = CONTACT_FORCE
        state.counters[AMBIGUOUS] += ambiguous
        if tau < first:
            first = tau
            which = j
            what = guard
    return first, which, what


#: An envelope is drawn this much wider than the state is large.
WIDER = 2.0


@inlined
def fold_envelope(flow: Flow, workspace: Workspace) -> None:
    """Begin the envelope anew."""
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
