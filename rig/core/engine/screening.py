"""Proofs that signals reach no limit in a step, so that the search for events can be omitted.

A *guard* is the distance of a signal (a gap or a force) from a limit; its zero is an event. The time in a step is tau,
relative to its length. The proof is by cubic Hermite interpolation: a guard is positive if the cubic through its values
and slopes at both ends of the step exceeds the error of the interpolation. This error is at most a fixed fraction of
the bound of the guard's fourth derivative.

For short steps, a coarser test comes first. The *envelope* is an upper bound of the magnitude of each state. While
every state is within its envelope, a guard that exceeds its *margin* at both ends of a step is positive over the step.
The margins are computed once for an envelope.
"""

import numpy as np

from rig.core.base.arrays import Array
from rig.core.engine.flow import Flow
from rig.core.engine.law_tables import (
    BOUND,
    ELEMENT,
    ENTRY,
    FLIES,
    LOWER,
    OFFSET,
    ORDER,
    RATE,
    SCALE,
    UPPER,
    Signals,
)
from rig.core.engine.state import State
from rig.core.engine.workspace import Workspace
from rig.core.numerics.complementarity import ROUNDING
from rig.core.numerics.jit import inlined_kernel
from rig.core.numerics.simd import affine_product, unsigned

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
def _value_and_rate(signals: Signals, row: int, z: Array) -> tuple[float, float]:
    """Return a signal at a state with accelerations, without the height of a flying mass, and its rate of change."""
    # The first term is outside the loop, because most signals have no other.
    scale = signals.numbers[row, SCALE]
    value = signals.numbers[row, OFFSET] + scale * z[unsigned(signals.indices[row, ENTRY])]
    rate = scale * z[unsigned(signals.indices[row, RATE])]
    for term in range(1, signals.terms):
        value += signals.numbers[row, SCALE + term] * z[signals.indices[row, ENTRY + 2 * term]]
        rate += signals.numbers[row, SCALE + term] * z[signals.indices[row, RATE + 2 * term]]
    return value, rate


@inlined_kernel
def screen(gravity: float, state: State, workspace: Workspace, length: float, duration: float) -> tuple[int, int]:
    """Return the signals that may reach a limit in the step, as bit masks with a bit for each slot.

    `length`, `duration`: of the step, relative to a full step and in seconds.

    Returns `unproven_low` and `unproven_high`, for the lower and upper limits.
    """
    unproven_low = unproven_high = 0
    signals = workspace.signals
    velocity_change = gravity * duration  # of free fall, downwards
    # The bounds are for a full step, with derivatives with respect to the time relative to it.
    fourth_power = length**4
    for slot in range(signals.row.shape[0]):
        row = unsigned(signals.row[slot])
        fourth_derivative = workspace.bound[unsigned(signals.indices[row, BOUND])] * fourth_power
        value, slope = _value_and_rate(signals, row, state.z)
        value_end, slope_end = _value_and_rate(signals, row, workspace.end_state)
        # The derivatives of accelerations are with respect to the time relative to a full step.
        rate_duration = length if signals.indices[row, ORDER] > 0 else duration
        slope *= rate_duration
        slope_end *= rate_duration
        if signals.numbers[row, FLIES] > 0.0:
            j = unsigned(signals.indices[row, ELEMENT])
            value += state.height[j]
            slope += state.velocity[j] * duration
            value_end += state.height[j] + duration * (state.velocity[j] - 0.5 * velocity_change)
            slope_end += (state.velocity[j] - velocity_change) * duration
        low, high, multiplicity = signals.numbers[row, LOWER], signals.numbers[row, UPPER], state.multiplicity[slot]
        if (
            low > -np.inf
            and _lower_bound(value - low, slope, value_end - low, slope_end, fourth_derivative, multiplicity) <= 0.0
        ):
            unproven_low |= 1 << slot
        if (
            high < np.inf
            and _lower_bound(high - value, -slope, high - value_end, -slope_end, fourth_derivative, -multiplicity)
            <= 0.0
        ):
            unproven_high |= 1 << slot
    return unproven_low, unproven_high


@inlined_kernel
def reset_envelope(envelope: Array, columns: int) -> None:
    """Set the envelope of all states to zero; the next state widens it."""
    for i in range(columns):
        envelope[i] = 0.0


@inlined_kernel
def widen_envelope(flow: Flow, table_index: int, z: Array, workspace: Workspace) -> None:
    """Widen the envelope to contain a state, and compute the margins for it and the configuration."""
    columns = flow.rates_constant.shape[1]
    for i in range(columns):
        workspace.envelope[i] = max(workspace.envelope[i], ENVELOPE_FACTOR * abs(z[i]))
    affine_product(flow.margin, flow.margin_constant, table_index, workspace.envelope, columns, workspace.margin)
    signals = workspace.signals
    for slot in range(signals.row.shape[0]):
        row = unsigned(signals.row[slot])
        margin = workspace.margin[signals.indices[row, BOUND]]
        signals.lowest[slot] = signals.numbers[row, LOWER] + margin
        signals.highest[slot] = signals.numbers[row, UPPER] - margin


@inlined_kernel
def inside_margins(gravity: float, state: State, signals: Signals, z: Array, duration: float) -> bool:
    """Return whether every signal is inside its limits with margins at the state z with its accelerations.

    `duration`: time of z from now [s].
    """
    for slot in range(signals.row.shape[0]):
        row = unsigned(signals.row[slot])
        # The first term is outside the loop, because most signals have no other.
        value = signals.numbers[row, OFFSET] + signals.numbers[row, SCALE] * z[unsigned(signals.indices[row, ENTRY])]
        for term in range(1, signals.terms):
            value += signals.numbers[row, SCALE + term] * z[signals.indices[row, ENTRY + 2 * term]]
        rounding = 0.0
        if signals.numbers[row, FLIES] > 0.0:
            j = unsigned(signals.indices[row, ELEMENT])
            height = state.height[j] + duration * (state.velocity[j] - 0.5 * gravity * duration)
            value += height
            rounding = 2 * ROUNDING * abs(height)
        if not min(value - signals.lowest[slot], signals.highest[slot] - value) > rounding:
            return False
    return True
