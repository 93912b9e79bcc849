"""First zero crossing of the guards within a step, located on their power series.

A guard is the gap of a damper in flight to a wall, or the contact force of a damper at rest on a wall. Only guards that
`rig.engine.screening` did not prove free of zeros are examined. `rig.numerics.bernstein.first_crossing` isolates the
crossing.

The time in a step is tau, relative to its length. The multiplicity of a guard's zero at tau = 0 is the number of
leading terms of its power series that are exactly zero (`State`: negative at the ceiling). The magnitude of a guard is
the sum of the magnitudes of its terms, to which its rounding errors are proportional.
"""

from __future__ import annotations

import numpy as np

from rig.arrays import Array
from rig.engine.finite_contact import find_crossing, first_contact_change
from rig.engine.flow import Flow, Model
from rig.engine.screening import CEILING_GAP, CONTACT_FORCE, FLOOR_GAP
from rig.engine.state import AMBIGUOUS_CROSSINGS, FLIGHT, FLOOR, State
from rig.engine.workspace import Workspace
from rig.numerics.bernstein import N_COEFFICIENTS, NO_CROSSING
from rig.numerics.jit import inlined_kernel, kernel
from rig.numerics.simd import affine_product


@inlined_kernel
def bound_by_tables(flow: Flow, table_index: int, z: Array, workspace: Workspace) -> None:
    """Compute the bounds of each guard's fourth derivative and magnitude over a full step from the state z.

    They are stored in `workspace.bound`: fourth derivatives of all dampers, then magnitudes.
    """
    for i in range(workspace.magnitude.shape[0]):
        workspace.magnitude[i] = abs(z[i])
    affine_product(
        flow.bound, flow.bound_constant, table_index, workspace.magnitude, flow.rates_constant.shape[1], workspace.bound
    )


@kernel
def bound_by_series(
    model: Model, contact: Array, state_series: Array, length: float, z: Array, end_state: Array,
    first_acceleration: int, bound: Array,
) -> None:  # fmt: skip
    """Compute the bounds of the guards over a full step from the series, and the accelerations of dampers at rest.

    `contact`: FLIGHT, FLOOR or CEILING of each damper. `state_series`: power series of the state. `length`: length of
    the step, relative to a full step. `z`, `end_state`: states at both ends of the step; the accelerations and their
    derivatives are written into both, from the index `first_acceleration` on. `bound`: filled as by `bound_by_tables`.
    """
    dampers, coordinates = model.mass.shape[0], model.first_velocity
    for j in range(dampers):
        if model.gap_coordinate[j] >= 0:
            # With an infinite bound no guard is proven free of zeros, so that its series is always examined.
            bound[j] = np.inf
            continue
        at_rest = contact[j] != FLIGHT
        row = model.velocity_index[j] if at_rest else model.position_index[j]
        index = first_acceleration + model.position_index[j]
        lost_terms = 1 if at_rest else 0  # differentiation of velocity to acceleration loses one term
        end_value = 0.0
        end_slope = 0.0
        fourth_derivative = 0.0
        magnitude = 0.0
        for k in range(N_COEFFICIENTS - 1 - lost_terms, -1, -1):
            # The acceleration's series is (k + 1) state_series[k + 1] / model.step.
            term = state_series[k + 1, row] * (k + 1) / model.step if at_rest else state_series[k, row]
            end_slope = end_slope * length + end_value
            end_value = end_value * length + term
            fourth_derivative += k * (k - 1) * (k - 2) * (k - 3) * abs(term)
            magnitude += abs(term)
            if at_rest and k <= 1:
                z[index + k * coordinates] = term
        if at_rest:
            end_state[index] = end_value
            end_state[index + coordinates] = end_slope
        bound[j] = fourth_derivative
        bound[dampers + j] = magnitude


@inlined_kernel
def _gap_series(
    model: Model, state: State, workspace: Workspace, j: int, length: float, ceiling: bool
) -> tuple[int, float]:
    """Fill `workspace.guard_series` with the gap of a damper in flight to the floor or the ceiling, m.

    Returns the multiplicity of the gap's zero at tau = 0 (negative for a zero of the gap to the other wall), and its
    magnitude.
    """
    series = workspace.guard_series
    row = model.position_index[j]
    duration = model.step * length
    power = 1.0
    for k in range(N_COEFFICIENTS):
        series[k] = -workspace.state_series[k, row] * power
        power *= length
    series[0] += state.height[j]
    series[1] += state.velocity[j] * duration
    series[2] -= 0.5 * model.gravity * duration * duration
    magnitude = abs(state.height[j]) + duration * (abs(state.velocity[j]) + model.gravity * duration)
    magnitude += workspace.bound[model.mass.shape[0] + j]
    if not ceiling:
        return state.multiplicity[j], magnitude
    for k in range(N_COEFFICIENTS):
        series[k] = -series[k]
    series[0] += model.clearance[j]
    return -state.multiplicity[j], magnitude + model.clearance[j]


@inlined_kernel
def _force_series(model: Model, state: State, workspace: Workspace, j: int, length: float) -> tuple[int, float]:
    """Fill `workspace.guard_series` with a contact force per mass, m/s^2; return the values of `_gap_series`."""
    series = workspace.guard_series
    row = model.velocity_index[j]
    sign = 1.0 if state.contact[j] == FLOOR else -1.0
    power = sign / model.step
    for k in range(N_COEFFICIENTS):
        series[k] = (k + 1) * workspace.state_series[k + 1, row] * power
        power *= length
    series[0] += sign * model.gravity
    return state.multiplicity[j], model.gravity + workspace.bound[model.mass.shape[0] + j]


@inlined_kernel
def first_event(
    model: Model, state: State, workspace: Workspace, length: float, unproven_mask: int, unproven_ceiling_mask: int
) -> tuple[float, int, int]:
    """Find the earliest event of the step among the guards that `screen` did not prove free of zeros.

    `unproven_mask`, `unproven_ceiling_mask`: see `screen`; unless both are 0, `workspace.state_series` must be filled.

    Returns the time of the event, relative to `length`, or NO_CROSSING; the damper from 0; the kind of its guard, or
    the change of its finite-duration contact.
    """
    first_tau, damper, event_guard = NO_CROSSING, -1, 0
    for j in range(model.mass.shape[0]):
        if (unproven_mask | unproven_ceiling_mask) >> j & 1 == 0:
            continue
        if model.gap_coordinate[j] >= 0:
            tau, guard, ambiguous = first_contact_change(model, state, workspace, j, length)
            state.counters[AMBIGUOUS_CROSSINGS] += ambiguous
            if tau < first_tau:
                first_tau, damper, event_guard = tau, j, guard
            continue
        for ceiling in range(2):
            if (unproven_ceiling_mask if ceiling == 1 else unproven_mask) >> j & 1 == 0:
                continue
            if state.contact[j] == FLIGHT:
                guard = CEILING_GAP if ceiling == 1 else FLOOR_GAP
                multiplicity, magnitude = _gap_series(model, state, workspace, j, length, ceiling == 1)
            else:
                guard = CONTACT_FORCE
                multiplicity, magnitude = _force_series(model, state, workspace, j, length)
            tau, ambiguous = find_crossing(workspace, max(multiplicity, 0), magnitude)
            state.counters[AMBIGUOUS_CROSSINGS] += ambiguous
            if tau < first_tau:
                first_tau, damper, event_guard = tau, j, guard
    return first_tau, damper, event_guard
