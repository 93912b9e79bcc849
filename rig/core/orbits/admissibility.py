"""Admissibility of orbits: whether a computed orbit is a possible motion, and how far it is from becoming impossible.

A solution of the orbit equations is a motion only if no other event occurs between its events. Dampers in flight must
not reach a wall, and resting dampers (on a wall) must stay pressed on it. The distance to each border is its
*margin*. The margin is negative beyond the border and smooth across it, so that borders can be located as roots.
"""

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.numerics.jit import cached_njit
from rig.core.orbits import event_kinds as kinds
from rig.core.orbits.orbit_equations import GAP, HIGH, HOLD, LOW, SLIDER, SPEED, Equations, Sequence
from rig.core.orbits.shooting import ShootingResult, signal_of
from rig.core.orbits.track import Track, track_orbit, turning_value

# A flight lasts at least this phase of the drive [rad]. In a shorter flight the peak acceleration is within 1e-5 of 1
# g.
MIN_FLIGHT_RAD = 0.02

# Kinds of borders: the first three belong to an event, the others to a damper. `Plan.borders` describes them.
ORDER, NOT_RELEASED, MISSES_WALL = 0, 1, 2
FLIGHT_VANISHES, HITS_FLOOR, HITS_CEILING, LEAVES_WALL, STAYS_AT_WALL, SEPARATED_BY_IMPACT = 3, 4, 5, 6, 7, 8
SLIPS, STOPS, STICKS = 9, 10, 11
N_BORDER_KINDS = 12  # number of the kinds of borders


@cached_njit
def _lowest_minimum(track: Track, s: int, j: int, offset: float, sign: float, first: int = 0) -> float:
    """Return the lowest minimum of offset + sign * guard that lies between instants, or infinity without a minimum.

    The guard is that of damper j in segment s of the track, from instant `first` on. The last index of `Track.guards`
    is the order of the derivative.
    """
    return _lowest_between(track.guards[s, :, j], track.times[s, 1] - track.times[s, 0], offset, sign, first)


@cached_njit
def _lowest_between(guard: Array, step: float, offset: float, sign: float, first: int) -> float:
    """Return the lowest minimum of a guard from its values and derivatives at instants with spacing `step` [s]."""
    lowest = np.inf
    for i in range(first, guard.shape[0] - 1):
        if sign * guard[i, 1] < 0.0 and sign * guard[i + 1, 1] > 0.0:
            slopes = sign * guard[i : i + 2, 1].copy()
            curvatures = sign * guard[i : i + 2, 2].copy()
            left_value, right_value = offset + sign * guard[i, 0], offset + sign * guard[i + 1, 0]
            lowest = min(lowest, turning_value(left_value, right_value, slopes, curvatures, step))
    return lowest


@cached_njit
def _reduce_margin(margins: Array, border: int, index: int, margin: float) -> None:
    """Replace the margin of a border if the new margin is smaller; `index`: event or damper."""
    margins[border, index] = min(margins[border, index], margin)


@cached_njit
def _contact_force(equations: Equations, j: int, upper: bool, overlap: float, closing_speed: float) -> float:
    """Return the contact force [N] from overlap and closing speed, or its rate from their rates."""
    wall = 1 if upper else 0
    return equations.stiffness[j, wall] * overlap + equations.damping[j, wall] * closing_speed


@cached_njit
def _crossing_rate(
    equations: Equations, sequence: Sequence, track: Track, event: int, closing_speed: float, acceleration_unit: float
) -> float:
    """Return the rate of a finite-duration contact's guard at its event, at most 1.

    For a gap the rate is a speed in g/w, for a force the rate of force per mass in g w. `acceleration_unit`: g, or
    without gravity another acceleration [m/s²].
    """
    kind, j, omega = sequence.kind[event], sequence.damper[event], equations.omega
    guard = track.guards[event - 1, -1, j]
    if kind == kinds.RELEASE:
        return min(1.0, -guard[1] / (acceleration_unit * omega))
    if kind in (kinds.PRESS_FLOOR, kinds.PRESS_CEILING):
        sign = -1.0 if kind == kinds.PRESS_FLOOR else 1.0
        force_rate = _contact_force(equations, j, kind == kinds.PRESS_CEILING, sign * guard[1], sign * guard[2])
        return min(1.0, force_rate / (equations.mass[j] * acceleration_unit * omega))
    return min(1.0, closing_speed * omega / acceleration_unit)


@cached_njit
def _finite_contact_margins(
    equations: Equations, sequence: Sequence, track: Track, j: int, length_unit: float, distances: Array
) -> None:
    """Write the margins of a damper with finite-duration contact into `distances`, as `margins` returns them.

    `length_unit`: g/w^2, m.

    A released damper may still overlap a wall, and must not be pressed again before the overlap ends. The end of an
    overlap is not an event, so an overlap at the start of a segment is known only from the previous segment. Therefore
    all segments are examined twice in order, and only the second round determines the margins.
    """
    events, acceleration_unit = sequence.kind.shape[0], length_unit * equations.omega**2
    lower, upper = equations.wall_gap[j]
    overlapped_wall = 0  # none
    segments = track.times.shape[0]
    # s: segment in `track`; k: the same segment in `sequence`.
    for visit in range(2 * segments):
        is_second_round, s = visit >= segments, visit % segments
        k, end_event = (s + 1, (s + 1) % events) if events > 0 else (0, 0)
        wall, guard = sequence.wall[k, j], track.guards[s, :, j]
        starts_with_own_event = events > 0 and sequence.damper[s] == j
        ends_with_own_event = events > 0 and sequence.damper[end_event] == j
        if wall >= kinds.ON_FLOOR:
            lowest_force = _lowest_minimum(track, s, j, 0.0, 1.0)
            if not starts_with_own_event:
                lowest_force = min(lowest_force, guard[0, 0])
            if not ends_with_own_event:
                lowest_force = min(lowest_force, guard[-1, 0])
            if is_second_round:
                _reduce_margin(distances, LEAVES_WALL, j, lowest_force / acceleration_unit)
            continue
        if starts_with_own_event:
            overlapped_wall = sequence.wall[s, j]
        # `first_free`: first instant of the segment at which the damper does not overlap a wall.
        first_free, highest_force, previous_force, is_rising = 0, -np.inf, np.inf, False
        while overlapped_wall != 0 and first_free < guard.shape[0]:
            sign, wall_gap = (-1.0, lower) if overlapped_wall == kinds.ON_FLOOR else (1.0, upper)
            overlap, closing_speed = sign * (guard[first_free, 0] - wall_gap), sign * guard[first_free, 1]
            if overlap <= 0.0 and first_free > 0:
                overlapped_wall = 0
                break
            force = _contact_force(equations, j, overlapped_wall != kinds.ON_FLOOR, overlap, closing_speed)
            if is_rising and force < previous_force:
                highest_force = max(highest_force, previous_force / equations.mass[j])
            is_rising, previous_force = force > previous_force, force
            first_free += 1
        if not is_second_round:
            continue
        _reduce_margin(distances, STAYS_AT_WALL, j, -highest_force / acceleration_unit)
        lower_gap, upper_gap = np.inf, np.inf
        if first_free < guard.shape[0]:
            if np.isfinite(lower):
                lower_gap = _lowest_minimum(track, s, j, -lower, 1.0, first_free)
            if np.isfinite(upper):
                upper_gap = _lowest_minimum(track, s, j, upper, -1.0, first_free)
            if not starts_with_own_event and first_free == 0:
                lower_gap = min(lower_gap, guard[0, 0] - lower)
                upper_gap = min(upper_gap, upper - guard[0, 0])
        _reduce_margin(distances, HITS_FLOOR, j, lower_gap / length_unit)
        _reduce_margin(distances, HITS_CEILING, j, upper_gap / length_unit)


@cached_njit
def _signal_along(equations: Equations, track: Track, s: int, configuration: int, signal: Array, j: int) -> Array:
    """Return a signal of a sliding mass with two derivatives along a segment, shape (steps + 1, 3)."""
    a, nq, n = equations.generator[configuration], equations.inverse_mass.shape[1], track.motion.shape[2]
    gap, base, slider = equations.gap_coordinate[j], equations.base_coordinate[j], equations.slider_coordinate[j]
    weights = np.zeros((3, n + 3))
    weights[0, gap], weights[0, nq + gap] = signal[GAP], signal[SPEED]
    if base >= 0:
        weights[0, base], weights[0, nq + base] = -signal[GAP], -signal[SPEED]
    if slider >= 0:
        weights[0, slider] = signal[SLIDER]
    if signal[HOLD] != 0.0:
        # The other forces on the mass act across the gap, so the holding force is mass times acceleration.
        weights[0] = a[nq + equations.body_coordinate[j]]
    weights[1] = weights[0] @ a
    weights[2] = weights[1] @ a
    values = np.zeros((track.times.shape[1], 3))
    for i in range(values.shape[0]):
        phase = equations.omega * track.times[s, i]
        for d in range(3):
            for m in range(n):
                values[i, d] += weights[d, m] * track.motion[s, i, m]
            values[i, d] += weights[d, n] * np.cos(phase) + weights[d, n + 1] * np.sin(phase) + weights[d, n + 2]
    return values


@cached_njit
def _sliding_margins(
    equations: Equations, sequence: Sequence, track: Track, j: int, length_unit: float, distances: Array
) -> None:
    """Write the margins of the signals of sliding mass j into `distances`, as `margins` returns them."""
    events, omega = sequence.kind.shape[0], equations.omega
    for s in range(track.times.shape[0]):
        k = s + 1 if events > 0 else 0  # index of the segment in `sequence`
        starts_with_own_event = events > 0 and sequence.damper[s] == j
        ends_with_own_event = events > 0 and sequence.damper[(s + 1) % events] == j
        step = track.times[s, 1] - track.times[s, 0]
        regime = equations.first_regime[j] + sequence.wall[k, j] - kinds.REGIMES
        for signal in equations.signals[regime]:
            is_force, is_speed = signal[HOLD] != 0.0, signal[SPEED] != 0.0
            if not is_force and not is_speed and signal[GAP] == 0.0:
                continue
            has_slider = signal[SLIDER] != 0.0
            unit = length_unit * (omega**2 if is_force else omega if is_speed else 1.0)
            values = _signal_along(equations, track, s, sequence.configuration[k], signal, j)
            for end, sign in ((LOW, 1.0), (HIGH, -1.0)):
                if not np.isfinite(signal[end]):
                    continue
                # A speed that starts from rest has no minimum in the first step, except by rounding. The same is true
                # of a force with a slider that starts at its limit.
                first = 1 if (is_speed or has_slider) and starts_with_own_event else 0
                lowest = _lowest_between(values, step, -sign * signal[end], sign, first)
                if is_force or not starts_with_own_event:
                    lowest = min(lowest, sign * (values[0, 0] - signal[end]))
                if not ends_with_own_event:
                    lowest = min(lowest, sign * (values[-1, 0] - signal[end]))
                border = HITS_FLOOR if end == LOW else HITS_CEILING
                if is_speed:
                    border = STOPS
                elif has_slider:
                    border = SLIPS
                elif is_force:
                    is_at_wall = not (np.isfinite(signal[LOW]) and np.isfinite(signal[HIGH]))
                    border = LEAVES_WALL if is_at_wall else SLIPS
                _reduce_margin(distances, border, j, lowest / unit)


@cached_njit
def _sliding_event_margin(
    equations: Equations, sequence: Sequence, track: Track, event: int, closing_speed: float, length_unit: float,
    distances: Array,
) -> None:  # fmt: skip
    """Write the margin of an event of a sliding mass: the rate at which its signal reaches the limit.

    After an impact without rebound or a reversal, the motion away must begin immediately.
    """
    kind, j, omega = sequence.kind[event], sequence.damper[event], equations.omega
    acceleration_unit = length_unit * omega**2
    signals = equations.signals[equations.first_regime[j] + sequence.wall[event, j] - kinds.REGIMES]
    slot, end = signal_of(signals, kind)
    inwards = 1.0 if end == LOW else -1.0
    speed_after = np.zeros(HIGH + 1)
    speed_after[SPEED] = 1.0
    acceleration = _signal_along(equations, track, event, sequence.configuration[event + 1], speed_after, j)[0, 1]
    if signals[slot, GAP] != 0.0 and signals[slot, SLIDER] == 0.0:
        distances[MISSES_WALL, event] = min(1.0, closing_speed * omega / acceleration_unit)
        if kind in (kinds.FLOOR_BOUNCE, kinds.CEILING_BOUNCE) and equations.restitution[j] == 0.0:
            _reduce_margin(distances, STAYS_AT_WALL, j, inwards * acceleration / acceleration_unit)
        return
    before = _signal_along(equations, track, event - 1, sequence.configuration[event], signals[slot], j)[-1, 1]
    unit = acceleration_unit * omega if signals[slot, HOLD] != 0.0 else acceleration_unit
    if signals[slot, SLIDER] != 0.0:
        unit = length_unit * omega
    distances[NOT_RELEASED, event] = min(1.0, -inwards * before / unit)
    if kind == kinds.REVERSE:
        _reduce_margin(distances, STICKS, j, -inwards * acceleration / acceleration_unit)


@cached_njit
def margins(equations: Equations, sequence: Sequence, track: Track, instants: Array, closing_speed: Array) -> Array:
    """Compute the margin of an orbit at each border beyond which it is impossible as a motion.

    `instants`, `closing_speed`: instants, s, and closing speeds [m/s] of the events, shape (events,).

    Returns shape (kinds of borders, max(events, dampers)), gaps in g/w^2, accelerations in g, times in 1/w; at most
    1, negative beyond the border. The second index is an event for the kinds ORDER, NOT_RELEASED and MISSES_WALL,
    otherwise a damper.
    """
    omega, gravity = equations.omega, equations.gravity
    length_unit = gravity / omega**2 if gravity > 0.0 else np.abs(track.extremes).max()
    acceleration_unit = length_unit * omega**2
    body_of, nq = equations.body_coordinate, equations.inverse_mass.shape[1]
    events, nd = sequence.kind.shape[0], body_of.shape[0]
    distances = np.ones((N_BORDER_KINDS, max(events, nd, 1)))
    for s in range(track.times.shape[0]):
        k = s + 1 if events > 0 else 0  # index of the segment in `sequence`
        end_event = (s + 1) % max(events, 1)
        if events > 0 and sequence.kind[end_event] != kinds.INDUCED_SEPARATION:
            distances[ORDER, s] = min(1.0, (track.times[s, -1] - track.times[s, 0]) * omega)
        for j in range(nd):
            starts_with_own_event = events > 0 and sequence.damper[s] == j
            ends_with_own_event = events > 0 and sequence.damper[end_event] == j
            wall, guard = sequence.wall[k, j], track.guards[s, :, j]
            if equations.stiffness[j, 0] > 0.0 or equations.first_regime[j] >= 0:
                continue  # sliding masses are examined below
            if wall in (kinds.FLYING, kinds.WITHOUT_FORCE):
                lower, upper = equations.wall_gap[j]
                # A gap that starts from zero has no minimum in the first step, except by rounding.
                first = 1 if starts_with_own_event and wall == kinds.WITHOUT_FORCE else 0
                if np.isfinite(lower):
                    lowest = _lowest_minimum(track, s, j, -lower, 1.0, first)
                    if not starts_with_own_event:
                        lowest = min(lowest, guard[0, 0] - lower)
                    _reduce_margin(distances, HITS_FLOOR, j, lowest / length_unit)
                if np.isfinite(upper):
                    lowest = _lowest_minimum(track, s, j, upper, -1.0, first)
                    if not starts_with_own_event:
                        lowest = min(lowest, upper - guard[0, 0])
                    _reduce_margin(distances, HITS_CEILING, j, lowest / length_unit)
                continue
            sign = 1.0 if wall == kinds.RIDES_FLOOR else -1.0
            lowest = _lowest_minimum(track, s, j, 0.0, sign)
            lowest = min(lowest, sign * guard[0, 0])
            if not ends_with_own_event:
                lowest = min(lowest, sign * guard[-1, 0])
            _reduce_margin(distances, LEAVES_WALL, j, lowest / acceleration_unit)
    for event in range(events):
        kind, j = sequence.kind[event], sequence.damper[event]
        if equations.first_regime[j] >= 0:
            _sliding_event_margin(equations, sequence, track, event, closing_speed[event], length_unit, distances)
            continue
        if kind >= kinds.TOUCH_FLOOR:
            distances[MISSES_WALL if kind != kinds.RELEASE else NOT_RELEASED, event] = _crossing_rate(
                equations, sequence, track, event, closing_speed[event], acceleration_unit
            )
            continue
        separates = kind in (kinds.SEPARATION, kinds.INDUCED_SEPARATION)
        left_upper = separates and sequence.wall[event, j] == kinds.RIDES_CEILING
        at_upper = kind in (kinds.CEILING, kinds.CEILING_BOUNCE) or left_upper
        is_bounce = kind in (kinds.CEILING_BOUNCE, kinds.FLOOR_BOUNCE)
        away_sign = -1.0 if at_upper else 1.0
        if kind == kinds.INDUCED_SEPARATION or (is_bounce and equations.restitution[j] == 0.0):
            # Right after the event, the gap's second derivative must lead away from the wall.
            _reduce_margin(distances, STAYS_AT_WALL, j, away_sign * track.guards[event, 0, j, 2] / acceleration_unit)
        if kind == kinds.SEPARATION:
            jerk = track.guards[event - 1, -1, j, 1]
            distances[NOT_RELEASED, event] = min(1.0, -away_sign * jerk / (acceleration_unit * omega))
        elif kind != kinds.INDUCED_SEPARATION:
            distances[MISSES_WALL, event] = min(1.0, closing_speed[event] * omega / acceleration_unit)
            # With a full mass matrix, an impact presses resting dampers on their walls or separates them.
            column = equations.gap_coordinate[j] if equations.gap_coordinate[j] >= 0 else body_of[j]
            for i in range(nd):
                body = body_of[i]
                coupling = equations.inverse_mass[sequence.configuration[event], body, column]
                if i != j and sequence.wall[event, i] in (kinds.RIDES_FLOOR, kinds.RIDES_CEILING) and coupling != 0.0:
                    velocity_change = track.motion[event, 0, nq + body] - track.motion[event - 1, -1, nq + body]
                    sign = 1.0 if sequence.wall[event, i] == kinds.RIDES_FLOOR else -1.0
                    _reduce_margin(
                        distances, SEPARATED_BY_IMPACT, i, sign * velocity_change * omega / acceleration_unit
                    )
        if separates:
            # At zero flight time the equations are singular, so a curve ends before.
            next_event = (event + 1) % events
            while sequence.damper[next_event] != j:
                next_event = (next_event + 1) % events
            next_period = equations.period if next_event <= event else 0.0
            flight_time = instants[next_event] - instants[event] + next_period
            if sequence.kind[next_event] == (kinds.CEILING if at_upper else kinds.FLOOR):
                _reduce_margin(distances, FLIGHT_VANISHES, j, flight_time * omega - MIN_FLIGHT_RAD)
    for j in range(nd):
        if equations.first_regime[j] >= 0:
            _sliding_margins(equations, sequence, track, j, length_unit, distances)
        # Contact has a duration.
        if equations.stiffness[j, 0] > 0.0:
            _finite_contact_margins(equations, sequence, track, j, length_unit, distances)
    return distances


@cached_njit
def evaluate_motion(
    equations: Equations, sequence: Sequence, shooting: ShootingResult, instants: Array
) -> tuple[Array, NDArray[np.complex128], Array]:
    """Return `extremes` and `harmonic` of a converged orbit as in `Track`, and its flattened `margins`."""
    track = track_orbit(equations, sequence, instants, shooting.states)
    return (
        track.extremes,
        track.harmonic,
        margins(equations, sequence, track, instants, shooting.closing_speed).ravel(),
    )
