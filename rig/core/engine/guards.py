"""First zero crossing of the guards within a step, located on their power series.

A guard is the distance of a signal from a limit (`rig.core.engine.law_tables`). Only guards that
`rig.core.engine.screening` did not prove free of zeros are examined. `rig.core.numerics.bernstein.first_crossing`
isolates the crossing.

The time in a step is tau, relative to its length. The multiplicity of a guard's zero at tau = 0 is the number of
leading terms of its power series that are exactly zero. The magnitude of a guard is the sum of the magnitudes of its
terms, to which its rounding errors are proportional.
"""

import numpy as np

from rig.core.base.arrays import Array
from rig.core.engine.flow import Flow, Model
from rig.core.engine.law_tables import (
    BOUND,
    ELEMENT,
    ENTRY,
    FLIES,
    HIGH,
    LOW,
    LOWER,
    OFFSET,
    ORDER,
    REST,
    SCALE,
    UPPER,
    Signals,
)
from rig.core.engine.state import AMBIGUOUS_CROSSINGS, State
from rig.core.engine.workspace import Workspace
from rig.core.numerics.bernstein import N_COEFFICIENTS, NO_CROSSING, first_crossing
from rig.core.numerics.complementarity import ROUNDING
from rig.core.numerics.jit import inlined_kernel, kernel
from rig.core.numerics.simd import affine_product, unsigned


@inlined_kernel
def bound_by_tables(flow: Flow, table_index: int, z: Array, workspace: Workspace) -> None:
    """Compute the bounds of each signal's fourth derivative and magnitude over a full step from the state z.

    The bounds are stored in `workspace.bound`: fourth derivatives of all signals, then magnitudes of all signals.
    """
    for i in range(workspace.magnitude.shape[0]):
        workspace.magnitude[i] = abs(z[i])
    affine_product(
        flow.bound, flow.bound_constant, table_index, workspace.magnitude, flow.rates_constant.shape[1], workspace.bound
    )


@kernel
def bound_by_series(
    model: Model, signals: Signals, state_series: Array, length: float, z: Array, end_state: Array, bound: Array
) -> None:
    """Compute the bounds of the signals over a full step from the series, and the accelerations of held masses.

    `state_series`: power series of the state. `length`: length of the step, relative to a full step. `z`, `end_state`:
    states at both ends of the step; the accelerations and their derivatives are written into both, after the states.
    `bound`: filled as by `bound_by_tables`.
    """
    coordinates, first_magnitude = model.first_velocity, bound.shape[0] // 2
    for slot in range(signals.row.shape[0]):
        row = unsigned(signals.row[slot])
        row_of_bound, index = signals.indices[row, BOUND], signals.indices[row, ENTRY]
        has_acceleration = signals.indices[row, ORDER] > 0
        if model.laws.elements[signals.indices[row, ELEMENT]].gap_coordinate >= 0 and not has_acceleration:
            # With an infinite bound no guard is proven free of zeros, so the series of every guard is examined.
            bound[row_of_bound] = np.inf
            continue
        state_row = index - model.first_acceleration + coordinates if has_acceleration else index
        lost_terms = 1 if has_acceleration else 0  # differentiation of velocity to acceleration loses one term
        end_value = 0.0
        end_slope = 0.0
        fourth_derivative = 0.0
        magnitude = 0.0
        for k in range(N_COEFFICIENTS - 1 - lost_terms, -1, -1):
            # The acceleration's series is (k + 1) state_series[k + 1] / model.step.
            term = (
                state_series[k + 1, state_row] * (k + 1) / model.step
                if has_acceleration
                else state_series[k, state_row]
            )
            end_slope = end_slope * length + end_value
            end_value = end_value * length + term
            fourth_derivative += k * (k - 1) * (k - 2) * (k - 3) * abs(term)
            magnitude += abs(term)
            if has_acceleration and k <= 1:
                z[index + k * coordinates] = term
        if has_acceleration:
            end_state[index] = end_value
            end_state[index + coordinates] = end_slope
        bound[row_of_bound] = fourth_derivative
        bound[first_magnitude + row_of_bound] = magnitude


@inlined_kernel
def _signal_series(model: Model, state: State, workspace: Workspace, slot: int, length: float) -> float:
    """Fill `workspace.guard_series` with the series of a signal; return its magnitude."""
    series, signals = workspace.guard_series, workspace.signals
    row = unsigned(signals.row[slot])
    j, bounds = unsigned(signals.indices[row, ELEMENT]), workspace.bound
    magnitude, power = abs(signals.numbers[row, OFFSET]), 1.0
    if signals.indices[row, ORDER] > 0:
        velocity = signals.indices[row, ENTRY] - model.first_acceleration + model.first_velocity
        power = signals.numbers[row, SCALE] / model.step
        for k in range(N_COEFFICIENTS):
            series[k] = (k + 1) * workspace.state_series[k + 1, velocity] * power
            power *= length
        series[0] += signals.numbers[row, OFFSET]
        magnitude += bounds[bounds.shape[0] // 2 + signals.indices[row, BOUND]]
    elif signals.numbers[row, FLIES] > 0.0:
        duration = model.step * length
        for k in range(N_COEFFICIENTS):
            series[k] = -workspace.state_series[k, signals.indices[row, ENTRY]] * power
            power *= length
        series[0] += state.height[j]
        series[1] += state.velocity[j] * duration
        series[2] -= 0.5 * model.gravity * duration * duration
        magnitude += abs(state.height[j]) + duration * (abs(state.velocity[j]) + model.gravity * duration)
        magnitude += bounds[bounds.shape[0] // 2 + signals.indices[row, BOUND]]
    else:
        for k in range(N_COEFFICIENTS):
            series[k] = 0.0
            for term in range(signals.terms):
                part = (
                    signals.numbers[row, SCALE + term]
                    * workspace.state_series[k, signals.indices[row, ENTRY + 2 * term]]
                    * power
                )
                series[k] += part
                magnitude += abs(part)
            power *= length
        series[0] -= signals.numbers[row, SCALE] * signals.numbers[row, REST]
    return magnitude


@inlined_kernel
def _guard_series(
    model: Model, state: State, workspace: Workspace, slot: int, end: int, length: float
) -> tuple[int, float]:
    """Fill `workspace.guard_series` with the distance of a signal from a limit.

    Returns the multiplicity of its zero at tau = 0 (negative for a zero at the other limit), and its magnitude.
    """
    series, signals = workspace.guard_series, workspace.signals
    row = unsigned(signals.row[slot])
    magnitude = _signal_series(model, state, workspace, slot, length)
    if end == LOW:
        series[0] -= signals.numbers[row, LOWER]
        return state.multiplicity[slot], magnitude + abs(signals.numbers[row, LOWER])
    for k in range(N_COEFFICIENTS):
        series[k] = -series[k]
    series[0] += signals.numbers[row, UPPER]
    return -state.multiplicity[slot], magnitude + abs(signals.numbers[row, UPPER])


@inlined_kernel
def first_event(
    model: Model, state: State, workspace: Workspace, length: float, unproven_low: int, unproven_high: int
) -> tuple[float, int, int]:
    """Find the earliest event of the step among the guards that `screen` did not prove free of zeros.

    `unproven_low`, `unproven_high`: see `screen`; unless both are 0, `workspace.state_series` must be filled.

    Returns the time of the event, relative to `length`, or NO_CROSSING; the slot and the end of its signal.
    """
    first_tau, first_slot, first_end = NO_CROSSING, -1, LOW
    if unproven_low | unproven_high == 0:
        return first_tau, first_slot, first_end
    for slot in range(workspace.signals.row.shape[0]):
        if (unproven_low | unproven_high) >> slot & 1 == 0:
            continue
        for end in range(2):
            if (unproven_high if end == HIGH else unproven_low) >> slot & 1 == 0:
                continue
            multiplicity, magnitude = _guard_series(model, state, workspace, slot, end, length)
            tau, ambiguous = first_crossing(
                workspace.guard_series, max(multiplicity, 0), ROUNDING * magnitude, workspace.subdivision,
                workspace.spans, workspace.bernstein,
            )  # fmt: skip
            state.counters[AMBIGUOUS_CROSSINGS] += ambiguous
            if tau < first_tau:
                first_tau, first_slot, first_end = tau, slot, end
    return first_tau, first_slot, first_end
