"""Overload of a sensor and of integrators: voltage limits that act on the continuous signal.

A shock in an accelerometer lasts microseconds, much less than the sample interval of a slow converter. A limit of the
samples alone would miss this shock. Therefore the limited voltages are checked many times per period of the fastest
pole of the circuit, at any sample rate. If a voltage may reach a limit in an interval, the circuit is propagated
through this interval in steps. Each step uses the exact transition of the linear circuit.

The state of an integrator is limited to the *rails*, the largest voltages of its amplifier. The *excess* is the part of
the output of the sensor above the limit. In each step, the excess is subtracted as a linear function of time.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from daq.core.dsp.circuit import RECOVERY, Circuit, Section
from daq.core.dsp.discretization import (
    DiscreteCircuit,
    Entry,
    extend_by_disturbances,
    generator_matrix,
    input_first,
    transpose_and_pad,
)
from daq.core.dsp.interpolation import IMPULSE, LENGTH, CubicInput, copy_into
from daq.core.dsp.segment_propagation import SegmentWorkspace, convert_integrals, load_segment, propagate_fraction
from rig.core.base.arrays import Array
from rig.core.numerics.fma import weighted_sums
from rig.core.numerics.jit import unfused_kernel
from rig.core.numerics.simd import aligned_zeros, copy, multiply, padded_length

# Voltages are checked this many times per period of the fastest pole of the circuit. Between two checks, a sine exceeds
# the checked values by at most 2 %.
CHECKS_PER_PERIOD = 16
# Voltages are checked at least this many times in an interval.
MIN_CHECKS = 8
# Indices of the two step sizes. Coarse steps are sufficient for an integrator; a sensor requires fine steps.
COARSE = 0
FINE = 1
# Number of coarse steps and of fine steps per period of the fastest pole of the circuit.
STEPS_PER_PERIOD = (32, 128)
# Minimum number of coarse steps and of fine steps in an interval.
MIN_STEPS = (8, 32)
# If a voltage is below this fraction of the limit at all checks, the voltage is below the limit between the checks.
NEAR_LIMIT = float(np.cos(np.pi / CHECKS_PER_PERIOD))
# An impulse is an overload if it is at least the limit times this duration, s. Smaller impulses are rounding errors.
MIN_IMPULSE_S = 1e-9


class Limits(NamedTuple):
    """Matrices that detect intervals in which a limit may be reached, and propagate the circuit through them.

    The *propagated vector* (`daq.core.dsp.discretization`) has the length `size`. It consists of `width` states and
    integrals of the output, and of four derivatives of the input. A first dimension of 2 means coarse and fine steps. A
    disturbance (noise or an offset) of degree 0 is constant over an interval.
    """

    # Each limited voltage at each check in an interval is a weighted sum of input, disturbances and states, in the
    # order of `DiscreteCircuit.state_weights`. These are the weights; (checks, 4 + disturbances + states).
    check_weights: Array
    check_limits: Array  # no limit is reached if the magnitudes of these voltages are below these values [V]; (checks,)
    # If the sum of these weights times the magnitudes of input, disturbances and states is below 1, no check reaches a
    # limit; (4 + disturbances + states,).
    bound_weights: Array
    step_counts: NDArray[np.int64]  # number of steps in an interval; (2,)
    # Transition of the propagated vector over a step, stored like `coarse_exponentials`; (2, size, padded size).
    step_transitions: Array
    # Change of the propagated vector over a step if a constant disturbance is 1 V; zero for disturbances that are not
    # constant; (2, disturbances, width).
    constant_disturbance_response: Array
    # Change of states and moments over an interval if a disturbance that is not constant is 1 V; zero for constant
    # disturbances; (disturbances, width).
    polynomial_disturbance_response: Array
    output_limit: float  # largest magnitude of the output of the sensor [V]
    output_weights: Array  # weights of the propagated vector in the output of the sensor; (size,)
    # Change of the propagated vector over a step if the excess falls linearly from 1 V to 0 (index 0), or rises
    # linearly from 0 to 1 V (index 1); (2, 2, width).
    excess_contributions: Array
    # The excess shifts the zero of the sensor during a step. This factor corrects the excess at the end of the step for
    # the shift; (2,).
    shift_feedback: Array
    limited_impulse_response: Array  # jump of the propagated vector due to a unit impulse over the limit; (width,)
    # Smallest impulse that exceeds the limit, in the unit of `CubicInput`. Without a direct feedthrough, the output of
    # the sensor contains no impulse, and this value is infinite.
    min_impulse: float
    shift_state: int  # index of the state of the zero shift after an overload; -1 without a zero shift
    rails: Array  # largest magnitude of each state [V]; (states,)
    # Change of the propagated vector over a step due to a constant input that adds 1 V to a state; (2, states, width).
    rail_contributions: Array


def tabulate_limits(
    sections: Sequence[Section],
    sensor_sections: int,
    output_limit: float | None,
    rails: Array,
    gain: float,
    rate: float,
    entries: Sequence[Entry],
    discrete: DiscreteCircuit,
) -> Limits | None:
    """Return the matrices for the limits of a circuit; None if it has no limit.

    `sensor_sections`: the first `sensor_sections` sections are the sensor; `output_limit`: largest magnitude of the
    output of the sensor [V]; `rails`: largest magnitude of each state [V], (states,); `gain`: V per unit of the input;
    `rate`: sample rate [Hz]; `entries`: sections at which the disturbances enter.
    """
    if output_limit is None and not np.isfinite(rails).any():
        return None
    integrals = discrete.integrals
    circuit, sensor = Circuit.series(sections), Circuit.series(sections[:sensor_sections])
    generator = generator_matrix(circuit, gain, rate, integrals)
    states, size = circuit.c.size, len(generator)
    width = size - 4
    if output_limit is None:
        output_limit = np.inf
    output_weights = aligned_zeros(padded_length(size))
    output_weights[: sensor.c.size], output_weights[width] = sensor.c, sensor.d[0] * gain
    # Frequency of the fastest pole, in periods per sample interval.
    fastest = float(np.abs(np.linalg.eigvals(circuit.a)).max(initial=0.0)) / (2 * np.pi * rate)
    checks = max(MIN_CHECKS, int(np.ceil(CHECKS_PER_PERIOD * fastest)))
    step_counts = np.array(
        [max(least, int(np.ceil(count * fastest))) for count, least in zip(STEPS_PER_PERIOD, MIN_STEPS, strict=True)]
    )

    # The excess is subtracted after the last section of the sensor. The excess also drives the zero shift.
    excess_input = np.zeros(width)
    excess_input[:states] = -circuit.b[sensor_sections] / rate
    if integrals:
        excess_input[states] = -circuit.d[sensor_sections]
    shift_state = -1
    for section, first in zip(sections[:sensor_sections], circuit.sections, strict=False):
        if section.name == RECOVERY:
            shift_state = first
            excess_input[shift_state] = -section.a[0, 0] / rate
    excess_contributions = np.array([_ramp_contributions(generator, excess_input, steps) for steps in step_counts])
    extended, start = extend_by_disturbances(generator, circuit, rate, discrete.integrals, entries)
    constant_response = np.array([(expm(extended / steps) @ start)[:width, states + 4 :].T for steps in step_counts])
    is_constant = np.array([entry.degree == 0 for entry in entries], dtype=bool)
    constant_response[:, ~is_constant] = 0.0
    polynomial_response = discrete.transition[states + 4 :].copy()
    polynomial_response[is_constant] = 0.0
    feedthrough = output_weights[width]
    # Limited voltages (output of the sensor, and states) as rows of weights of the extended vector, and their limits.
    limited = [(np.concatenate([output_weights[:size], np.zeros(len(extended) - size)]), output_limit)]
    limited += [(np.eye(len(extended))[state], rails[state]) for state in range(states)]
    limited = [(row, limit) for row, limit in limited if np.isfinite(limit)]
    check_weights, check_limits = _check_rows(limited, extended, start, states, checks)
    return Limits(
        check_weights=check_weights,
        check_limits=check_limits,
        # The factor exceeds all rounding errors, so that the sum remains an upper bound.
        bound_weights=np.abs(check_weights / check_limits[:, None]).max(axis=0) * (1.0 + 1e-9),
        step_counts=step_counts,
        step_transitions=transpose_and_pad(np.array([expm(generator / steps) for steps in step_counts])),
        constant_disturbance_response=np.ascontiguousarray(constant_response),
        polynomial_disturbance_response=polynomial_response,
        output_limit=output_limit,
        output_weights=output_weights,
        excess_contributions=excess_contributions,
        shift_feedback=1.0 / (1.0 - excess_contributions[:, 1] @ output_weights[:width]),
        limited_impulse_response=generator[:width, width] + feedthrough * excess_input,
        min_impulse=float(output_limit * MIN_IMPULSE_S * rate / abs(feedthrough)) if feedthrough else np.inf,
        shift_state=shift_state,
        rails=rails,
        rail_contributions=np.array([_rail_contributions(generator, states, steps) for steps in step_counts]),
    )


def _ramp_contributions(generator: Array, excess_input: Array, steps: int) -> Array:
    """Return `Limits.excess_contributions` for one step size; `steps`: number of steps in an interval."""
    size, width = len(generator), excess_input.size
    ramp = np.zeros((size + 2, size + 2))
    ramp[:size, :size] = generator
    ramp[:width, size], ramp[size, size + 1] = excess_input, 1.0
    ramp = expm(ramp / steps)
    rising = ramp[:width, size + 1] * steps
    return np.array([ramp[:width, size] - rising, rising])


def _rail_contributions(generator: Array, states: int, steps: int) -> Array:
    """Return `Limits.rail_contributions` for one step size; (states, width).

    `states`: number of states; `steps`: number of steps in an interval.
    """
    size = len(generator)
    inputs = np.zeros((size + states, size + states))
    inputs[:size, :size], inputs[:states, size:] = generator, np.eye(states)
    contributions = expm(inputs / steps)[: size - 4, size:].T
    return np.asarray(contributions / np.diagonal(contributions)[:, None])


def _check_rows(
    limited: Sequence[tuple[Array, float]], extended: Array, start: Array, states: int, checks: int
) -> tuple[Array, Array]:
    """Return `Limits.check_weights` and `Limits.check_limits`.

    `limited`: for each limited voltage, the weights of the extended vector, and the limit; `extended`, `start`: from
    `extend_by_disturbances`; `checks`: number of checks in an interval.
    """
    transition = expm(extended / checks)
    weights = np.zeros((len(limited) * checks, start.shape[1]))
    limits = np.zeros(len(weights))
    for number, (row, limit) in enumerate(limited):
        for check in range(checks):
            row = row @ transition
            weights[number * checks + check] = row @ start
        limits[number * checks : (number + 1) * checks] = limit * NEAR_LIMIT
    return np.ascontiguousarray(input_first(weights, states)), limits


@unfused_kernel
def count_within_limits(limits: Limits, sources: Array, magnitudes: Array, sums: Array, count: int) -> int:
    """Return the number of intervals before the first in which a limit may be reached, at most `count`.

    `sources`: input, disturbances and states at the start of each interval; `magnitudes`, `sums`: working arrays.
    """
    for r in range(sources.shape[0]):
        for k in range(count):
            magnitudes[r, k] = abs(sources[r, k])
    weighted_sums(magnitudes, 0, 0, limits.bound_weights, sources.shape[0], sums, count)
    if not _exceeds(sums[:count], 1.0):
        return count
    for check in range(limits.check_limits.size):
        weighted_sums(sources, 0, 0, limits.check_weights[check], sources.shape[0], sums, count)
        if _exceeds(sums[:count], limits.check_limits[check]):
            for k in range(count):
                if abs(sums[k]) > limits.check_limits[check]:
                    count = k
                    break
    return count


@unfused_kernel
def _exceeds(values: Array, limit: float) -> bool:
    """Return whether any magnitude exceeds a limit; without a branch in the loop, the compiler vectorizes the loop."""
    count = 0
    for k in range(values.size):
        count += abs(values[k]) > limit
    return count > 0


@unfused_kernel
def propagate_with_limits(
    cubics: CubicInput,
    segment: int,
    interval: int,
    discrete: DiscreteCircuit,
    limits: Limits,
    state: Array,
    disturbances: Array,
    overload: Array,
    workspace: SegmentWorkspace,
) -> tuple[int, float]:
    """Propagate the circuit over an interval in steps; return the index of the next segment and the final excess [V].

    `segment`: index of the first segment that is not yet used; `interval`: index of the interval in the block.
    Afterwards, `workspace.vector` contains the moments. `overload` then contains the severity of the overload in the
    interval (see `daq.core.dsp.propagation.propagate`).
    """
    next_segment, excess, is_near_limit, is_limited = _propagate_in_steps(
        COARSE, cubics, segment, interval, discrete, limits, state, disturbances, workspace
    )
    if is_near_limit:
        next_segment, excess, is_near_limit, is_limited = _propagate_in_steps(
            FINE, cubics, segment, interval, discrete, limits, state, disturbances, workspace
        )
    vector = workspace.vector
    convert_integrals(discrete, vector, workspace.work)
    for e in range(disturbances.shape[0]):
        for r in range(discrete.width):
            vector[r] += limits.polynomial_disturbance_response[e, r] * disturbances[e, interval]
    for j in range(discrete.states):
        state[j] = min(max(vector[j], -limits.rails[j]), limits.rails[j])
    if is_limited:
        overload[1 + interval] = 1.0
        if limits.shift_state >= 0:
            overload[1 + interval] += abs(state[limits.shift_state]) / limits.output_limit
    return next_segment, excess


@unfused_kernel
def _propagate_in_steps(
    step_size: int,  # COARSE or FINE
    cubics: CubicInput,
    segment: int,
    interval: int,
    discrete: DiscreteCircuit,
    limits: Limits,
    state: Array,
    disturbances: Array,
    workspace: SegmentWorkspace,
) -> tuple[int, float, bool, bool]:
    """Propagate the circuit over an interval in coarse or fine steps.

    Return the index of the next segment, the final excess, whether the output of the sensor came near the limit, and
    whether any limit was reached.
    """
    vector, current = workspace.vector, workspace.segment
    steps = limits.step_counts[step_size]
    _start_interval(limits, step_size, state, disturbances[:, interval], vector, workspace.constant_response)
    # Number of completed steps, and position in the interval (from 0 to 1).
    step, position = 0, 0.0
    excess, is_near_limit, is_limited, has_more = 0.0, False, False, True
    while has_more:
        has_more = _copy_segment(cubics, segment, interval, current)
        segment += segment < cubics.segment_interval.size and cubics.segment_interval[segment] == interval
        end = position + current[LENGTH] if has_more else 1.0
        vector[discrete.width :] = 0.0
        if current[LENGTH] > 0.0:
            load_segment(discrete, current, vector)
        if step == 0:
            is_near_limit |= abs(_sensor_output(limits, vector)) > limits.output_limit * NEAR_LIMIT
            excess = _excess(limits, vector)
        while step < steps and (step + 1) / steps <= end:
            if position == step / steps:
                multiply(limits.step_transitions, step_size, vector, workspace.zeros, workspace.term)
                copy(workspace.term, vector)
            else:
                propagate_fraction(discrete, (step + 1) / steps - position, workspace)
            step += 1
            position = step / steps
            for r in range(discrete.width):
                vector[r] += excess * limits.excess_contributions[step_size, 0, r] + workspace.constant_response[r]
            is_near_limit |= abs(_sensor_output(limits, vector)) > limits.output_limit * NEAR_LIMIT
            excess = limits.shift_feedback[step_size] * _excess(limits, vector)
            if excess != 0.0:
                for r in range(discrete.width):
                    vector[r] += excess * limits.excess_contributions[step_size, 1, r]
                is_limited = True
            is_limited |= _clip_states(limits, step_size, vector)
        if end > position:
            propagate_fraction(discrete, end - position, workspace)
            position = end
        is_impulse_limited = abs(current[IMPULSE]) > limits.min_impulse
        is_limited |= is_impulse_limited
        impulse_response = limits.limited_impulse_response if is_impulse_limited else discrete.impulse_response
        for r in range(discrete.width):
            vector[r] += impulse_response[r] * current[IMPULSE]
    return segment, excess, is_near_limit, is_limited


@unfused_kernel
def _start_interval(
    limits: Limits, step_size: int, state: Array, disturbances: Array, vector: Array, constant_response: Array
) -> None:
    """Copy the states to the propagated vector, and compute the effect of constant disturbances over a step."""
    vector[:] = 0.0
    for j in range(state.size):
        vector[j] = state[j]
    constant_response[:] = 0.0
    for e in range(disturbances.size):
        for r in range(limits.constant_disturbance_response.shape[2]):
            constant_response[r] += disturbances[e] * limits.constant_disturbance_response[step_size, e, r]


@unfused_kernel
def _copy_segment(cubics: CubicInput, segment: int, interval: int, out: Array) -> bool:
    """Copy a segment of an interval, or an interval without discontinuities; return whether more segments follow."""
    if segment < cubics.segment_interval.size and cubics.segment_interval[segment] == interval:
        copy_into(cubics.segments[segment], out)
        return bool(segment + 1 < cubics.segment_interval.size and cubics.segment_interval[segment + 1] == interval)
    for k in range(4):
        out[k] = cubics.interval_cubics[k, interval]
    out[LENGTH], out[IMPULSE] = 1.0, 0.0
    return False


@unfused_kernel
def _sensor_output(limits: Limits, vector: Array) -> float:
    """Return the output that the sensor would have without the limit [V]."""
    output = 0.0
    for r in range(limits.output_weights.size):
        output += limits.output_weights[r] * vector[r]
    return output


@unfused_kernel
def _excess(limits: Limits, vector: Array) -> float:
    """Return the excess [V]."""
    output = _sensor_output(limits, vector)
    return output - min(max(output, -limits.output_limit), limits.output_limit)


@unfused_kernel
def _clip_states(limits: Limits, step_size: int, vector: Array) -> bool:
    """Clip the states at the rails by a constant input over the step; return whether any state was clipped."""
    any_clipped = False
    for j in range(limits.rails.size):
        clipped = min(max(vector[j], -limits.rails[j]), limits.rails[j])
        excess = vector[j] - clipped
        if excess != 0.0:
            for r in range(limits.rail_contributions.shape[2]):
                vector[r] -= excess * limits.rail_contributions[step_size, j, r]
            vector[j] = clipped
            any_clipped = True
    return any_clipped
