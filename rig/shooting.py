"""Shooting over a given sequence of events: where an orbit ends, and how that depends on where it begins.

Between events the state x = (coordinates, velocities, coil current; cos wt, sin wt; 1) obeys x' = A x with A
of the contact configuration, so it is propagated by the matrix exponential. Dampers in flight fall freely;
riding ones are part of A. The unknowns are the state at the start of a period, the dampers in flight there,
and the instants of the events; the equations are the return to the start and, at each event, its own
condition (contact force or gap zero). Sensitivities are carried along, through events as well: solving the
events' rows of the Jacobian for the instants is what the saltation matrices do, so that the Floquet
multipliers come out of the same numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

# Kinds of events. A damper that bounces leaves the wall in the instant in which it hits it, with the common
# velocity (osculating contact); one that leaves `WITH_LAST` is thrown off by the event before, at the same
# instant.
SEPARATION, FLOOR, CEILING, FLOOR_BOUNCE, CEILING_BOUNCE, WITH_LAST = 0, 1, 2, 3, 4, 5


class Equations(NamedTuple):
    """The equations of motion in every configuration that an orbit visits, for one set of parameters.

    Attributes
    ----------
    generator : ndarray, shape (configurations, states + 3, states + 3)
    inverse_mass : ndarray, shape (configurations, coordinates, coordinates)
    position : int64 ndarray, shape (dampers,)
        Coordinate of each damper's body.
    mass, clearance : ndarray, shape (dampers,)
    gravity, omega : float
    """

    generator: Array
    inverse_mass: Array
    position: Whole
    mass: Array
    clearance: Array
    gravity: float
    omega: float


class Sequence(NamedTuple):
    """Which events happen, in order.

    Attributes
    ----------
    kind, damper : int64 ndarray, shape (events,)
    slot : int64 ndarray, shape (events + 1,)
        Configuration of each stretch: before the first event, between events, after the last.
    wall : int64 ndarray, shape (events + 1, dampers)
        In each stretch: 0 in flight, 1 on the floor, 2 at the ceiling.
    """

    kind: Whole
    damper: Whole
    slot: Whole
    wall: Whole


@njit(cache=True)
def exponential(matrix: Array, time: float) -> Array:
    """Matrix exponential of `matrix` times `time`, by a Taylor series with scaling and squaring."""
    n = matrix.shape[0]
    scaled = matrix * time
    norm = 0.0
    for i in range(n):
        norm = max(norm, np.abs(scaled[i]).sum())
    halvings = 0
    while norm > 0.5:
        norm *= 0.5
        halvings += 1
    scaled = scaled * 0.5**halvings
    # The sum without the identity, so that small times keep their last bits: squaring maps s to 2 s + s s.
    total = scaled / 14.0
    for k in range(13, 0, -1):
        total = (scaled + scaled @ total) / k
    for _ in range(halvings):
        total = 2.0 * total + total @ total
    for i in range(n):
        total[i, i] += 1.0
    return total


@njit(cache=True)
def shoot(
    equations: Equations, sequence: Sequence, period: float, unknowns: Array, derivatives: bool
) -> tuple[Array, Array, Array, Array]:
    """Evaluate the equations of an orbit.

    Parameters
    ----------
    equations : Equations
    sequence : Sequence
    period : float
        Length of the orbit, a multiple of the drive's period [s].
    unknowns : ndarray, shape (unknowns,)
        State at t = 0, height and velocity of each damper in flight there (in order), instants of the events
        [s].
    derivatives : bool
        Whether to carry the sensitivities.

    Returns
    -------
    residual : ndarray, shape (unknowns,)
        Return to the start, then the events' own conditions.
    jacobian : ndarray, shape (unknowns, unknowns)
        Of the residual; zeros if not asked for.
    states : ndarray, shape (events + 1, states + 2 dampers)
        State, heights and velocities at the begin of each stretch.
    closing : ndarray, shape (events,)
        Closing speed of each impact [m/s].
    """
    n = equations.generator.shape[1] - 3
    nq, nd = equations.inverse_mass.shape[1], equations.position.shape[0]
    events, size = sequence.kind.shape[0], unknowns.shape[0]
    omega, gravity = equations.omega, equations.gravity
    x = np.zeros(n + 3)
    x[:n] = unknowns[:n]
    height, speed = np.zeros(nd), np.zeros(nd)
    columns = size if derivatives else 0
    sx, sh, sv = np.zeros((n, columns)), np.zeros((nd, columns)), np.zeros((nd, columns))
    for i in range(min(n, columns)):
        sx[i, i] = 1.0
    at = n
    for j in range(nd):
        if sequence.wall[0, j] == 0:
            height[j], speed[j] = unknowns[at], unknowns[at + 1]
            if derivatives:
                sh[j, at] = 1.0
                sv[j, at + 1] = 1.0
            at += 2
    first = at
    residual, jacobian = np.zeros(size), np.zeros((size, columns))
    states, closing = np.zeros((events + 1, n + 2 * nd)), np.zeros(events)
    time = 0.0
    for k in range(events + 1):
        states[k, :n] = x[:n]
        states[k, n : n + nd] = height
        states[k, n + nd :] = speed
        end = unknowns[first + k] if k < events else period
        a = equations.generator[sequence.slot[k]]
        x[n], x[n + 1], x[n + 2] = np.cos(omega * time), np.sin(omega * time), 1.0
        flow = exponential(a, end - time)
        begun = x.copy()
        x = flow @ begun
        length = end - time
        for j in range(nd):
            height[j] += speed[j] * length - 0.5 * gravity * length * length
            speed[j] -= gravity * length
        if derivatives:
            turning = flow[:n, n] * (-omega * begun[n + 1]) + flow[:n, n + 1] * (omega * begun[n])
            rate = a[:n] @ x
            sx = np.ascontiguousarray(flow[:n, :n]) @ sx
            sh = sh + length * sv
            for edge in range(2):
                # The stretch begins at event k - 1 and ends at event k; the ends of the period are fixed.
                column = first + k - 1 + edge
                if (edge == 0 and k == 0) or (edge == 1 and k == events):
                    continue
                sign = 1.0 if edge == 1 else -1.0
                for i in range(n):
                    sx[i, column] += sign * rate[i] + (turning[i] if edge == 0 else 0.0)
                for j in range(nd):
                    sh[j, column] += sign * speed[j]
                    sv[j, column] -= sign * gravity
        time = end
        if k == events:
            break
        j, kind = sequence.damper[k], sequence.kind[k]
        body, row = equations.position[j], first + k
        x[n], x[n + 1], x[n + 2] = np.cos(omega * time), np.sin(omega * time), 1.0
        offset = 0.0
        if kind in (CEILING, CEILING_BOUNCE):
            offset = equations.clearance[j]
        if kind in (SEPARATION, WITH_LAST):
            if kind == SEPARATION:
                residual[row] = a[nq + body] @ x + gravity
                if derivatives:
                    jacobian[row] = a[nq + body, :n] @ sx
                    jacobian[row, row] += omega * (a[nq + body, n + 1] * x[n] - a[nq + body, n] * x[n + 1])
            else:
                residual[row] = time - (unknowns[row - 1] if k > 0 else 0.0)
                if derivatives:
                    jacobian[row, row] = 1.0
                    if k > 0:
                        jacobian[row, row - 1] = -1.0
            height[j] = x[body] + (equations.clearance[j] if sequence.wall[k, j] == 2 else 0.0)
            speed[j] = x[nq + body]
            if derivatives:
                sh[j], sv[j] = sx[body], sx[nq + body]
            continue
        residual[row] = height[j] - x[body] - offset
        inverse = equations.inverse_mass[sequence.slot[k]]
        share = 1.0 / (1.0 / equations.mass[j] + inverse[body, body])
        relative = speed[j] - x[nq + body]
        closing[k] = relative if offset > 0.0 else -relative
        height[j] = x[body] + offset
        if derivatives:
            jacobian[row] = sh[j] - sx[body]
            change = sv[j] - sx[nq + body]
            for i in range(nq):
                sx[nq + i] += inverse[i, body] * share * change
            sv[j] = sv[j] - share / equations.mass[j] * change
            sh[j] = sx[body].copy()
        for i in range(nq):
            x[nq + i] += inverse[i, body] * share * relative
        speed[j] -= share / equations.mass[j] * relative
    residual[:n] = x[:n] - unknowns[:n]
    if derivatives:
        jacobian[:n] = sx
        for i in range(n):
            jacobian[i, i] -= 1.0
    at = n
    for j in range(nd):
        if sequence.wall[0, j] == 0:
            residual[at], residual[at + 1] = height[j] - unknowns[at], speed[j] - unknowns[at + 1]
            if derivatives:
                jacobian[at], jacobian[at + 1] = sh[j], sv[j]
                jacobian[at, at] -= 1.0
                jacobian[at + 1, at + 1] -= 1.0
            at += 2
    return residual, jacobian, states, closing


@njit(cache=True)
def sample(
    equations: Equations, sequence: Sequence, period: float, instants: Array, states: Array, points: int
) -> tuple[Array, Array, Array, NDArray[np.complex128]]:
    """Follow an orbit between its events at evenly spaced instants of every stretch.

    The stretch after the last event goes on into the next period until the first event.

    Parameters
    ----------
    equations, sequence, period
        As in `shoot`.
    instants : ndarray, shape (events,)
        Instants of the events.
    states : ndarray, shape (events + 1, states + 2 dampers)
        As `shoot` returns them.
    points : int
        Intervals in each stretch.

    Returns
    -------
    times : ndarray, shape (stretches, points + 1)
    motion : ndarray, shape (stretches, points + 1, states)
    harmonic : complex ndarray, shape (states,), the last of the four
        Integral of the state times exp(-i w t) over the orbit.
    guards : ndarray, shape (stretches, points + 1, dampers, 2)
        For each damper and its slope in time: the gap in flight [m], or q'' + g of the body while riding
        [m/s^2].
    """
    n = equations.generator.shape[1] - 3
    nq, nd = equations.inverse_mass.shape[1], equations.position.shape[0]
    events = sequence.kind.shape[0]
    stretches = max(events, 1)
    times = np.zeros((stretches, points + 1))
    motion = np.zeros((stretches, points + 1, n))
    guards = np.zeros((stretches, points + 1, nd, 2))
    harmonic = np.zeros(n, dtype=np.complex128)
    # Y = exp(i w t) times the integral of x exp(-i w t) obeys Y' = i w Y + x: with it the integral is exact.
    beside = np.zeros((3 * n + 3, 3 * n + 3))
    for i in range(n):
        beside[n + 3 + i, i] = 1.0
        beside[n + 3 + i, 2 * n + 3 + i], beside[2 * n + 3 + i, n + 3 + i] = -equations.omega, equations.omega
    for s in range(stretches):
        k = s + 1 if events > 0 else 0
        begin = instants[s] if events > 0 else 0.0
        end = period
        if events > 0:
            end = instants[s + 1] if s + 1 < events else period + instants[0]
        a = equations.generator[sequence.slot[k]]
        step = (end - begin) / points
        flow = exponential(a, step)
        x = np.ones(n + 3)
        x[:n] = states[k, :n]
        x[n], x[n + 1] = np.cos(equations.omega * begin), np.sin(equations.omega * begin)
        beside[: n + 3, : n + 3] = a
        gathered = np.ascontiguousarray(exponential(beside, end - begin)[n + 3 :, : n + 3]) @ x
        turned = np.exp(-1j * equations.omega * end)
        for i in range(n):
            harmonic[i] += turned * (gathered[i] + 1j * gathered[n + i])
        for i in range(points + 1):
            rate = a @ x
            times[s, i] = begin + i * step
            motion[s, i] = x[:n]
            for j in range(nd):
                body = equations.position[j]
                if sequence.wall[k, j] == 0:
                    t = i * step
                    fallen = states[k, n + j] + (states[k, n + nd + j] - 0.5 * equations.gravity * t) * t
                    guards[s, i, j, 0] = fallen - x[body]
                    guards[s, i, j, 1] = states[k, n + nd + j] - equations.gravity * t - x[nq + body]
                else:
                    guards[s, i, j, 0] = rate[nq + body] + equations.gravity
                    guards[s, i, j, 1] = a[nq + body] @ rate
            x = flow @ x
    return times, motion, guards, harmonic
