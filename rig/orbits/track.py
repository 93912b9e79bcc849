"""The motion of an orbit between its events: guard functions of its dampers, extremes and first harmonic."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.numerics.jit import stored
from rig.orbits.matrix_exponential import exponential
from rig.orbits.orbit_equations import FLYING, FORCELESS, ON_FLOOR, Equations, Sequence

# Product of an interval with the fastest rate. The relative error of the extremes of quintics is then 1e-9, and the
# harmonic is exact to rounding.
INTERVAL = 0.25
MOST_POINTS = 1500
# Bernoulli numbers over factorials, for the end corrections of the trapezoidal rule (Euler-Maclaurin).
_ENDS = np.array([1 / 12, -1 / 720, 1 / 30240, -1 / 1209600, 1 / 47900160])


class Track(NamedTuple):
    """An orbit at evenly spaced instants of every stretch between events.

    The stretch after the last event extends into the next period up to the first event.
    """

    times: Array  # shape (stretches, points + 1)
    motion: Array  # shape (stretches, points + 1, states)
    guards: Array
    """For each damper, with first and second derivative: the gap in flight [m], q'' + g of the body while riding
    [m/s^2], or the wall force divided by the damper mass during finite-duration contact [m/s^2]; shape (stretches,
    points + 1,
    dampers, 3)."""
    reach: Array
    """Lowest and highest value of each coordinate; shape (coordinates, 2)."""
    harmonic: NDArray[np.complex128]
    """Integral of the state times exp(-i w t) over the orbit; complex, shape (states,)."""


@stored
def turning(left: float, right: float, slopes: Array, curves: Array, step: float) -> float:
    """Return the turning value in an interval, from the quintic through values and two derivatives."""
    s0, s1, c0, c1 = slopes[0] * step, slopes[1] * step, curves[0] * step * step, curves[1] * step * step
    d = right - left - s0 - 0.5 * c0
    e, f = s1 - s0 - c0, c1 - c0
    a3, a4, a5 = 10 * d - 4 * e + 0.5 * f, -15 * d + 7 * e - f, 6 * d - 3 * e + 0.5 * f
    t = s0 / (s0 - s1)
    for _ in range(3):
        slope = s0 + t * (c0 + t * (3 * a3 + t * (4 * a4 + t * 5 * a5)))
        bend = c0 + t * (6 * a3 + t * (12 * a4 + t * 20 * a5))
        if bend != 0.0:
            t = min(1.0, max(0.0, t - slope / bend))
    return left + t * (s0 + t * (0.5 * c0 + t * (a3 + t * (a4 + t * a5))))


@stored
def _stretches(equations: Equations, sequence: Sequence, instants: Array) -> tuple[Array, Array, int]:
    """Return start and length of the stretches and their points; the last ends at the next period's first event."""
    events = sequence.kind.shape[0]
    stretches = max(events, 1)
    begin, length = np.zeros(stretches), np.full(stretches, equations.period)
    longest = 0.0
    for s in range(stretches):
        if events > 0:
            begin[s] = instants[s]
            after = instants[s + 1] if s + 1 < events else equations.period + instants[0]
            length[s] = after - begin[s]
        longest = max(longest, abs(length[s]) * equations.rate[sequence.slot[min(s + 1, events)]])
    return begin, length, max(8, min(MOST_POINTS, int(np.ceil(longest / INTERVAL))))


@stored
def _march(a: Array, flow: Array, start: Array, x: Array, rate: Array) -> None:
    """Compute the states x (points + 1, states + 3) at even times by the flow of one step, and A x."""
    x[0] = start
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


@stored
def _widen(reach: Array, x: Array, rate: Array, step: float) -> None:
    """Extend the range of each coordinate to its extremes in a stretch, including turning points."""
    nq = reach.shape[0]
    for i in range(x.shape[0]):
        for q in range(nq):
            here, speed = x[i, q], x[i, nq + q]
            reach[q, 0], reach[q, 1] = min(reach[q, 0], here), max(reach[q, 1], here)
            if i > 0 and x[i - 1, nq + q] * speed < 0.0:
                slopes = np.array([x[i - 1, nq + q], speed])
                bends = np.array([rate[i - 1, nq + q], rate[i, nq + q]])
                there = turning(x[i - 1, q], here, slopes, bends, step)
                reach[q, 0], reach[q, 1] = min(reach[q, 0], there), max(reach[q, 1], there)


@stored
def _guard(
    equations: Equations,
    a: Array,
    wall: int,
    j: int,
    begun: Array,
    x: Array,
    rate: Array,
    step: float,
    guard: Array,
) -> None:
    """Compute a damper's guard along a stretch with two derivatives: its gap or its contact force."""
    nq, nd = equations.inverse_mass.shape[1], equations.position.shape[0]
    n, body, gravity = x.shape[1] - 3, equations.position[j], equations.gravity
    if wall == FORCELESS:
        bed = equations.bed[j]
        for i in range(x.shape[0]):
            guard[i, 0], guard[i, 1], guard[i, 2] = x[i, bed], x[i, nq + bed], rate[i, nq + bed]
        return
    if wall == FLYING:
        height, speed = begun[n + j], begun[n + nd + j]
        for i in range(x.shape[0]):
            t = i * step
            guard[i, 0] = height + (speed - 0.5 * gravity * t) * t - x[i, body]
            guard[i, 1] = speed - gravity * t - x[i, nq + body]
            guard[i, 2] = -gravity - rate[i, nq + body]
        return
    weight, first = np.zeros((3, n + 3)), gravity
    if wall >= ON_FLOOR:
        sign, at = (-1.0, 0) if wall == ON_FLOOR else (1.0, 1)
        weight[0, equations.bed[j]] = sign * equations.stiffness[j, at] / equations.mass[j]
        weight[0, nq + equations.bed[j]] = sign * equations.damping[j, at] / equations.mass[j]
        first = -equations.clearance[j] * weight[0, equations.bed[j]] if at == 1 else 0.0
    else:
        weight[0] = a[nq + body]
    weight[1] = weight[0] @ a
    weight[2] = weight[1] @ a
    for i in range(x.shape[0]):
        guard[i, 0] = first
        for m in range(n + 3):
            for d in range(3):
                guard[i, d] += weight[d, m] * x[i, m]


@stored
def _first_harmonic(a: Array, omega: float, times: Array, x: Array, step: float) -> NDArray[np.complex128]:
    """Integrate exp(-i w t) x over a stretch by the trapezoidal rule with Euler-Maclaurin corrections."""
    points, size = x.shape[0] - 1, x.shape[1]
    total = np.zeros(size, dtype=np.complex128)
    jump, turned = np.zeros(size, dtype=np.complex128), np.zeros(size, dtype=np.complex128)
    for i in range(points + 1):
        turn = np.exp(-1j * omega * times[i])
        for m in range(size):
            if i == 0:
                jump[m] = -turn * x[i, m]
                total[m] = 0.5 * turn * x[i, m]
            elif i == points:
                jump[m] += turn * x[i, m]
                total[m] += 0.5 * turn * x[i, m]
            else:
                total[m] += turn * x[i, m]
    # The derivatives of exp(-i w t) x are its products with powers of (A - i w); the corrections use odd derivatives.
    for order in range(2 * len(_ENDS) - 1):
        for m in range(size):
            turned[m] = -1j * omega * jump[m]
            for c in range(size):
                turned[m] += a[m, c] * jump[c]
        for m in range(size):
            jump[m] = turned[m] * step
            if order % 2 == 0:
                total[m] -= _ENDS[order // 2] * jump[m]
    return step * total


@stored
def follow(equations: Equations, sequence: Sequence, instants: Array, states: Array) -> Track:
    """Follow an orbit between its events.

    `instants`, shape (events,): instants of the events; `states`, shape (events + 1, states + 2 dampers): as `shoot`
    returns them.
    """
    n = equations.generator.shape[1] - 3
    nq, nd, omega = equations.inverse_mass.shape[1], equations.position.shape[0], equations.omega
    begin, length, points = _stretches(equations, sequence, instants)
    stretches = begin.size
    times = np.zeros((stretches, points + 1))
    motion = np.zeros((stretches, points + 1, n))
    guards = np.zeros((stretches, points + 1, nd, 3))
    reach = np.empty((nq, 2))
    reach[:, 0], reach[:, 1] = np.inf, -np.inf
    harmonic = np.zeros(n, dtype=np.complex128)
    start, x, rate = np.ones(n + 3), np.empty((points + 1, n + 3)), np.empty((points + 1, n + 3))
    for s in range(stretches):
        k = s + 1 if sequence.kind.shape[0] > 0 else 0
        slot, step = sequence.slot[k], length[s] / points
        a = equations.generator[slot]
        start[:n] = states[k, :n]
        start[n], start[n + 1] = np.cos(omega * begin[s]), np.sin(omega * begin[s])
        _march(a, exponential(a, step, equations.rate[slot]), start, x, rate)
        for i in range(points + 1):
            times[s, i] = begin[s] + i * step
            motion[s, i] = x[i, :n]
        _widen(reach, x, rate, step)
        for j in range(nd):
            _guard(equations, a, sequence.wall[k, j], j, states[k], x, rate, step, guards[s, :, j])
        harmonic += _first_harmonic(a, omega, times[s], x, step)[:n]
    return Track(times, motion, guards, reach, harmonic)
