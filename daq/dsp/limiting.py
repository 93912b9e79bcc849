"""Overload of a sensor and of integrators: voltage limits, which act on the continuous signal, not on its samples.

A shock lasts microseconds in an accelerometer, much less than the sample interval of a slow converter. Limited voltages
are therefore checked many times per period of the circuit's fastest pole, at any sample rate. An interval in which a
limit may be reached is propagated in steps, with the exact transition of the linear circuit. Integrators are limited to
their rails, the largest voltages of their amplifiers. The excess of the sensor's output over its limit is subtracted as
a linear function of time in each step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from daq.dsp.circuit import RECOVERY, Circuit, Section
from daq.dsp.discretization import (
    DiscreteCircuit,
    Entry,
    extend_by_disturbances,
    generator_matrix,
    input_first,
    transpose_and_pad,
)
from daq.dsp.interpolation import IMPULSE, LENGTH, CubicInput, copy_into
from daq.dsp.segment_propagation import SegmentWorkspace, convert_integrals, load_segment, propagate_fraction
from rig.arrays import Array
from rig.numerics.fma import weighted_sums
from rig.numerics.jit import unfused_kernel
from rig.numerics.simd import aligned_zeros, copy, multiply, padded_length

# Checks per period of the circuit's fastest pole. The peak of a sine between two checks is at most 2 % higher.
CHECKS_PER_PERIOD = 16
# Minimum number of checks in an interval.
MIN_CHECKS = 8
# Index into the following pairs. Coarse steps are sufficient for an integrator; a sensor requires fine steps.
COARSE = 0
FINE = 1
# Number of steps per period of the circuit's fastest pole.
STEPS_PER_PERIOD = (32, 128)
# Minimum number of steps in an interval.
MIN_STEPS = (8, 32)
# If a voltage is below this fraction of its limit at all checks or steps, it is below the limit between them too.
NEAR_LIMIT = float(np.cos(np.pi / CHECKS_PER_PERIOD))
# An impulse counts as an overload if it is at least the limit times this duration, s. Smaller ones are rounding errors.
MIN_IMPULSE_S = 1e-9


class Limits(NamedTuple):
    """Matrices that detect where limits are reached, and propagate the circuit there.

    The *propagated vector* (`daq.dsp.discretization`) consists of `width` states and integrals of the output, and four
    derivatives of the input; `size` is its length. A leading dimension of 2 means coarse and fine steps.
    Disturbances (noise and offsets) of degree 0 are constant over an interval.
    """

    # Contributions of input, disturbances and states, in the order of `DiscreteCircuit.state_weights`, to each limited
    # voltage at each check in an interval; (checks, 4 + disturbances + states).
    check_weights: Array
    check_limits: Array  # magnitude of these voltages below which no limit is reached, V; (checks,)
    # Weights of the magnitudes of the same contributions. If their weighted sum is below 1, no check reaches a limit.
    bound_weights: Array
    step_counts: NDArray[np.int64]  # number of steps in an interval; (2,)
    step_transitions: (
        Array  # transition of the propagated vector over a step; (2, size, size), as `coarse_exponentials`
    )
    # Change of the propagated vector over a step due to 1 V of each constant disturbance; zero for the others; (2,
    # disturbances, width).
    constant_disturbance_response: Array
    # Change of states and moments over an interval due to 1 V of each other disturbance; (disturbances, width).
    polynomial_disturbance_response: Array
    output_limit: float  # largest magnitude of the sensor's output, V
    output_weights: Array  # sensor's output, as a linear function of the propagated vector; (size,)
    # Change of the propagated vector over a step due to an excess that falls linearly from 1 V to 0 (index 0), or rises
    # from 0 to 1 V (index 1); (2, 2, width).
    excess_contributions: Array
    # Factor by which the excess at the end of a step changes because it shifts the sensor's zero during the step; (2,).
    shift_feedback: Array
    limited_impulse_response: Array  # jump of the propagated vector due to a unit impulse over the limit; (width,)
    # Smallest impulse over the limit, as in `CubicInput`. It is infinite if the sensor has no direct feedthrough,
    # because its output then contains no impulse.
    min_impulse: float
    shift_state: int  # index of the state of the zero shift after an overload; -1: none
    rails: Array  # largest magnitude of each state, V; (states,)
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

    `sensor_sections`: number of the first sections, which form the sensor; `output_limit`: limit of the sensor's
    output, V; `rails`: limits of each state, V, (states,); `gain`: V per unit of the input; `rate`: sample rate, Hz;
    `entries`: positions of the disturbances.
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
    # Frequency of the fastest pole, periods per sample interval.
    fastest = float(np.abs(np.linalg.eigvals(circuit.a)).max(initial=0.0)) / (2 * np.pi * rate)
    checks = max(MIN_CHECKS, int(np.ceil(CHECKS_PER_PERIOD * fastest)))
    step_counts = np.array(
        [max(least, int(np.ceil(count * fastest))) for count, least in zip(STEPS_PER_PERIOD, MIN_STEPS, strict=True)]
    )

    # The excess over the limit is subtracted behind the sensor, and drives the shift of its zero.
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
    # Rows that yield the limited voltages from the vector with disturbances, and the limits: sensor's output, states.
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
    """Return `Limits.excess_contributions` for steps of one size; `steps`: number of steps in an interval."""
    size, width = len(generator), excess_input.size
    ramp = np.zeros((size + 2, size + 2))
    ramp[:size, :size] = generator
    ramp[:width, size], ramp[size, size + 1] = excess_input, 1.0
    ramp = expm(ramp / steps)
    rising = ramp[:width, size + 1] * steps
    return np.array([ramp[:width, size] - rising, rising])


def _rail_contributions(generator: Array, states: int, steps: int) -> Array:
    """Return, for each state, the contribution of a constant input that adds 1 to it over a step; (states, width).

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

    `limited`: row that yields a limited voltage from the vector with disturbances, and its limit; `extended`, `start`:
    from `extend_by_disturbances`; `checks`: number of checks in an interval.
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
    """Return whether any magnitude exceeds a limit; the loop has no branch, so that the compiler vectorizes it."""
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
    """Propagate the circuit step by step over an interval; return the next segment and the final excess, V.

    `segment`: number of the first segment that is not yet used; `interval`: number of the interval in the block.
    Afterwards, `workspace.vector` contains the moments, and `overload` the severity of the interval (see
    `daq.dsp.propagation.propagate`).
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

    Return the next segment, the final excess over the limit, whether the sensor's output came near its limit, and
    whether any limit was reached.
    """
    vector, current = workspace.vector, workspace.segment
    steps = limits.step_counts[step_size]
    _start_interval(limits, step_size, state, disturbances[:, interval], vector, workspace.constant_response)
    # Completed steps; position in the interval, from 0 to 1.
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
    """Copy the states to the propagated vector, and compute its change over a step due to constant disturbances."""
    vector[:] = 0.0
    for j in range(state.size):
        vector[j] = state[j]
    constant_response[:] = 0.0
    for e in range(disturbances.size):
        for r in range(limits.constant_disturbance_response.shape[2]):
            constant_response[r] += disturbances[e] * limits.constant_disturbance_response[step_size, e, r]


@unfused_kernel
def _copy_segment(cubics: CubicInput, segment: int, interval: int, out: Array) -> bool:
    """Copy a segment of an interval, or the whole interval if it has no breaks; return whether more segments follow."""
    if segment < cubics.segment_interval.size and cubics.segment_interval[segment] == interval:
        copy_into(cubics.segments[segment], out)
        return bool(segment + 1 < cubics.segment_interval.size and cubics.segment_interval[segment + 1] == interval)
    for k in range(4):
        out[k] = cubics.interval_cubics[k, interval]
    out[LENGTH], out[IMPULSE] = 1.0, 0.0
    return False


@unfused_kernel
def _sensor_output(limits: Limits, vector: Array) -> float:
    """Return the sensor's output without its limit, V."""
    output = 0.0
    for r in range(limits.output_weights.size):
        output += limits.output_weights[r] * vector[r]
    return output


@unfused_kernel
def _excess(limits: Limits, vector: Array) -> float:
    """Return the excess of the sensor's output over its limit, V."""
    output = _sensor_output(limits, vector)
    return output - min(max(output, -limits.output_limit), limits.output_limit)


@unfused_kernel
def _clip_states(limits: Limits, step_size: int, vector: Array) -> bool:
    """Clip the states at their rails by a constant input over the step; return whether any was clipped."""
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
