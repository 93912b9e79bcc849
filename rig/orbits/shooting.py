"""Shooting over a given sequence of events: where an orbit ends, and how that depends on where it begins.

Between events the state x = (coordinates, velocities, coil current; cos wt, sin wt; 1) obeys x' = A x with A
of the contact configuration, so it is propagated by the matrix exponential. Dampers in flight fall freely;
riding ones are part of A. The unknowns are the state at the start of a period, the dampers in flight there,
and the instants of the events; the equations are the return to the start and, at each event, its own
condition (contact force or gap zero). Sensitivities to the unknowns and to one parameter are carried along,
through events as well: solving the events' rows of the Jacobian for the instants is what the saltation matrices
do, so that the Floquet multipliers come out of the same numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.numerics.jit import stored

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

# Kinds of events. A damper that bounces leaves the wall in the instant in which it hits it, with the common
# velocity (osculating contact) or with its rebound; one that leaves `WITH_LAST` is thrown off by the event
# before, at the same instant.
SEPARATION, FLOOR, CEILING, FLOOR_BOUNCE, CEILING_BOUNCE, WITH_LAST = 0, 1, 2, 3, 4, 5

# A solution is accepted when its next correction and its residuals, relative to the motion, are below this.
SETTLED = 3e-13


class Equations(NamedTuple):
    """The equations of motion in every configuration that an orbit visits, for one set of parameters."""

    generator: Array
    """shape (configurations, states + 3, states + 3)."""
    rate: Array
    """Bound on how fast each generator turns or grows what it acts on [1/s]; shape (configurations,)."""
    inverse_mass: Array
    """shape (configurations, coordinates, coordinates)."""
    position: Whole
    """Coordinate of each damper's body; int64, shape (dampers,)."""
    mass: Array
    clearance: Array
    restitution: Array
    """mass, clearance, restitution: shape (dampers,)."""
    gravity: float
    omega: float
    period: float
    """Length of the orbit, a multiple of the drive's period [s]."""


class Change(NamedTuple):
    """Derivatives of the fields of `Equations` with respect to the parameter that is followed."""

    generator: Array
    inverse_mass: Array
    mass: Array
    clearance: Array
    omega: float
    period: float


class Sequence(NamedTuple):
    """Which events happen, in order."""

    kind: Whole
    damper: Whole
    """kind, damper: int64, shape (events,)."""
    slot: Whole
    """Configuration of each stretch: before the first event, between events, after the last; int64, shape
    (events + 1,)."""
    wall: Whole
    """In each stretch: 0 in flight, 1 on the floor, 2 at the ceiling; int64, shape (events + 1, dampers)."""


class Shot(NamedTuple):
    """What a shot found."""

    residual: Array
    """Return to the start, then the events' own conditions; shape (unknowns,)."""
    jacobian: Array
    """Of the residual; the last column is for the parameter; shape (unknowns, unknowns + 1)."""
    states: Array
    """State, heights and velocities at the begin of each stretch; shape (events + 1, states + 2 dampers)."""
    closing: Array
    """Closing speed of each impact [m/s]; shape (events,)."""


@stored
def exponential(matrix: Array, time: float, rate: float) -> Array:
    """Matrix exponential of `matrix` times `time`, by a Taylor series with scaling and squaring.

    `rate` bounds a norm of the matrix in which its rows and columns are balanced.
    """
    size, halvings = rate * abs(time), 0
    while size > 0.25 and halvings < 60:
        size *= 0.5
        halvings += 1
    x = matrix * (time * 0.5**halvings)
    # To degree 12, summed in three products of cubes. The sum without the identity, so that small times keep
    # their last bits: squaring maps s to 2 s + s s.
    square = x @ x
    cube = square @ x
    total = x / 3628800.0 + square / 39916800.0 + cube / 479001600.0
    total = cube @ total + (x / 5040.0 + square / 40320.0 + cube / 362880.0)
    total = cube @ total + (x / 24.0 + square / 120.0 + cube / 720.0)
    total = cube @ total + (x + square / 2.0 + cube / 6.0)
    for _ in range(halvings):
        total = 2.0 * total + total @ total
    for i in range(matrix.shape[0]):
        total[i, i] += 1.0
    return total


@stored
def _drift(matrix: Array, change: Array, start: Array, slope: Array, time: float, rate: float) -> Array:
    """Differentiate exp(matrix time) start, matrix and start both changing: s' = A s + E z, s(0) = slope."""
    n = matrix.shape[0]
    entries, row, column = 0, np.empty(n * n, dtype=np.int64), np.empty(n * n, dtype=np.int64)
    of_matrix, of_change = np.empty(n * n), np.empty(n * n)
    for i in range(n):
        for j in range(n):
            if matrix[i, j] != 0.0 or change[i, j] != 0.0:
                row[entries], column[entries] = i, j
                of_matrix[entries], of_change[entries] = matrix[i, j], change[i, j]
                entries += 1
    z, s = start.copy(), slope.copy()
    substeps = max(1, int(np.ceil(0.5 * rate * abs(time))))
    h = time / substeps
    term, other, next_term, next_other = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for _ in range(substeps):
        term[:], other[:] = z, s
        # 2^20 / 20! is 4e-13, which a derivative does not need to know better.
        for k in range(1, 21):
            next_term[:], next_other[:] = 0.0, 0.0
            for m in range(entries):
                i, j = row[m], column[m]
                next_term[i] += of_matrix[m] * term[j]
                next_other[i] += of_matrix[m] * other[j] + of_change[m] * term[j]
            for i in range(n):
                term[i], other[i] = h / k * next_term[i], h / k * next_other[i]
                z[i] += term[i]
                s[i] += other[i]
    return s


@stored
def shoot(equations: Equations, change: Change, sequence: Sequence, unknowns: Array) -> Shot:
    """Evaluate the equations of an orbit.

    Parameters
    ----------
    change : Change
        With the parameter.
    unknowns : ndarray, shape (unknowns,)
        State at t = 0, height and velocity of each damper in flight there (in order), instants of the events
        [s].
    """
    n = equations.generator.shape[1] - 3
    nq, nd = equations.inverse_mass.shape[1], equations.position.shape[0]
    events, size = sequence.kind.shape[0], unknowns.shape[0]
    omega, gravity = equations.omega, equations.gravity
    x, begun, turn = np.zeros(n + 3), np.zeros(n + 3), np.zeros(n + 3)
    x[:n] = unknowns[:n]
    height, speed = np.zeros(nd), np.zeros(nd)
    # Sensitivities of state, heights and speeds; the last column is that to the parameter.
    sx, sh, sv = np.zeros((n, size + 1)), np.zeros((nd, size + 1)), np.zeros((nd, size + 1))
    for i in range(n):
        sx[i, i] = 1.0
    at = n
    for j in range(nd):
        if sequence.wall[0, j] == 0:
            height[j], speed[j] = unknowns[at], unknowns[at + 1]
            sh[j, at] = 1.0
            sv[j, at + 1] = 1.0
            at += 2
    first = at
    residual, jacobian = np.zeros(size), np.zeros((size, size + 1))
    states, closing = np.zeros((events + 1, n + 2 * nd)), np.zeros(events)
    time = 0.0
    x[n], x[n + 1], x[n + 2] = 1.0, 0.0, 1.0
    for k in range(events + 1):
        states[k, :n] = x[:n]
        states[k, n : n + nd] = height
        states[k, n + nd :] = speed
        end = unknowns[first + k] if k < events else equations.period
        slot, length = sequence.slot[k], end - time
        a = equations.generator[slot]
        flow = exponential(a, length, equations.rate[slot])
        begun[:] = x
        x[:] = flow @ begun
        turn[:n] = sx[:, size]
        turn[n], turn[n + 1] = -time * change.omega * begun[n + 1], time * change.omega * begun[n]
        sx[:] = np.ascontiguousarray(flow[:n, :n]) @ sx
        sx[:, size] = _drift(a, change.generator[slot], begun, turn, length, equations.rate[slot])[:n]
        for j in range(nd):
            height[j] += (speed[j] - 0.5 * gravity * length) * length
            speed[j] -= gravity * length
            for c in range(size + 1):
                sh[j, c] += length * sv[j, c]
        # The stretch ends at its own unknown instant, or with the period, which the parameter may change; it
        # begins at the last event's.
        column, moved = (first + k, 1.0) if k < events else (size, change.period)
        for i in range(n):
            rate = 0.0
            for m in range(n + 3):
                rate += a[i, m] * x[m]
            sx[i, column] += moved * rate
            if k > 0:
                turned = omega * (flow[i, n + 1] * begun[n] - flow[i, n] * begun[n + 1])
                sx[i, first + k - 1] += turned - rate
        for j in range(nd):
            sh[j, column] += moved * speed[j]
            sv[j, column] -= moved * gravity
            if k > 0:
                sh[j, first + k - 1] -= speed[j]
                sv[j, first + k - 1] += gravity
        time = end
        if k == events:
            break
        x[n], x[n + 1], x[n + 2] = np.cos(omega * time), np.sin(omega * time), 1.0
        j, kind = sequence.damper[k], sequence.kind[k]
        body, row = equations.position[j], first + k
        if kind in (SEPARATION, WITH_LAST):
            if kind == SEPARATION:
                force = a[nq + body]
                residual[row] = gravity
                for m in range(n + 3):
                    residual[row] += force[m] * x[m]
                    jacobian[row, size] += change.generator[slot, nq + body, m] * x[m]
                for c in range(size + 1):
                    for m in range(n):
                        jacobian[row, c] += force[m] * sx[m, c]
                tilt = force[n + 1] * x[n] - force[n] * x[n + 1]
                jacobian[row, row] += omega * tilt
                jacobian[row, size] += time * change.omega * tilt
            else:
                residual[row] = time - (unknowns[row - 1] if k > 0 else 0.0)
                jacobian[row, row] = 1.0
                if k > 0:
                    jacobian[row, row - 1] = -1.0
            height[j], speed[j] = x[body], x[nq + body]
            sh[j], sv[j] = sx[body], sx[nq + body]
            if sequence.wall[k, j] == 2:
                height[j] += equations.clearance[j]
                sh[j, size] += change.clearance[j]
            continue
        offset, raised = 0.0, 0.0
        if kind in (CEILING, CEILING_BOUNCE):
            offset, raised = equations.clearance[j], change.clearance[j]
        residual[row] = height[j] - x[body] - offset
        rebound = 1.0
        if kind in (FLOOR_BOUNCE, CEILING_BOUNCE):
            rebound += equations.restitution[j]
        inverse, inverse_change = equations.inverse_mass[slot], change.inverse_mass[slot]
        share = rebound / (1.0 / equations.mass[j] + inverse[body, body])
        thinner = change.mass[j] / equations.mass[j] ** 2
        share_change = share * share / rebound * (thinner - inverse_change[body, body])
        relative = speed[j] - x[nq + body]
        closing[k] = relative if offset > 0.0 else -relative
        for c in range(size + 1):
            jacobian[row, c] = sh[j, c] - sx[body, c]
            opened = sv[j, c] - sx[nq + body, c]
            impulse = share * opened
            if c == size:
                jacobian[row, c] -= raised
                impulse += share_change * relative
                for i in range(nq):
                    sx[nq + i, c] += inverse_change[i, body] * share * relative
                sv[j, c] += share * relative * thinner
            for i in range(nq):
                sx[nq + i, c] += inverse[i, body] * impulse
            sv[j, c] -= impulse / equations.mass[j]
            sh[j, c] = sx[body, c]
        height[j] = x[body] + offset
        sh[j, size] += raised
        for i in range(nq):
            x[nq + i] += inverse[i, body] * share * relative
        speed[j] -= share / equations.mass[j] * relative
    for i in range(n):
        residual[i] = x[i] - unknowns[i]
        jacobian[i] = sx[i]
        jacobian[i, i] -= 1.0
    at = n
    for j in range(nd):
        if sequence.wall[0, j] == 0:
            residual[at], residual[at + 1] = height[j] - unknowns[at], speed[j] - unknowns[at + 1]
            jacobian[at], jacobian[at + 1] = sh[j], sv[j]
            jacobian[at, at] -= 1.0
            jacobian[at + 1, at + 1] -= 1.0
            at += 2
    return Shot(residual, jacobian, states, closing)


@stored
def correct(
    equations: Equations,
    change: Change,
    sequence: Sequence,
    unknowns: Array,
    scale: Array,
    rows: Array,
    most: int,
) -> tuple[Array, Array, Shot, float, int]:
    """Solve the equations of an orbit by Newton's iteration, the parameter fixed.

    Parameters
    ----------
    equations, change, sequence, unknowns
        As in `shoot`.
    scale, rows : ndarray, shape (unknowns,)
        Sizes of the unknowns and of the residuals.
    most : int
        Corrections allowed.

    Returns
    -------
    slope : ndarray
        Their derivative with respect to the parameter.
    shot : Shot
        There.
    last : float
        Size of the last correction.
    corrections : int
        How many were made; -1 if they did not settle.
    """
    x, slope, last = unknowns.copy(), np.zeros(unknowns.size), np.inf
    shot = shoot(equations, change, sequence, x)
    for iteration in range(most):
        system = shot.jacobian[:, : x.size].copy()
        right = np.empty((x.size, 2))
        for i in range(x.size):
            right[i, 0], right[i, 1] = -shot.residual[i] / rows[i], -shot.jacobian[i, x.size] / rows[i]
            for j in range(x.size):
                system[i, j] *= scale[j] / rows[i]
        if not (np.isfinite(system).all() and np.isfinite(right).all()):
            return x, slope, shot, last, -1
        solved = np.linalg.solve(system, right)
        move, slope = solved[:, 0], solved[:, 1] * scale
        size = np.abs(move).max()
        missed = np.abs(right[:, 0]).max()
        if (size < SETTLED and missed < SETTLED) or (size < 1e-9 and size > 0.3 * last):
            return x, slope, shot, size, iteration
        # An iteration that runs away is stopped before its instants leave all bounds.
        if not size < 1e3 * min(1.0, max(last, 1e-3)):
            return x, slope, shot, size, -1
        x += move * scale
        last = size
        shot = shoot(equations, change, sequence, x)
    return x, slope, shot, last, -1


@stored
def distance(one: Array, other: Array, scale: Array) -> float:
    """Largest difference between two sets of unknowns, in their scales."""
    return float(np.abs((one - other) / scale).max())


@stored
def monodromy(shot: Shot, events: int, scale: Array, rows: Array) -> Array:
    """Map of deviations over an orbit (scaled): the events' rows are solved for the instants."""
    size = scale.size
    cut = size - events
    jacobian = shot.jacobian[:, :size].copy()
    for i in range(size):
        for j in range(size):
            jacobian[i, j] *= scale[j] / rows[i]
    period_map = jacobian[:cut, :cut].copy()
    for i in range(cut):
        period_map[i, i] += 1.0
    if events > 0:
        moved = np.linalg.solve(jacobian[cut:, cut:].copy(), jacobian[cut:, :cut].copy())
        period_map -= jacobian[:cut, cut:].copy() @ moved
    return period_map
