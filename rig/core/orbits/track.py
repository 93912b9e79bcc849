"""The motion of an orbit between its events: guards of its dampers, extremes and first harmonic.

The guard of a damper is its gap or contact force, which must stay positive between events.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.numerics.jit import cached_njit
from rig.core.orbits import event_kinds as kinds
from rig.core.orbits.matrix_exponential import exponential
from rig.core.orbits.orbit_equations import Equations, Sequence, along_gap

# The product of the step between instants and the norm of the state matrix is at most this. The relative error of the
# extremes of quintics is then 1e-9, and the harmonic is exact to rounding error.
MAX_RATE_TIMES_STEP = 0.25
# Limit of the same product if only the harmonic is computed, which then has a relative error of 1e-11.
_MAX_RATE_TIMES_HARMONIC_STEP = 0.7
# Maximum number of steps in a segment: without a limit, a long flight in a stiff structure would fill the memory.
MAX_STEPS = 1500
# Bernoulli numbers over factorials, for the end corrections of the trapezoidal rule (Euler-Maclaurin).
_END_CORRECTIONS = np.array([1 / 12, -1 / 720, 1 / 30240, -1 / 1209600, 1 / 47900160])


class Track(NamedTuple):
    """An orbit at the ends of equal steps of every segment between events.

    The last segment begins at the last event of a period and ends at the first event of the next period.
    """

    times: Array  # shape (segments, steps + 1)
    motion: Array  # shape (segments, steps + 1, states)
    # Guard of each damper, with first and second derivative; shape (segments, steps + 1, dampers, 3). It is the gap in
    # flight [m], or the force at the wall divided by the damper mass [m/s²].
    guards: Array
    extremes: Array  # Lowest and highest value of each coordinate; shape (coordinates, 2)
    harmonic: NDArray[np.complex128]
    """Integral of the state times exp(-i w t) over the orbit; complex, shape (states,)."""


@cached_njit
def turning_value(left_value: float, right_value: float, slopes: Array, curvatures: Array, step: float) -> float:
    """Return the extreme value in an interval, from the quintic through the values and two derivatives at its ends."""
    # Slopes s, curvatures c and coefficients a of the quintic in t, which is 0 and 1 at the ends of the interval.
    s0, s1, c0, c1 = (slopes[0] * step, slopes[1] * step, curvatures[0] * step * step, curvatures[1] * step * step)
    d = right_value - left_value - s0 - 0.5 * c0
    e, f = s1 - s0 - c0, c1 - c0
    a3, a4, a5 = 10 * d - 4 * e + 0.5 * f, -15 * d + 7 * e - f, 6 * d - 3 * e + 0.5 * f
    t = s0 / (s0 - s1)
    for _ in range(3):
        slope = s0 + t * (c0 + t * (3 * a3 + t * (4 * a4 + t * 5 * a5)))
        curvature = c0 + t * (6 * a3 + t * (12 * a4 + t * 20 * a5))
        if curvature != 0.0:
            t = min(1.0, max(0.0, t - slope / curvature))
    return left_value + t * (s0 + t * (0.5 * c0 + t * (a3 + t * (a4 + t * a5))))


@cached_njit
def _segments(
    equations: Equations, sequence: Sequence, instants: Array, max_rate_times_step: float
) -> tuple[Array, Array, int]:
    """Return start and duration of each segment, s, and the number of steps in a segment.

    The last segment ends at the first event of the next period.
    """
    events = sequence.kind.shape[0]
    segments = max(events, 1)
    starts, durations = np.zeros(segments), np.full(segments, equations.period)
    largest_rate_times_duration = 0.0
    for s in range(segments):
        if events > 0:
            starts[s] = instants[s]
            segment_end = instants[s + 1] if s + 1 < events else equations.period + instants[0]
            durations[s] = segment_end - starts[s]
        norm_bound = equations.norm_bound[sequence.configuration[min(s + 1, events)]]
        largest_rate_times_duration = max(largest_rate_times_duration, abs(durations[s]) * norm_bound)
    steps = int(np.ceil(largest_rate_times_duration / max_rate_times_step))
    return starts, durations, max(8, min(MAX_STEPS, steps))


@cached_njit
def _sample_states(
    equations: Equations, configuration: int, initial: Array, time: float, step: float, x: Array, rate: Array
) -> None:
    """Write the states (points + 1, states + 3) of a segment into `x`, and their rates A x into `rate`.

    `initial`: state at the start of the segment (the first `states` values are used); `time`: start [s]; `step`: s.
    """
    n, a, omega = x.shape[1] - 3, equations.generator[configuration], equations.omega
    flow = exponential(a, step, equations.norm_bound[configuration])
    x[0, :n] = initial[:n]
    x[0, n], x[0, n + 1], x[0, n + 2] = np.cos(omega * time), np.sin(omega * time), 1.0
    for i in range(x.shape[0]):
        for m in range(x.shape[1]):
            rate[i, m] = 0.0
            for c in range(x.shape[1]):
                rate[i, m] += a[m, c] * x[i, c]
        if i + 1 < x.shape[0]:
            for m in range(x.shape[1]):
                x[i + 1, m] = 0.0
                for c in range(x.shape[1]):
                    x[i + 1, m] += flow[m, c] * x[i, c]


@cached_njit
def _extend_range(extremes: Array, x: Array, rate: Array, step: float) -> None:
    """Extend the range of each coordinate by its extremes in a segment, including turning points within steps.

    `x`, `rate`: states and their rates A x at instants at a distance of `step` [s].
    """
    nq = extremes.shape[0]
    for i in range(x.shape[0]):
        for q in range(nq):
            displacement, velocity = x[i, q], x[i, nq + q]
            extremes[q, 0] = min(extremes[q, 0], displacement)
            extremes[q, 1] = max(extremes[q, 1], displacement)
            if i > 0 and x[i - 1, nq + q] * velocity < 0.0:
                slopes = np.array([x[i - 1, nq + q], velocity])
                curvatures = np.array([rate[i - 1, nq + q], rate[i, nq + q]])
                extreme = turning_value(x[i - 1, q], displacement, slopes, curvatures, step)
                extremes[q, 0], extremes[q, 1] = min(extremes[q, 0], extreme), max(extremes[q, 1], extreme)


@cached_njit
def _sample_guard(
    equations: Equations, a: Array, wall: int, j: int, initial: Array, x: Array, rate: Array, step: float, guard: Array
) -> None:
    """Write the guard of damper j along a segment, with two derivatives, into `guard`; see `Track.guards`.

    `a`: generator of the segment; `initial`: state, heights and velocities at its start; `x`, `rate`: states and their
    rates; `step`: time between them [s].
    """
    if wall >= kinds.REGIMES:
        return  # `rig.core.orbits.admissibility` examines the signals of sliding masses
    nq, nd = equations.inverse_mass.shape[1], equations.body_coordinate.shape[0]
    n, body, gravity = x.shape[1] - 3, equations.body_coordinate[j], equations.gravity
    if wall == kinds.WITHOUT_FORCE:
        for i in range(x.shape[0]):
            guard[i, 0], guard[i, 1] = along_gap(equations, j, x[i]), along_gap(equations, j, x[i, nq:])
            guard[i, 2] = along_gap(equations, j, rate[i, nq:])
        return
    if wall == kinds.FLYING:
        height, speed = initial[n + j], initial[n + nd + j]
        for i in range(x.shape[0]):
            t = i * step
            guard[i, 0] = height + (speed - 0.5 * gravity * t) * t - x[i, body]
            guard[i, 1] = speed - gravity * t - x[i, nq + body]
            guard[i, 2] = -gravity - rate[i, nq + body]
        return
    # The guard is weights[0] x + constant; each derivative multiplies the weights by A, because x' = A x.
    weights, constant = np.zeros((3, n + 3)), equations.hold_offset[j, 1 if wall == kinds.RIDES_CEILING else 0]
    if wall >= kinds.ON_FLOOR:
        sign, wall_index = (-1.0, 0) if wall == kinds.ON_FLOOR else (1.0, 1)
        gap, base = equations.gap_coordinate[j], equations.base_coordinate[j]
        weights[0, gap] = sign * equations.stiffness[j, wall_index] / equations.mass[j]
        weights[0, nq + gap] = sign * equations.damping[j, wall_index] / equations.mass[j]
        constant = -equations.wall_gap[j, wall_index] * weights[0, gap]
        if base >= 0:
            weights[0, base], weights[0, nq + base] = -weights[0, gap], -weights[0, nq + gap]
    else:
        weights[0] = a[nq + body]
    weights[1] = weights[0] @ a
    weights[2] = weights[1] @ a
    for i in range(x.shape[0]):
        guard[i, 0] = constant
        for m in range(n + 3):
            for d in range(3):
                guard[i, d] += weights[d, m] * x[i, m]


@cached_njit
def _segment_harmonic(a: Array, omega: float, times: Array, x: Array, step: float) -> NDArray[np.complex128]:
    """Integrate exp(-i w t) x over a segment by the trapezoidal rule with Euler-Maclaurin corrections."""
    steps, size = x.shape[0] - 1, x.shape[1]
    total = np.zeros(size, dtype=np.complex128)
    end_difference, derivative = np.zeros(size, dtype=np.complex128), np.zeros(size, dtype=np.complex128)
    for i in range(steps + 1):
        phase_factor = np.exp(-1j * omega * times[i])
        for m in range(size):
            if i == 0:
                end_difference[m] = -phase_factor * x[i, m]
                total[m] = 0.5 * phase_factor * x[i, m]
            elif i == steps:
                end_difference[m] += phase_factor * x[i, m]
                total[m] += 0.5 * phase_factor * x[i, m]
            else:
                total[m] += phase_factor * x[i, m]
    # The derivatives of exp(-i w t) x are its products with powers of (A - i w); the corrections use odd derivatives.
    for order in range(2 * len(_END_CORRECTIONS) - 1):
        for m in range(size):
            derivative[m] = -1j * omega * end_difference[m]
            for c in range(size):
                derivative[m] += a[m, c] * end_difference[c]
        for m in range(size):
            end_difference[m] = derivative[m] * step
            if order % 2 == 0:
                total[m] -= _END_CORRECTIONS[order // 2] * end_difference[m]
    return step * total


@cached_njit
def track_orbit(equations: Equations, sequence: Sequence, instants: Array, states: Array) -> Track:
    """Compute the motion of an orbit between its events.

    `instants`, shape (events,): instants of the events; `states`, shape (events + 1, states + 2 dampers): as `shoot`
    returns them.
    """
    n = equations.generator.shape[1] - 3
    nq, nd, omega = equations.inverse_mass.shape[1], equations.body_coordinate.shape[0], equations.omega
    starts, durations, steps = _segments(equations, sequence, instants, MAX_RATE_TIMES_STEP)
    segments = starts.size
    times = np.zeros((segments, steps + 1))
    motion = np.zeros((segments, steps + 1, n))
    guards = np.zeros((segments, steps + 1, nd, 3))
    extremes = np.empty((nq, 2))
    extremes[:, 0], extremes[:, 1] = np.inf, -np.inf
    harmonic = np.zeros(n, dtype=np.complex128)
    x, rate = np.empty((steps + 1, n + 3)), np.empty((steps + 1, n + 3))
    for s in range(segments):
        k = s + 1 if sequence.kind.shape[0] > 0 else 0  # index of the segment in `sequence`
        configuration, step = sequence.configuration[k], durations[s] / steps
        a = equations.generator[configuration]
        _sample_states(equations, configuration, states[k], starts[s], step, x, rate)
        for i in range(steps + 1):
            times[s, i] = starts[s] + i * step
            motion[s, i] = x[i, :n]
        _extend_range(extremes, x, rate, step)
        for j in range(nd):
            _sample_guard(equations, a, sequence.wall[k, j], j, states[k], x, rate, step, guards[s, :, j])
        harmonic += _segment_harmonic(a, omega, times[s], x, step)[:n]
    return Track(times, motion, guards, extremes, harmonic)


@cached_njit
def first_harmonic(equations: Equations, sequence: Sequence, instants: Array, states: Array) -> NDArray[np.complex128]:
    """Return the harmonic of `Track` alone, with larger steps; the arguments are those of `track_orbit`."""
    n, omega = equations.generator.shape[1] - 3, equations.omega
    starts, durations, steps = _segments(equations, sequence, instants, _MAX_RATE_TIMES_HARMONIC_STEP)
    harmonic = np.zeros(n, dtype=np.complex128)
    x, rate = np.empty((steps + 1, n + 3)), np.empty((steps + 1, n + 3))
    for s in range(starts.size):
        k = s + 1 if sequence.kind.shape[0] > 0 else 0  # index of the segment in `sequence`
        configuration, step = sequence.configuration[k], durations[s] / steps
        a = equations.generator[configuration]
        _sample_states(equations, configuration, states[k], starts[s], step, x, rate)
        times = starts[s] + step * np.arange(steps + 1)
        harmonic += _segment_harmonic(a, omega, times, x, step)[:n]
    return harmonic
