"""Shooting over a given sequence of events: final state of an orbit, and its sensitivity to the initial state.

Between events the state x = (coordinates, velocities, coil current; cos wt, sin wt; 1) satisfies x' = A x, where A
depends on the contact configuration, so the matrix exponential propagates it. Dampers in flight fall freely. Riding
dampers are part of A, and so are dampers with finite-duration contact. The unknowns are the state at the start of a
period, the dampers in flight there, and the instants of the events. The equations are periodicity and the condition
of each event (contact force or gap zero). Sensitivities to the unknowns and to one parameter are propagated through
the events. The elimination of the instants from the Jacobian is equivalent to the use of saltation matrices, so the
same Jacobian determines the Floquet multipliers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rig.arrays import Array
from rig.numerics.jit import stored
from rig.orbits.matrix_exponential import drift, exponential
from rig.orbits.orbit_equations import (
    CEILING,
    CEILING_BOUNCE,
    FLOOR_BOUNCE,
    ON_CEILING,
    PRESS_CEILING,
    RELEASE,
    SEPARATION,
    TOUCH_CEILING,
    TOUCH_FLOOR,
    WITH_LAST,
    Change,
    Equations,
    Sequence,
)


class Shot(NamedTuple):
    """Result of a shot: residual, Jacobian and states."""

    residual: Array
    """Periodicity, then the events' conditions; shape (unknowns,)."""
    jacobian: Array
    """Derivatives of the residual; the last column is for the parameter; shape (unknowns, unknowns + 1)."""
    states: Array
    """State, heights and velocities at the start of each stretch; shape (events + 1, states + 2 dampers)."""
    closing: Array
    """Closing speed of each impact [m/s]; shape (events,)."""


class Course(NamedTuple):
    """Motion at the current instant, with derivatives by the unknowns and, in the last column, the parameter."""

    x: Array
    """State; cos wt, sin wt; 1; shape (states + 3,)."""
    height: Array
    speed: Array
    """height, speed: of the dampers; shape (dampers,)."""
    of_x: Array
    """shape (states, unknowns + 1)."""
    of_height: Array
    of_speed: Array
    """of_height, of_speed: shape (dampers, unknowns + 1)."""


@stored
def _start(sequence: Sequence, unknowns: Array, states: int) -> tuple[Course, int]:
    """Return the motion at t = 0, and the index of the first instant among the unknowns."""
    dampers, size = sequence.wall.shape[1], unknowns.shape[0]
    course = Course(
        np.zeros(states + 3), np.zeros(dampers), np.zeros(dampers),
        np.zeros((states, size + 1)), np.zeros((dampers, size + 1)), np.zeros((dampers, size + 1)),
    )  # fmt: skip
    course.x[:states] = unknowns[:states]
    course.x[states], course.x[states + 2] = 1.0, 1.0
    for i in range(states):
        course.of_x[i, i] = 1.0
    at = states
    for j in range(dampers):
        if sequence.wall[0, j] == 0:
            course.height[j], course.speed[j] = unknowns[at], unknowns[at + 1]
            course.of_height[j, at] = 1.0
            course.of_speed[j, at + 1] = 1.0
            at += 2
    return course, at


@stored
def _propagate(
    equations: Equations, change: Change, slot: int, course: Course, time: float, end: float, last: int, column: int,
    moved: float,
) -> None:  # fmt: skip
    """Propagate the motion between two instants: x -> exp(A (t1 - t0)) x, dampers fall freely.

    `last` is the column of the instant at the start of the stretch, negative for t = 0, which is not an unknown.
    `column` is the column of the instant at its end, whose derivative by this unknown is `moved`.
    """
    n, size, length = course.of_x.shape[0], course.of_x.shape[1] - 1, end - time
    x, sx, a = course.x, course.of_x, equations.generator[slot]
    begun, turn = x.copy(), np.zeros(n + 3)
    flow = exponential(a, length, equations.rate[slot])
    x[:] = flow @ begun
    turn[:n] = sx[:, size]
    turn[n], turn[n + 1] = -time * change.omega * begun[n + 1], time * change.omega * begun[n]
    sx[:] = np.ascontiguousarray(flow[:n, :n]) @ sx
    sx[:, size] = drift(a, change.generator[slot], begun, turn, length, equations.rate[slot])[:n]
    for i in range(n):
        rate = 0.0
        for m in range(n + 3):
            rate += a[i, m] * x[m]
        sx[i, column] += moved * rate
        if last >= 0:
            turned = equations.omega * (flow[i, n + 1] * begun[n] - flow[i, n] * begun[n + 1])
            sx[i, last] += turned - rate
    for j in range(course.height.shape[0]):
        course.height[j] += (course.speed[j] - 0.5 * equations.gravity * length) * length
        course.speed[j] -= equations.gravity * length
        for c in range(size + 1):
            course.of_height[j, c] += length * course.of_speed[j, c]
        course.of_height[j, column] += moved * course.speed[j]
        course.of_speed[j, column] -= moved * equations.gravity
        if last >= 0:
            course.of_height[j, last] -= course.speed[j]
            course.of_speed[j, last] += equations.gravity


@stored
def _weightless(
    equations: Equations,
    change: Change,
    slot: int,
    body: int,
    course: Course,
    time: float,
    row: int,
    jacobian: Array,
) -> float:
    """Return body acceleration plus gravity, zero at zero contact force, and write its derivatives into a row."""
    n, size, x, sx = course.of_x.shape[0], course.of_x.shape[1] - 1, course.x, course.of_x
    place = equations.inverse_mass.shape[1] + body
    force, residual = equations.generator[slot, place], equations.gravity
    for m in range(n + 3):
        residual += force[m] * x[m]
        jacobian[row, size] += change.generator[slot, place, m] * x[m]
    for c in range(size + 1):
        for m in range(n):
            jacobian[row, c] += force[m] * sx[m, c]
    tilt = force[n + 1] * x[n] - force[n] * x[n + 1]
    jacobian[row, row] += equations.omega * tilt
    jacobian[row, size] += time * change.omega * tilt
    return residual


@stored
def _leave(equations: Equations, change: Change, wall: int, j: int, course: Course) -> None:
    """Set height and velocity of damper j at separation to those of its wall."""
    body, nq = equations.position[j], equations.inverse_mass.shape[1]
    course.height[j], course.speed[j] = course.x[body], course.x[nq + body]
    course.of_height[j], course.of_speed[j] = course.of_x[body], course.of_x[nq + body]
    if wall == 2:
        course.height[j] += equations.clearance[j]
        course.of_height[j, course.of_x.shape[1] - 1] += change.clearance[j]


@stored
def _hit(
    equations: Equations,
    change: Change,
    slot: int,
    kind: int,
    j: int,
    course: Course,
    row: int,
    jacobian: Array,
) -> tuple[float, float]:
    """Apply the impact of damper j on a wall; return the gap, which must be zero, and the closing speed.

    The impulse is (1 + e) v_rel / (1 / m_d + e_b M^-1 e_b) with restitution e, zero unless it bounces.
    """
    body, nq, size = equations.position[j], equations.inverse_mass.shape[1], course.of_x.shape[1] - 1
    x, sx, sh, sv = course.x, course.of_x, course.of_height, course.of_speed
    offset, raised = 0.0, 0.0
    if kind in (CEILING, CEILING_BOUNCE):
        offset, raised = equations.clearance[j], change.clearance[j]
    gap = course.height[j] - x[body] - offset
    rebound = 1.0
    if kind in (FLOOR_BOUNCE, CEILING_BOUNCE):
        rebound += equations.restitution[j]
    inverse, inverse_change = equations.inverse_mass[slot], change.inverse_mass[slot]
    share = rebound / (1.0 / equations.mass[j] + inverse[body, body])
    thinner = change.mass[j] / equations.mass[j] ** 2
    share_change = share * share / rebound * (thinner - inverse_change[body, body])
    relative = course.speed[j] - x[nq + body]
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
    course.height[j] = x[body] + offset
    sh[j, size] += raised
    for i in range(nq):
        x[nq + i] += inverse[i, body] * share * relative
    course.speed[j] -= share / equations.mass[j] * relative
    return gap, relative if offset > 0.0 else -relative


@stored
def _change_force(
    equations: Equations,
    change: Change,
    kind: int,
    wall: int,
    j: int,
    course: Course,
    row: int,
    jacobian: Array,
) -> tuple[float, float]:
    """Change the finite-duration contact of damper j; return its event condition and the closing speed.

    The condition of a touch is z - o = 0, with gap z and wall position o. The wall's force is zero at
    z - o + (c / k) z' = 0.
    """
    size, bed = course.of_x.shape[1] - 1, equations.bed[j]
    place = equations.inverse_mass.shape[1] + bed
    ceiling = kind in (TOUCH_CEILING, PRESS_CEILING) or (kind == RELEASE and wall == ON_CEILING)
    at = 1 if ceiling else 0
    speed, lag = course.x[place], 0.0
    residual = course.x[bed]
    if kind not in (TOUCH_FLOOR, TOUCH_CEILING):
        lag = equations.damping[j, at] / equations.stiffness[j, at]
        thicker = change.damping[j, at] - lag * change.stiffness[j, at]
        jacobian[row, size] += speed * thicker / equations.stiffness[j, at]
    if ceiling:
        residual -= equations.clearance[j]
        jacobian[row, size] -= change.clearance[j]
    for c in range(size + 1):
        jacobian[row, c] += course.of_x[bed, c] + lag * course.of_x[place, c]
    closing = speed if ceiling else -speed
    return residual + lag * speed, 0.0 if kind == RELEASE else max(closing, 0.0)


@stored
def _return(sequence: Sequence, unknowns: Array, course: Course, residual: Array, jacobian: Array) -> None:
    """Write the rows of periodicity, for the state and for dampers in flight at the start."""
    at = course.of_x.shape[0]
    for i in range(at):
        residual[i] = course.x[i] - unknowns[i]
        jacobian[i] = course.of_x[i]
        jacobian[i, i] -= 1.0
    for j in range(course.height.shape[0]):
        if sequence.wall[0, j] == 0:
            residual[at] = course.height[j] - unknowns[at]
            residual[at + 1] = course.speed[j] - unknowns[at + 1]
            jacobian[at], jacobian[at + 1] = course.of_height[j], course.of_speed[j]
            jacobian[at, at] -= 1.0
            jacobian[at + 1, at + 1] -= 1.0
            at += 2


@stored
def shoot(equations: Equations, change: Change, sequence: Sequence, unknowns: Array) -> Shot:
    """Evaluate the equations of an orbit.

    `change`: derivatives with respect to the parameter; `unknowns`, shape (unknowns,): state at t = 0, height and
    velocity of each damper in flight there (in order), instants of the events [s].
    """
    n, nd = equations.generator.shape[1] - 3, equations.position.shape[0]
    events, size, omega = sequence.kind.shape[0], unknowns.shape[0], equations.omega
    course, first = _start(sequence, unknowns, n)
    residual, jacobian = np.zeros(size), np.zeros((size, size + 1))
    states, closing = np.zeros((events + 1, n + 2 * nd)), np.zeros(events)
    time = 0.0
    for k in range(events + 1):
        states[k, :n] = course.x[:n]
        states[k, n : n + nd] = course.height
        states[k, n + nd :] = course.speed
        slot, row, last = sequence.slot[k], first + k, first + k - 1 if k > 0 else -1
        if k == events:
            # The last stretch ends with the period, which the parameter may change.
            _propagate(equations, change, slot, course, time, equations.period, last, size, change.period)
            break
        end = unknowns[row]
        _propagate(equations, change, slot, course, time, end, last, row, 1.0)
        time = end
        course.x[n], course.x[n + 1], course.x[n + 2] = np.cos(omega * time), np.sin(omega * time), 1.0
        j, kind = sequence.damper[k], sequence.kind[k]
        if kind == SEPARATION:
            body = equations.position[j]
            residual[row] = _weightless(equations, change, slot, body, course, time, row, jacobian)
            _leave(equations, change, sequence.wall[k, j], j, course)
        elif kind == WITH_LAST:
            residual[row] = time - (unknowns[row - 1] if k > 0 else 0.0)
            jacobian[row, row] = 1.0
            if k > 0:
                jacobian[row, row - 1] = -1.0
            _leave(equations, change, sequence.wall[k, j], j, course)
        elif kind >= TOUCH_FLOOR:
            residual[row], closing[k] = _change_force(
                equations, change, kind, sequence.wall[k, j], j, course, row, jacobian
            )
        else:
            residual[row], closing[k] = _hit(equations, change, slot, kind, j, course, row, jacobian)
    _return(sequence, unknowns, course, residual, jacobian)
    return Shot(residual, jacobian, states, closing)
