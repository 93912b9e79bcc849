"""The shooting method for an orbit (a periodic motion) with a given sequence of events: residual and Jacobian.

Between events the state x = (coordinates, velocities, coil current; cos wt, sin wt; 1) satisfies x' = A x, where A
depends on the contact configuration, so the matrix exponential propagates it. Dampers in flight fall freely. Riding
dampers (at rest on a wall) are part of A, and so are dampers with finite-duration contact.

The unknowns are the state at the start of a period, heights and velocities of the dampers in flight there, and the
instants of the events. The equations are periodicity and the condition of each event (contact force or gap zero).
Derivatives with respect to the unknowns and to one parameter are propagated through the events. The elimination of the
instants from the Jacobian is equivalent to the use of saltation matrices, so the same Jacobian determines the Floquet
multipliers.
"""

from typing import NamedTuple

import numpy as np

from rig.core.base.arrays import Array
from rig.core.numerics.jit import cached_njit
from rig.core.orbits import event_kinds as kinds
from rig.core.orbits.matrix_exponential import exponential, exponential_derivative
from rig.core.orbits.orbit_equations import (
    GAP,
    HIGH,
    HOLD,
    LOW,
    SLIDER,
    SPEED,
    EquationDerivatives,
    Equations,
    IndexArray,
    Sequence,
    along_gap,
)


class ShootingResult(NamedTuple):
    """Result of an evaluation of the orbit's equations."""

    residual: Array  # Periodicity, then the events' conditions; shape (unknowns,)
    jacobian: Array
    """Derivatives of the residual; the last column is for the parameter; shape (unknowns, unknowns + 1)."""
    states: Array
    """State, heights and velocities at the start of each segment; shape (events + 1, states + 2 dampers)."""
    closing_speed: Array  # Closing speed of each impact [m/s]; shape (events,)


class MotionState(NamedTuple):
    """Motion at the current instant, and its derivatives: one column for each unknown, the last for the parameter."""

    x: Array  # State; cos wt, sin wt; 1; shape (states + 3,)
    height: Array
    velocity: Array  # `height` [m] and `velocity` [m/s] of the dampers; shape (dampers,)
    dx: Array  # shape (states, unknowns + 1)
    dheight: Array
    dvelocity: Array  # `dheight` and `dvelocity`; shape (dampers, unknowns + 1)


@cached_njit
def _initial_motion(sequence: Sequence, unknowns: Array, states: int) -> tuple[MotionState, int]:
    """Return the motion at t = 0, and the index of the first instant among the unknowns."""
    dampers, n_unknowns = sequence.wall.shape[1], unknowns.shape[0]
    motion = MotionState(
        np.zeros(states + 3), np.zeros(dampers), np.zeros(dampers),
        np.zeros((states, n_unknowns + 1)), np.zeros((dampers, n_unknowns + 1)), np.zeros((dampers, n_unknowns + 1)),
    )  # fmt: skip
    motion.x[:states] = unknowns[:states]
    motion.x[states], motion.x[states + 2] = 1.0, 1.0
    for i in range(states):
        motion.dx[i, i] = 1.0
    index = states
    for j in range(dampers):
        if sequence.wall[0, j] == kinds.FLYING:
            motion.height[j], motion.velocity[j] = unknowns[index], unknowns[index + 1]
            motion.dheight[j, index] = 1.0
            motion.dvelocity[j, index + 1] = 1.0
            index += 2
    return motion, index


@cached_njit
def _propagate(
    equations: Equations, derivatives: EquationDerivatives, configuration: int, motion: MotionState,
    start_time: float, end_time: float, start_column: int, end_column: int, end_derivative: float,
) -> None:  # fmt: skip
    """Propagate the motion between two instants [s]: x -> exp(A (t1 - t0)) x, dampers fall freely.

    `start_column`: column of the start instant among the unknowns; negative for t = 0, which is not an unknown.
    `end_column`: column of the unknown that determines the end instant. `end_derivative`: derivative of the end instant
    with respect to this unknown.
    """
    n, n_unknowns, duration = motion.dx.shape[0], motion.dx.shape[1] - 1, end_time - start_time
    x, dx, a = motion.x, motion.dx, equations.generator[configuration]
    initial, dinitial = x.copy(), np.zeros(n + 3)
    flow = exponential(a, duration, equations.norm_bound[configuration])
    x[:] = flow @ initial
    dinitial[:n] = dx[:, n_unknowns]
    dinitial[n] = -start_time * derivatives.omega * initial[n + 1]
    dinitial[n + 1] = start_time * derivatives.omega * initial[n]
    dx[:] = np.ascontiguousarray(flow[:n, :n]) @ dx
    generator_derivative = derivatives.generator[configuration]
    if derivatives.omega != 0.0 or np.any(generator_derivative):
        dx[:, n_unknowns] = exponential_derivative(
            a, generator_derivative, initial, dinitial, duration, equations.norm_bound[configuration]
        )[:n]
    for i in range(n):
        rate = 0.0
        for m in range(n + 3):
            rate += a[i, m] * x[m]
        dx[i, end_column] += end_derivative * rate
        if start_column >= 0:
            drive_rate = equations.omega * (flow[i, n + 1] * initial[n] - flow[i, n] * initial[n + 1])
            dx[i, start_column] += drive_rate - rate
    for j in range(motion.height.shape[0]):
        motion.height[j] += (motion.velocity[j] - 0.5 * equations.gravity * duration) * duration
        motion.velocity[j] -= equations.gravity * duration
        for c in range(n_unknowns + 1):
            motion.dheight[j, c] += duration * motion.dvelocity[j, c]
        motion.dheight[j, end_column] += end_derivative * motion.velocity[j]
        motion.dvelocity[j, end_column] -= end_derivative * equations.gravity
        if start_column >= 0:
            motion.dheight[j, start_column] -= motion.velocity[j]
            motion.dvelocity[j, start_column] += equations.gravity


@cached_njit
def _contact_force_condition(
    equations: Equations, derivatives: EquationDerivatives, configuration: int, j: int, wall: int, motion: MotionState,
    time: float, row: int, jacobian: Array,
) -> float:  # fmt: skip
    """Return the holding force of damper j per mass [m/s²], zero at its separation; write its derivatives into a row.

    `wall`: wall state of the damper.
    """
    n, n_unknowns, x, dx = motion.dx.shape[0], motion.dx.shape[1] - 1, motion.x, motion.dx
    acceleration_row = equations.inverse_mass.shape[1] + equations.body_coordinate[j]
    side = 1 if wall == kinds.RIDES_CEILING else 0
    force, residual = equations.generator[configuration, acceleration_row], equations.hold_offset[j, side]
    jacobian[row, n_unknowns] += derivatives.hold_offset[j, side]
    for m in range(n + 3):
        residual += force[m] * x[m]
        jacobian[row, n_unknowns] += derivatives.generator[configuration, acceleration_row, m] * x[m]
    for c in range(n_unknowns + 1):
        for m in range(n):
            jacobian[row, c] += force[m] * dx[m, c]
    drive_rate = force[n + 1] * x[n] - force[n] * x[n + 1]
    jacobian[row, row] += equations.omega * drive_rate
    jacobian[row, n_unknowns] += time * derivatives.omega * drive_rate
    return residual


@cached_njit
def _separate(equations: Equations, derivatives: EquationDerivatives, wall: int, j: int, motion: MotionState) -> None:
    """Set height and velocity of damper j at separation to those of its wall."""
    if equations.gap_coordinate[j] >= 0:
        return
    body, nq = equations.body_coordinate[j], equations.inverse_mass.shape[1]
    motion.height[j], motion.velocity[j] = motion.x[body], motion.x[nq + body]
    motion.dheight[j], motion.dvelocity[j] = motion.dx[body], motion.dx[nq + body]
    if wall == kinds.RIDES_CEILING:
        motion.height[j] += equations.wall_gap[j, 1]
        motion.dheight[j, motion.dx.shape[1] - 1] += derivatives.wall_gap[j, 1]


@cached_njit
def _apply_impact(
    equations: Equations, derivatives: EquationDerivatives, configuration: int, kind: int, j: int,
    motion: MotionState, row: int, jacobian: Array,
) -> tuple[float, float]:  # fmt: skip
    """Apply the impact of damper j on a wall; return the gap [m], which must be zero, and the closing speed [m/s].

    The impulse is (1 + e) v_rel / (1 / m_d + (M^-1)_bb), with the relative velocity v_rel, the damper's mass m_d and
    its body's diagonal element of the inverse mass matrix. The restitution e is zero unless the event is a bounce.
    """
    body, nq, n_unknowns = equations.body_coordinate[j], equations.inverse_mass.shape[1], motion.dx.shape[1] - 1
    x, dx, dheight, dvelocity = motion.x, motion.dx, motion.dheight, motion.dvelocity
    offset, offset_derivative = 0.0, 0.0
    if kind in (kinds.CEILING, kinds.CEILING_BOUNCE):
        offset, offset_derivative = equations.wall_gap[j, 1], derivatives.wall_gap[j, 1]
    gap = motion.height[j] - x[body] - offset
    one_plus_restitution = 1.0
    if kind in (kinds.FLOOR_BOUNCE, kinds.CEILING_BOUNCE):
        one_plus_restitution += equations.restitution[j]
    inverse, inverse_change = equations.inverse_mass[configuration], derivatives.inverse_mass[configuration]
    impulse_per_speed = one_plus_restitution / (1.0 / equations.mass[j] + inverse[body, body])
    inverse_mass_decrease = derivatives.mass[j] / equations.mass[j] ** 2
    impulse_per_speed_derivative = (
        impulse_per_speed
        * impulse_per_speed
        / one_plus_restitution
        * (inverse_mass_decrease - inverse_change[body, body])
    )
    relative_velocity = motion.velocity[j] - x[nq + body]
    for c in range(n_unknowns + 1):
        jacobian[row, c] = dheight[j, c] - dx[body, c]
        relative_velocity_derivative = dvelocity[j, c] - dx[nq + body, c]
        impulse = impulse_per_speed * relative_velocity_derivative
        if c == n_unknowns:
            jacobian[row, c] -= offset_derivative
            impulse += impulse_per_speed_derivative * relative_velocity
            for i in range(nq):
                dx[nq + i, c] += inverse_change[i, body] * impulse_per_speed * relative_velocity
            dvelocity[j, c] += impulse_per_speed * relative_velocity * inverse_mass_decrease
        for i in range(nq):
            dx[nq + i, c] += inverse[i, body] * impulse
        dvelocity[j, c] -= impulse / equations.mass[j]
        dheight[j, c] = dx[body, c]
    motion.height[j] = x[body] + offset
    dheight[j, n_unknowns] += offset_derivative
    for i in range(nq):
        x[nq + i] += inverse[i, body] * impulse_per_speed * relative_velocity
    motion.velocity[j] -= impulse_per_speed / equations.mass[j] * relative_velocity
    return gap, relative_velocity if offset > 0.0 else -relative_velocity


@cached_njit
def _apply_impact_of_coordinate(
    equations: Equations, derivatives: EquationDerivatives, configuration: int, kind: int, j: int,
    motion: MotionState, row: int, jacobian: Array,
) -> tuple[float, float]:  # fmt: skip
    """Apply an impact as `_apply_impact` does, for a damper whose gap is a coordinate on which the impulse acts."""
    gap, nq, n_unknowns = equations.gap_coordinate[j], equations.inverse_mass.shape[1], motion.dx.shape[1] - 1
    x, dx, speed = motion.x, motion.dx, motion.x[nq + gap]
    is_upper = kind in (kinds.CEILING, kinds.CEILING_BOUNCE)
    side, is_bounce = 1 if is_upper else 0, kind in (kinds.FLOOR_BOUNCE, kinds.CEILING_BOUNCE)
    distance = x[gap] - equations.wall_gap[j, side]
    jacobian[row] = dx[gap]
    jacobian[row, n_unknowns] -= derivatives.wall_gap[j, side]
    one_plus_restitution = 1.0 + (equations.restitution[j] if is_bounce else 0.0)
    inverse, inverse_change = equations.inverse_mass[configuration], derivatives.inverse_mass[configuration]
    dspeed = dx[nq + gap].copy()
    for i in range(nq):
        ratio = one_plus_restitution * inverse[i, gap] / inverse[gap, gap]
        change = one_plus_restitution * inverse_change[i, gap] - ratio * inverse_change[gap, gap]
        x[nq + i] -= ratio * speed
        dx[nq + i] -= ratio * dspeed
        dx[nq + i, n_unknowns] -= change / inverse[gap, gap] * speed
    x[gap], dx[gap] = equations.wall_gap[j, side], 0.0
    dx[gap, n_unknowns] = derivatives.wall_gap[j, side]
    if not is_bounce:
        x[nq + gap], dx[nq + gap] = 0.0, 0.0
    return distance, speed if is_upper else -speed


@cached_njit
def _finite_contact_condition(
    equations: Equations, derivatives: EquationDerivatives, kind: int, wall: int, j: int, motion: MotionState,
    row: int, jacobian: Array,
) -> tuple[float, float]:  # fmt: skip
    """Return the condition [m] of an event of damper j with finite-duration contact, and the closing speed [m/s].

    With the gap g, and the gap g_w at which the wall is touched (0 or the clearance), the condition of a touch is
    g - g_w = 0. The wall's force is zero at g - g_w + (c / k) g' = 0, with the wall's stiffness k and damping c.
    """
    n_unknowns, nq = motion.dx.shape[1] - 1, equations.inverse_mass.shape[1]
    is_upper = kind in (kinds.TOUCH_CEILING, kinds.PRESS_CEILING) or (
        kind == kinds.RELEASE and wall == kinds.ON_CEILING
    )
    wall_index = 1 if is_upper else 0
    gap_rate, relaxation_time = along_gap(equations, j, motion.x[nq:]), 0.0
    residual = along_gap(equations, j, motion.x) - equations.wall_gap[j, wall_index]
    jacobian[row, n_unknowns] -= derivatives.wall_gap[j, wall_index]
    if kind not in (kinds.TOUCH_FLOOR, kinds.TOUCH_CEILING):
        relaxation_time = equations.damping[j, wall_index] / equations.stiffness[j, wall_index]
        damping_derivative = derivatives.damping[j, wall_index] - relaxation_time * derivatives.stiffness[j, wall_index]
        jacobian[row, n_unknowns] += gap_rate * damping_derivative / equations.stiffness[j, wall_index]
    for c in range(n_unknowns + 1):
        gap_derivative, rate_derivative = (
            along_gap(equations, j, motion.dx[:, c]),
            along_gap(equations, j, motion.dx[nq:, c]),
        )
        jacobian[row, c] += gap_derivative + relaxation_time * rate_derivative
    closing_speed = gap_rate if is_upper else -gap_rate
    return residual + relaxation_time * gap_rate, 0.0 if kind == kinds.RELEASE else max(closing_speed, 0.0)


@cached_njit
def signal_of(signals: Array, kind: int) -> tuple[int, int]:
    """Return the signal and the end of its interval (`LOW`, `HIGH`) that an event of a sliding mass reaches.

    `signals`: signals of the regime; `kind`: kind of the event.
    """
    column = HOLD
    if kind in (kinds.STOP, kinds.REVERSE):
        column = SPEED
    elif kind in (kinds.FLOOR, kinds.CEILING, kinds.FLOOR_BOUNCE, kinds.CEILING_BOUNCE):
        column = GAP
    slot = 0
    while signals[slot, column] == 0.0 and (column != HOLD or signals[slot, SLIDER] == 0.0):
        slot += 1
    if kind in (kinds.CEILING, kinds.CEILING_BOUNCE, kinds.SLIP_HIGH):
        return slot, HIGH
    if kind in (kinds.FLOOR, kinds.FLOOR_BOUNCE, kinds.SLIP_LOW):
        return slot, LOW
    return slot, LOW if signals[slot, LOW] > -np.inf else HIGH


@cached_njit
def _sliding_event(
    equations: Equations, derivatives: EquationDerivatives, configuration: int, kind: int, regimes: IndexArray, j: int,
    motion: MotionState, time: float, row: int, jacobian: Array,
) -> tuple[float, float]:  # fmt: skip
    """Apply an event of an element that slides with friction; return its condition, and the closing speed [m/s].

    The condition is that a signal is at its limit. `regimes`: rows of the regimes before and after in
    `Equations.signals`.
    """
    x, dx, nq, n_unknowns = motion.x, motion.dx, equations.inverse_mass.shape[1], motion.dx.shape[1] - 1
    speed, closing_speed = nq + equations.gap_coordinate[j], 0.0
    base, slider = equations.base_coordinate[j], equations.slider_coordinate[j]
    slot, end = signal_of(equations.signals[regimes[0]], kind)
    signal = equations.signals[regimes[0], slot]
    if signal[SLIDER] != 0.0:
        residual = signal[GAP] * along_gap(equations, j, x) + signal[SLIDER] * x[slider] - signal[end]
        jacobian[row] = signal[GAP] * dx[equations.gap_coordinate[j]] + signal[SLIDER] * dx[slider]
        if base >= 0:
            jacobian[row] -= signal[GAP] * dx[base]
        jacobian[row, n_unknowns] -= derivatives.signals[regimes[0], slot, end]
    elif signal[GAP] != 0.0:
        residual, closing_speed = _apply_impact_of_coordinate(
            equations, derivatives, configuration, kind, j, motion, row, jacobian
        )
    elif signal[SPEED] != 0.0:
        residual = along_gap(equations, j, x[nq:])
        jacobian[row] = dx[speed]
        if base >= 0:
            jacobian[row] -= dx[nq + base]
        if slider >= 0:
            # The force does not jump, so the slider displacement follows from the slip force and the gap.
            sticking = equations.signals[regimes[1], 0]
            x[slider] = (sticking[end] - sticking[GAP] * along_gap(equations, j, x)) / sticking[SLIDER]
            dx[slider] = -sticking[GAP] / sticking[SLIDER] * dx[equations.gap_coordinate[j]]
            if base >= 0:
                dx[slider] += sticking[GAP] / sticking[SLIDER] * dx[base]
            dx[slider, n_unknowns] += derivatives.signals[regimes[1], 0, end] / sticking[SLIDER]
    else:
        wall = kinds.RIDES_FLOOR
        residual = -signal[end] + _contact_force_condition(
            equations, derivatives, configuration, j, wall, motion, time, row, jacobian
        )
        jacobian[row, n_unknowns] -= derivatives.signals[regimes[0], slot, end]
    if equations.signals[regimes[1], 0, HOLD] != 0.0:
        x[speed], dx[speed] = 0.0, 0.0
    return residual, closing_speed


@cached_njit
def _write_neutral_rows(equations: Equations, sequence: Sequence, residual: Array, jacobian: Array) -> None:
    """Replace the periodicity rows of gaps that the motion does not determine; Newton's iteration then keeps them.

    The motion of a mass without suspension does not depend on its gap between two impacts on walls. The slider
    displacement of a joint that always sticks is free, and the rate of change of a slider is zero.
    """
    nq = equations.inverse_mass.shape[1]
    for j in range(equations.first_regime.shape[0]):
        slider, stops = equations.slider_coordinate[j], False
        if slider >= 0:
            for k in range(sequence.kind.shape[0]):
                stops = stops or (sequence.damper[k] == j and sequence.kind[k] == kinds.STOP)
            for is_neutral, i in ((not stops, slider), (True, nq + slider)):
                if is_neutral:
                    residual[i] = 0.0
                    jacobian[i] = 0.0
                    jacobian[i, i] = -1.0
        if not equations.moves_freely[j]:
            continue
        hits, moves = False, False
        for k in range(sequence.kind.shape[0]):
            if sequence.damper[k] == j:
                moves = True
                hits = hits or sequence.kind[k] in (
                    kinds.FLOOR, kinds.CEILING, kinds.FLOOR_BOUNCE, kinds.CEILING_BOUNCE
                )  # fmt: skip
        for is_neutral, i in ((not hits, equations.gap_coordinate[j]), (not moves, nq + equations.gap_coordinate[j])):
            if is_neutral:
                residual[i] = 0.0
                jacobian[i] = 0.0
                jacobian[i, i] = -1.0


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
            residual[index + 1] = motion.velocity[j] - unknowns[index + 1]
            jacobian[index], jacobian[index + 1] = motion.dheight[j], motion.dvelocity[j]
            jacobian[index, index] -= 1.0
            jacobian[index + 1, index + 1] -= 1.0
            index += 2


@cached_njit
def shoot(
    equations: Equations, derivatives: EquationDerivatives, sequence: Sequence, unknowns: Array
) -> ShootingResult:
    """Evaluate the equations of an orbit.

    `derivatives`: derivatives with respect to the parameter; `unknowns`, shape (unknowns,): state at t = 0, height and
    velocity of each damper in flight there (in order), instants of the events [s].
    """
    n, nd = equations.generator.shape[1] - 3, equations.body_coordinate.shape[0]
    events, n_unknowns, omega = sequence.kind.shape[0], unknowns.shape[0], equations.omega
    motion, first_row = _initial_motion(sequence, unknowns, n)
    residual, jacobian = np.zeros(n_unknowns), np.zeros((n_unknowns, n_unknowns + 1))
    states, closing_speed = np.zeros((events + 1, n + 2 * nd)), np.zeros(events)
    time = 0.0
    for k in range(events + 1):
        states[k, :n] = motion.x[:n]
        states[k, n : n + nd] = motion.height
        states[k, n + nd :] = motion.velocity
        configuration, row = sequence.configuration[k], first_row + k
        previous_row = row - 1 if k > 0 else -1
        if k == events:
            # The last segment ends with the period, which may depend on the parameter.
            _propagate(
                equations, derivatives, configuration, motion, time, equations.period, previous_row, n_unknowns,
                derivatives.period,
            )  # fmt: skip
            break
        event_time = unknowns[row]
        _propagate(equations, derivatives, configuration, motion, time, event_time, previous_row, row, 1.0)
        time = event_time
        motion.x[n], motion.x[n + 1], motion.x[n + 2] = np.cos(omega * time), np.sin(omega * time), 1.0
        j, kind = sequence.damper[k], sequence.kind[k]
        if equations.first_regime[j] >= 0:
            residual[row], closing_speed[k] = _sliding_event(
                equations, derivatives, configuration, kind,
                equations.first_regime[j] + sequence.wall[k : k + 2, j] - kinds.REGIMES, j, motion, time, row, jacobian,
            )  # fmt: skip
        elif kind == kinds.SEPARATION:
            residual[row] = _contact_force_condition(
                equations, derivatives, configuration, j, sequence.wall[k, j], motion, time, row, jacobian
            )
            _separate(equations, derivatives, sequence.wall[k, j], j, motion)
        elif kind == kinds.INDUCED_SEPARATION:
            residual[row] = time - (unknowns[row - 1] if k > 0 else 0.0)
            jacobian[row, row] = 1.0
            if k > 0:
                jacobian[row, row - 1] = -1.0
            _separate(equations, derivatives, sequence.wall[k, j], j, motion)
        elif kind >= kinds.TOUCH_FLOOR:
            residual[row], closing_speed[k] = _finite_contact_condition(
                equations, derivatives, kind, sequence.wall[k, j], j, motion, row, jacobian
            )
        elif equations.gap_coordinate[j] >= 0:
            residual[row], closing_speed[k] = _apply_impact_of_coordinate(
                equations, derivatives, configuration, kind, j, motion, row, jacobian
            )
        else:
            residual[row], closing_speed[k] = _apply_impact(
                equations, derivatives, configuration, kind, j, motion, row, jacobian
            )
    _write_periodicity(sequence, unknowns, motion, residual, jacobian)
    _write_neutral_rows(equations, sequence, residual, jacobian)
    return ShootingResult(residual, jacobian, states, closing_speed)
