"""Limits of a sensor's output and of integrators act on the signal itself, not on its samples.

A shock lasts microseconds in an accelerometer, much less than the sample interval of a slow converter. Limited voltages
are therefore checked many times per period of the circuit's fastest part, at any sample rate. An interval in which a
limit may be reached is propagated in steps: the linear circuit exactly, an integrator at its rail, and in finer steps
the excess of the sensor's output, linear from step to step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from daq.dsp.broken_intervals import PartWorkspace, advance, begin_part, form_moments
from daq.dsp.circuit import RECOVERY, Circuit, Section
from daq.dsp.discretization import Entry, Tables, input_first, laid_out, rate_of_change, with_disturbances
from daq.dsp.interpolation import JUMP, LENGTH, CubicInput, copy_into
from rig.arrays import Array
from rig.numerics.fma import weighted_sums
from rig.numerics.jit import unfused_kernel
from rig.numerics.simd import aligned_zeros, copy, multiply, padded_length

# Checks per period of the circuit's fastest part: between two checks, a sine's peak is 2 % higher.
CHECKS_PER_PERIOD = 16
# Smallest number of checks in an interval.
MIN_CHECKS = 8
# Steps where a limit is near: coarse for an integrator, fine for the sensor. Index of each in the following pairs.
COARSE = 0
FINE = 1
# Number of steps per period of the circuit's fastest part.
STEPS_PER_PERIOD = (32, 128)
# Smallest number of steps in an interval.
MIN_STEPS = (8, 32)
# Below this share of the limit at every check or coarse step, the limit is not reached in between.
NEAR_LIMIT = float(np.cos(np.pi / CHECKS_PER_PERIOD))
# Shortest time for which an impulse reaches the limit. A shorter time is a rounding error.
MIN_IMPULSE_S = 1e-9


class Limits(NamedTuple):
    """Tables to detect where limits are reached, and to propagate the circuit there."""

    # Contributions of input, disturbances and states, in the order of `Tables.weights`, to each limited voltage at
    # each check in an interval; (checks, 4 + disturbances + states).
    checks: Array
    linear_limit: Array  # magnitude of these voltages up to which no limit is reached; (checks,)
    safe: Array  # weights of the magnitudes of the same; if their sum is below 1, no check reaches a limit
    steps: NDArray[np.int64]  # coarse and fine steps in an interval propagated in steps; int64; (2,)
    step: Array  # the vector's transition over one of each; (2, size, size), as `Tables.coarse`
    # Contribution of 1 V of each steady disturbance to the vector over a step, and zeros; (2, disturbances, width).
    steady_response: Array
    # Contribution of 1 V of the other disturbances over an interval, in moments, not integrals; (disturbances, width).
    varying: Array
    limit: float  # of the sensor's output, V
    output: Array  # the sensor's output from the vector; (size,)
    # Contribution of an excess of 1 V to the vector, at a step's start and at its end; (2, 2, width).
    excess_ramps: Array
    # Excess at a step's end, relative to the excess without its own effect on the shift; (2,).
    relief: Array
    impulse: Array  # remaining effect of a unit impulse over the limit; (width,)
    min_impulse: float  # smallest impulse over the limit, as in `CubicInput`; none behind a resonance
    shift: int  # state of the zero shift after an overload; -1: none
    rails: Array  # largest magnitude of each state, V; (states,)
    # Contribution of an even input that adds 1 V to each state over a step to the vector; (2, states, width).
    holding: Array


def limits_of(
    sections: Sequence[Section],
    sensor: int,
    limit: float | None,
    rails: Array,
    gain: float,
    rate: float,
    entries: Sequence[Entry],
    tables: Tables,
) -> Limits | None:
    """Return the tables of a circuit's limits in V, of the output of the first `sensor` sections and of each state."""
    if limit is None and not np.isfinite(rails).any():
        return None
    integrals = tables.integrals
    circuit, leading = Circuit.series(sections), Circuit.series(sections[:sensor])
    generator = rate_of_change(circuit, gain, rate, integrals)
    states, size = circuit.c.size, len(generator)
    width, reach = size - 4, np.inf if limit is None else limit
    output = aligned_zeros(padded_length(size))
    output[: leading.c.size], output[width] = leading.c, leading.d[0] * gain
    fastest = float(np.abs(np.linalg.eigvals(circuit.a)).max(initial=0.0)) / (2 * np.pi * rate)
    count = max(MIN_CHECKS, int(np.ceil(CHECKS_PER_PERIOD * fastest)))
    steps = np.array(
        [max(least, int(np.ceil(count * fastest))) for count, least in zip(STEPS_PER_PERIOD, MIN_STEPS, strict=True)]
    )

    # The excess over the limit is missing behind the sensor, and shifts its zero.
    excess_input = np.zeros(width)
    excess_input[:states] = -circuit.b[sensor] / rate
    if integrals:
        excess_input[states] = -circuit.d[sensor]
    shift = -1
    for section, first in zip(sections[:sensor], circuit.sections, strict=False):
        if section.name == RECOVERY:
            shift = first
            excess_input[shift] = -section.a[0, 0] / rate
    excess_ramps = np.array([_ramps(generator, excess_input, count) for count in steps])
    augmented, start = with_disturbances(generator, circuit, rate, tables.integrals, entries)
    steady_response = np.array([(expm(augmented / count) @ start)[:width, states + 4 :].T for count in steps])
    steady = np.array([entry.degree == 0 for entry in entries], dtype=bool)
    steady_response[:, ~steady] = 0.0
    varying = tables.step[states + 4 :].copy()
    varying[steady] = 0.0
    through = output[width]
    watched = [(np.concatenate([output[:size], np.zeros(len(augmented) - size)]), reach)]
    watched += [(np.eye(len(augmented))[state], rails[state]) for state in range(states)]
    watched = [(row, linear_limit) for row, linear_limit in watched if np.isfinite(linear_limit)]
    checks, linear_limit = _check_rows(watched, augmented, start, states, count)
    return Limits(
        checks=checks,
        linear_limit=linear_limit,
        # Rounding must not make it smaller than the bounded value.
        safe=np.abs(checks / linear_limit[:, None]).max(axis=0) * (1.0 + 1e-9),
        steps=steps,
        step=laid_out(np.array([expm(generator / count) for count in steps])),
        steady_response=np.ascontiguousarray(steady_response),
        varying=varying,
        limit=reach,
        output=output,
        excess_ramps=excess_ramps,
        relief=1.0 / (1.0 - excess_ramps[:, 1] @ output[:width]),
        impulse=generator[:width, width] + through * excess_input,
        min_impulse=float(reach * MIN_IMPULSE_S * rate / abs(through)) if through else np.inf,
        shift=shift,
        rails=rails,
        holding=np.array([_holding_inputs(generator, states, count) for count in steps]),
    )


def _ramps(generator: Array, excess_input: Array, steps: int) -> Array:
    """Return the contributions of inputs that fall from 1 to 0 and rise from 0 to 1 over a step; (2, width)."""
    size, width = len(generator), excess_input.size
    ramp = np.zeros((size + 2, size + 2))
    ramp[:size, :size] = generator
    ramp[:width, size], ramp[size, size + 1] = excess_input, 1.0
    ramp = expm(ramp / steps)
    rising = ramp[:width, size + 1] * steps
    return np.array([ramp[:width, size] - rising, rising])


def _holding_inputs(generator: Array, states: int, steps: int) -> Array:
    """Return the contributions of even inputs that add 1 to each state over a step; (states, width)."""
    size = len(generator)
    inputs = np.zeros((size + states, size + states))
    inputs[:size, :size], inputs[:states, size:] = generator, np.eye(states)
    added = expm(inputs / steps)[: size - 4, size:].T
    return np.asarray(added / np.diagonal(added)[:, None])


def _check_rows(
    watched: Sequence[tuple[Array, float]], augmented: Array, start: Array, states: int, count: int
) -> tuple[Array, Array]:
    """Rows of the limited voltages at each check, and the magnitudes that prove them within their limits in between."""
    over_check = expm(augmented / count)
    checks = np.zeros((len(watched) * count, start.shape[1]))
    linear_limit = np.zeros(len(checks))
    for number, (row, largest) in enumerate(watched):
        for check in range(count):
            row = row @ over_check
            checks[number * count + check] = row @ start
        linear_limit[number * count : (number + 1) * count] = largest * NEAR_LIMIT
    return np.ascontiguousarray(input_first(checks, states)), linear_limit


@unfused_kernel
def within(limits: Limits, course: Array, sizes: Array, sums: Array, count: int) -> int:
    """Count the intervals of a stretch up to the first in which a limit may be reached.

    `course` has input, disturbances and states at the start of each interval; `sizes` is room for their
    magnitudes.
    """
    for r in range(course.shape[0]):
        for k in range(count):
            sizes[r, k] = abs(course[r, k])
    weighted_sums(sizes, 0, 0, limits.safe, course.shape[0], sums, count)
    if not _exceeds(sums[:count], 1.0):
        return count
    for check in range(limits.linear_limit.size):
        weighted_sums(course, 0, 0, limits.checks[check], course.shape[0], sums, count)
        if _exceeds(sums[:count], limits.linear_limit[check]):
            for k in range(count):
                if abs(sums[k]) > limits.linear_limit[check]:
                    count = k
                    break
    return count


@unfused_kernel
def _exceeds(values: Array, limit: float) -> bool:
    """Whether any magnitude exceeds a limit; without branches, so that several are compared at a time."""
    count = 0
    for k in range(values.size):
        count += abs(values[k]) > limit
    return count > 0


@unfused_kernel
def follow_closely(
    cubics: CubicInput,
    part: int,
    interval: int,
    tables: Tables,
    limits: Limits,
    state: Array,
    steady_response: Array,
    overload: Array,
    workspace: PartWorkspace,
) -> tuple[int, float]:
    """Propagate the circuit step by step over an interval; return the next part and the final excess.

    Moments are in the workspace's vector, the severity of the interval in `overload` (see
    `daq.dsp.propagation.propagate`).
    """
    after, excess, is_near_limit, reached = _in_steps(
        COARSE, cubics, part, interval, tables, limits, state, steady_response, workspace
    )
    if is_near_limit:
        after, excess, is_near_limit, reached = _in_steps(
            FINE, cubics, part, interval, tables, limits, state, steady_response, workspace
        )
    vector = workspace.vector
    form_moments(tables, vector, workspace.work)
    for e in range(steady_response.shape[0]):
        for r in range(tables.width):
            vector[r] += limits.varying[e, r] * steady_response[e, interval]
    for j in range(tables.states):
        state[j] = min(max(vector[j], -limits.rails[j]), limits.rails[j])
    if reached:
        overload[1 + interval] = 1.0
        if limits.shift >= 0:
            overload[1 + interval] += abs(state[limits.shift]) / limits.limit
    return after, excess


@unfused_kernel
def _in_steps(
    size: int,
    cubics: CubicInput,
    part: int,
    interval: int,
    tables: Tables,
    limits: Limits,
    state: Array,
    steady_response: Array,
    workspace: PartWorkspace,
) -> tuple[int, float, bool, bool]:
    """Propagate the vector over an interval in coarse or fine steps.

    Return the next part, the final excess over the limit, whether the sensor's output came near its limit, and
    whether any limit was reached.
    """
    vector, full_step = workspace.vector, workspace.full_part
    steps = limits.steps[size]
    _begin(limits, size, state, steady_response[:, interval], vector, workspace.steady)
    node, place, excess, is_near_limit, reached, more = 0, 0.0, 0.0, False, False, True
    while more:
        more = _next_part(cubics, part, interval, full_step)
        part += part < cubics.broken.size and cubics.broken[part] == interval
        end = place + full_step[LENGTH] if more else 1.0
        vector[tables.width :] = 0.0
        if full_step[LENGTH] > 0.0:
            begin_part(tables, full_step, vector)
        if node == 0:
            is_near_limit |= abs(_sensor_output(limits, vector)) > limits.limit * NEAR_LIMIT
            excess = _excess(limits, vector)
        while node < steps and (node + 1) / steps <= end:
            if place == node / steps:
                multiply(limits.step, size, vector, workspace.zeros, workspace.term)
                copy(workspace.term, vector)
            else:
                advance(tables, (node + 1) / steps - place, workspace)
            node += 1
            place = node / steps
            for r in range(tables.width):
                vector[r] += excess * limits.excess_ramps[size, 0, r] + workspace.steady[r]
            is_near_limit |= abs(_sensor_output(limits, vector)) > limits.limit * NEAR_LIMIT
            excess = limits.relief[size] * _excess(limits, vector)
            if excess != 0.0:
                for r in range(tables.width):
                    vector[r] += excess * limits.excess_ramps[size, 1, r]
                reached = True
            reached |= _clip_states(limits, size, vector)
        if end > place:
            advance(tables, end - place, workspace)
            place = end
        limited = abs(full_step[JUMP]) > limits.min_impulse
        reached |= limited
        for r in range(tables.width):
            vector[r] += (limits.impulse[r] if limited else tables.impulse[r]) * full_step[JUMP]
    return part, excess, is_near_limit, reached


@unfused_kernel
def _begin(limits: Limits, size: int, state: Array, steady_response: Array, vector: Array, steady: Array) -> None:
    """Copy the states to the vector, and sum up the contributions of steady disturbances to it over each step."""
    vector[:] = 0.0
    for j in range(state.size):
        vector[j] = state[j]
    steady[:] = 0.0
    for e in range(steady_response.size):
        for r in range(limits.steady_response.shape[2]):
            steady[r] += steady_response[e] * limits.steady_response[size, e, r]


@unfused_kernel
def _next_part(cubics: CubicInput, part: int, interval: int, out: Array) -> bool:
    """Take the next part of an interval, all of it if nothing breaks it; say whether more parts follow."""
    if part < cubics.broken.size and cubics.broken[part] == interval:
        copy_into(cubics.parts[part], out)
        return bool(part + 1 < cubics.broken.size and cubics.broken[part + 1] == interval)
    for k in range(4):
        out[k] = cubics.smooth[k, interval]
    out[LENGTH], out[JUMP] = 1.0, 0.0
    return False


@unfused_kernel
def _sensor_output(limits: Limits, vector: Array) -> float:
    """Return the sensor's output without its limit, V."""
    free = 0.0
    for r in range(limits.output.size):
        free += limits.output[r] * vector[r]
    return free


@unfused_kernel
def _excess(limits: Limits, vector: Array) -> float:
    """Return the excess of the sensor's output over its limit, V."""
    free = _sensor_output(limits, vector)
    return free - min(max(free, -limits.limit), limits.limit)


@unfused_kernel
def _clip_states(limits: Limits, size: int, vector: Array) -> bool:
    """Clip the states at their rails, evenly over a step; return whether any was clipped."""
    any_clipped = False
    for j in range(limits.rails.size):
        clipped = min(max(vector[j], -limits.rails[j]), limits.rails[j])
        excess = vector[j] - clipped
        if excess != 0.0:
            for r in range(limits.holding.shape[2]):
                vector[r] -= excess * limits.holding[size, j, r]
            vector[j] = clipped
            any_clipped = True
    return any_clipped
