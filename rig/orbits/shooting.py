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
from rig.numerics.jit import cached_njit
from rig.orbits import event_kinds as kinds
from rig.orbits.matrix_exponential import exponential, exponential_slope
from rig.orbits.orbit_equations import Change, Equations, Sequence


class ShootingResult(NamedTuple):
    """Result of an evaluation: residual, Jacobian and states."""

    residual: Array  # Periodicity, then the events' conditions; shape (unknowns,)
    jacobian: Array
    """Derivatives of the residual; the last column is for the parameter; shape (unknowns, unknowns + 1)."""
    states: Array
    """State, heights and velocities at the start of each segment; shape (events + 1, states + 2 dampers)."""
    closing: Array  # Closing speed of each impact [m/s]; shape (events,)


class MotionState(NamedTuple):
    """Motion at the current instant, with derivatives with respect to the unknowns and, last, the parameter."""

    x: Array  # State; cos wt, sin wt; 1; shape (states + 3,)
    height: Array
    speed: Array  # height, speed: of the dampers; shape (dampers,)
    dx: Array  # shape (states, unknowns + 1)
    dheight: Array
    dspeed: Array  # dheight, dspeed: shape (dampers, unknowns + 1)


@cached_njit
def _start(sequence: Sequence, unknowns: Array, states: int) -> tuple[MotionState, int]:
    """Return the motion at t = 0, and the index of the first instant among the unknowns."""
    dampers, size = sequence.wall.shape[1], unknowns.shape[0]
    motion = MotionState(
        np.zeros(states + 3), np.zeros(dampers), np.zeros(dampers),
        np.zeros((states, size + 1)), np.zeros((dampers, size + 1)), np.zeros((dampers, size + 1)),
    )  # fmt: skip
    motion.x[:states] = unknowns[:states]
    motion.x[states], motion.x[states + 2] = 1.0, 1.0
    for i in range(states):
        motion.dx[i, i] = 1.0
    index = states
    for j in range(dampers):
        if sequence.wall[0, j] == kinds.FLYING:
            motion.height[j], motion.speed[j] = unknowns[index], unknowns[index + 1]
            motion.dheight[j, index] = 1.0
            motion.dspeed[j, index + 1] = 1.0
            index += 2
    return motion, index


@cached_njit
def _propagate(
    equations: Equations, change: Change, config: int, motion: MotionState, time: float, end: float,
    start_col: int, end_col: int, dend: float,
) -> None:  # fmt: skip
    """Propagate the motion between two instants: x -> exp(A (t1 - t0)) x, dampers fall freely.

    `start_col` is the column of the instant at the start of the segment, negative for t = 0, which is not an
    unknown. `end_col` is the column of the unknown that determines the end of the segment. `dend` is the
    derivative of the end with respect to it.
    """
    n, size, duration = motion.dx.shape[0], motion.dx.shape[1] - 1, end - time
    x, dx, a = motion.x, motion.dx, equations.generator[config]
    initial, dinitial = x.copy(), np.zeros(n + 3)
    flow = exponential(a, duration, equations.rate[config])
    x[:] = flow @ initial
    dinitial[:n] = dx[:, size]
    dinitial[n], dinitial[n + 1] = -time * change.omega * initial[n + 1], time * change.omega * initial[n]
    dx[:] = np.ascontiguousarray(flow[:n, :n]) @ dx
    dx[:, size] = exponential_slope(a, change.generator[config], initial, dinitial, duration, equations.rate[config])[
        :n
    ]
    for i in range(n):
        rate = 0.0
        for m in range(n + 3):
            rate += a[i, m] * x[m]
        dx[i, end_col] += dend * rate
        if start_col >= 0:
            drive_rate = equations.omega * (flow[i, n + 1] * initial[n] - flow[i, n] * initial[n + 1])
            dx[i, start_col] += drive_rate - rate
    for j in range(motion.height.shape[0]):
        motion.height[j] += (motion.speed[j] - 0.5 * equations.gravity * duration) * duration
        motion.speed[j] -= equations.gravity * duration
        for c in range(size + 1):
            motion.dheight[j, c] += duration * motion.dspeed[j, c]
        motion.dheight[j, end_col] += dend * motion.speed[j]
        motion.dspeed[j, end_col] -= dend * equations.gravity
        if start_col >= 0:
            motion.dheight[j, start_col] -= motion.speed[j]
            motion.dspeed[j, start_col] += equations.gravity


@cached_njit
def _contact_force_condition(
    equations: Equations,
    change: Change,
    config: int,
    body: int,
    motion: MotionState,
    time: float,
    row: int,
    jacobian: Array,
) -> float:
    """Return body acceleration plus gravity, zero at zero contact force, and write its derivatives into a row."""
    n, size, x, dx = motion.dx.shape[0], motion.dx.shape[1] - 1, motion.x, motion.dx
    acc_row = equations.inverse_mass.shape[1] + body
    force, residual = equations.generator[config, acc_row], equations.gravity
    for m in range(n + 3):
        residual += force[m] * x[m]
        jacobian[row, size] += change.generator[config, acc_row, m] * x[m]
    for c in range(size + 1):
        for m in range(n):
            jacobian[row, c] += force[m] * dx[m, c]
    drive_rate = force[n + 1] * x[n] - force[n] * x[n + 1]
    jacobian[row, row] += equations.omega * drive_rate
    jacobian[row, size] += time * change.omega * drive_rate
    return residual


@cached_njit
def _separate(equations: Equations, change: Change, wall: int, j: int, motion: MotionState) -> None:
    """Set height and velocity of damper j at separation to those of its wall."""
    body, nq = equations.body_coordinate[j], equations.inverse_mass.shape[1]
    motion.height[j], motion.speed[j] = motion.x[body], motion.x[nq + body]
    motion.dheight[j], motion.dspeed[j] = motion.dx[body], motion.dx[nq + body]
    if wall == kinds.RIDES_CEILING:
        motion.height[j] += equations.clearance[j]
        motion.dheight[j, motion.dx.shape[1] - 1] += change.clearance[j]


@cached_njit
def _apply_impact(
    equations: Equations, change: Change, config: int, kind: int, j: int, motion: MotionState, row: int, jacobian: Array
) -> tuple[float, float]:
    """Apply the impact of damper j on a wall; return the gap, which must be zero, and the closing speed.

    The impulse is (1 + e) v_rel / (1 / m_d + e_b M^-1 e_b) with restitution e, zero unless it bounces.
    """
    body, nq, size = equations.body_coordinate[j], equations.inverse_mass.shape[1], motion.dx.shape[1] - 1
    x, dx, dheight, dspeed = motion.x, motion.dx, motion.dheight, motion.dspeed
    offset, offset_derivative = 0.0, 0.0
    if kind in (kinds.CEILING, kinds.CEILING_BOUNCE):
        offset, offset_derivative = equations.clearance[j], change.clearance[j]
    gap = motion.height[j] - x[body] - offset
    rebound = 1.0
    if kind in (kinds.FLOOR_BOUNCE, kinds.CEILING_BOUNCE):
        rebound += equations.restitution[j]
    inverse, inverse_change = equations.inverse_mass[config], change.inverse_mass[config]
    gain = rebound / (1.0 / equations.mass[j] + inverse[body, body])
    inverse_mass_decrease = change.mass[j] / equations.mass[j] ** 2
    gain_derivative = gain * gain / rebound * (inverse_mass_decrease - inverse_change[body, body])
    relative_speed = motion.speed[j] - x[nq + body]
    for c in range(size + 1):
        jacobian[row, c] = dheight[j, c] - dx[body, c]
        relative_speed_derivative = dspeed[j, c] - dx[nq + body, c]
        impulse = gain * relative_speed_derivative
        if c == size:
            jacobian[row, c] -= offset_derivative
            impulse += gain_derivative * relative_speed
            for i in range(nq):
                dx[nq + i, c] += inverse_change[i, body] * gain * relative_speed
            dspeed[j, c] += gain * relative_speed * inverse_mass_decrease
        for i in range(nq):
            dx[nq + i, c] += inverse[i, body] * impulse
        dspeed[j, c] -= impulse / equations.mass[j]
        dheight[j, c] = dx[body, c]
    motion.height[j] = x[body] + offset
    dheight[j, size] += offset_derivative
    for i in range(nq):
        x[nq + i] += inverse[i, body] * gain * relative_speed
    motion.speed[j] -= gain / equations.mass[j] * relative_speed
    return gap, relative_speed if offset > 0.0 else -relative_speed


@cached_njit
def _change_contact(
    equations: Equations, change: Change, kind: int, wall: int, j: int, motion: MotionState, row: int, jacobian: Array
) -> tuple[float, float]:
    """Change the finite-duration contact of damper j; return its event condition and the closing speed.

    With gap z, and gap o at which the wall is touched, the condition of a touch is z - o = 0. The wall's force is zero
    at z - o + (c / k) z' = 0.
    """
    size, bed = motion.dx.shape[1] - 1, equations.bed[j]
    speed_index = equations.inverse_mass.shape[1] + bed
    ceiling = kind in (kinds.TOUCH_CEILING, kinds.PRESS_CEILING) or (kind == kinds.RELEASE and wall == kinds.ON_CEILING)
    wall_index = 1 if ceiling else 0
    speed, decay_time = motion.x[speed_index], 0.0
    residual = motion.x[bed]
    if kind not in (kinds.TOUCH_FLOOR, kinds.TOUCH_CEILING):
        decay_time = equations.damping[j, wall_index] / equations.stiffness[j, wall_index]
        damping_derivative = change.damping[j, wall_index] - decay_time * change.stiffness[j, wall_index]
        jacobian[row, size] += speed * damping_derivative / equations.stiffness[j, wall_index]
    if ceiling:
        residual -= equations.clearance[j]
        jacobian[row, size] -= change.clearance[j]
    for c in range(size + 1):
        jacobian[row, c] += motion.dx[bed, c] + decay_time * motion.dx[speed_index, c]
    closing = speed if ceiling else -speed
    return residual + decay_time * speed, 0.0 if kind == kinds.RELEASE else max(closing, 0.0)


@cached_njit
def _write_periodicity(
    sequence: Sequence, unknowns: Array, motion: MotionState, residual: Array, jacobian: Array
) -> None:
    """Write the rows of periodicity, for the state and for dampers in flight at the start."""
    index = motion.dx.shape[0]
    for i in range(index):
        residual[i] = motion.x[i] - unknowns[i]
        jacobian[i] = motion.dx[i]
        jacobian[i, i] -= 1.0
    for j in range(motion.height.shape[0]):
        if sequence.wall[0, j] == kinds.FLYING:
            residual[index] = motion.height[j] - unknowns[index]
            residual[index + 1] = motion.speed[j] - unknowns[index + 1]
            jacobian[index], jacobian[index + 1] = motion.dheight[j], motion.dspeed[j]
            jacobian[index, index] -= 1.0
            jacobian[index + 1, index + 1] -= 1.0
            index += 2


@cached_njit
def shoot(equations: Equations, change: Change, sequence: Sequence, unknowns: Array) -> ShootingResult:
    """Evaluate the equations of an orbit.

    `change`: derivatives with respect to the parameter; `unknowns`, shape (unknowns,): state at t = 0, height and
    velocity of each damper in flight there (in order), instants of the events [s].
    """
    n, nd = equations.generator.shape[1] - 3, equations.body_coordinate.shape[0]
    events, size, omega = sequence.kind.shape[0], unknowns.shape[0], equations.omega
    motion, first_row = _start(sequence, unknowns, n)
    residual, jacobian = np.zeros(size), np.zeros((size, size + 1))
    states, closing = np.zeros((events + 1, n + 2 * nd)), np.zeros(events)
    time = 0.0
    for k in range(events + 1):
        states[k, :n] = motion.x[:n]
        states[k, n : n + nd] = motion.height
        states[k, n + nd :] = motion.speed
        config, row = sequence.configuration[k], first_row + k
        previous_row = row - 1 if k > 0 else -1
        if k == events:
            # The last segment ends with the period, which the parameter may change.
            _propagate(equations, change, config, motion, time, equations.period, previous_row, size, change.period)
            break
        event_time = unknowns[row]
        _propagate(equations, change, config, motion, time, event_time, previous_row, row, 1.0)
        time = event_time
        motion.x[n], motion.x[n + 1], motion.x[n + 2] = np.cos(omega * time), np.sin(omega * time), 1.0
        j, kind = sequence.damper[k], sequence.kind[k]
        if kind == kinds.SEPARATION:
            body = equations.body_coordinate[j]
            residual[row] = _contact_force_condition(equations, change, config, body, motion, time, row, jacobian)
            _separate(equations, change, sequence.wall[k, j], j, motion)
        elif kind == kinds.WITH_PREVIOUS:
            residual[row] = time - (unknowns[row - 1] if k > 0 else 0.0)
            jacobian[row, row] = 1.0
            if k > 0:
                jacobian[row, row - 1] = -1.0
            _separate(equations, change, sequence.wall[k, j], j, motion)
        elif kind >= kinds.TOUCH_FLOOR:
            residual[row], closing[k] = _change_contact(
                equations, change, kind, sequence.wall[k, j], j, motion, row, jacobian
            )
        else:
            residual[row], closing[k] = _apply_impact(equations, change, config, kind, j, motion, row, jacobian)
    _write_periodicity(sequence, unknowns, motion, residual, jacobian)
    return ShootingResult(residual, jacobian, states, closing)
