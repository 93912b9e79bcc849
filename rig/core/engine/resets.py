"""The end of a mode: impact, rebound, separation, change of force, and their effect on other elements.

At an impact velocities jump. The masses that touch, and all *held* masses (at rest on a wall), exchange impulses. At
any other exit only the force on the element changes. With a diagonal mass matrix and one detached mass on each body,
every contact is independent. With a full mass matrix, several masses on a body, or a gap that is a coordinate, an
impact may separate other masses from their walls. Then all contacts of the instant are solved together
(`rig.core.numerics.complementarity`).

The gap is the distance from a mass to its wall, the opening speed its rate of change. A closing speed or approach speed
is the negative of the opening speed.

A Zeno sequence is infinitely many, ever lower rebounds in a finite time. The simulation ends it when the height of a
rebound is below the rounding error.

Function arguments: `j` is the number of an element from 0, `x` that of an exit, and `work` is scratch space. `end` is
the end of a signal's interval (`LOW`, `HIGH`), and `push` the direction in which the wall there pushes. `state.z`
contains coordinates and velocities, `state.height` and `state.velocity` those of detached masses in flight. The
`multiplicity` of a zero is explained in `State`.

References
----------
Pfeiffer, F., Glocker, C., "Multibody Dynamics with Unilateral Contacts", Wiley 1996, chapters 6 and 8 (contact
laws on acceleration and on impulse level).
"""

from __future__ import annotations

import numpy as np

from rig.core.base.arrays import Array
from rig.core.engine.flow import Flow, Model
from rig.core.engine.law_tables import HIGH, LOW, LOWER, NONE, REST, SCALE, UPPER
from rig.core.engine.state import Log, State, change_mode, log_event, mode_number
from rig.core.laws.events import NO_EVENT
from rig.core.numerics.complementarity import (
    AT_LOW,
    FREE,
    ROUNDING,
    ContactWorkspace,
    contact_matrix,
    solve_active,
    solve_complementarity,
)
from rig.core.numerics.jit import inlined_kernel, kernel
from rig.core.numerics.simd import affine_product, unsigned

#: Multiplicity of the gap's zero when a mass separates under tension: gap and its rate are zero.
_TENSILE_MULTIPLICITY = 2
#: Multiplicity at a separation at zero contact force: gap, its rate and its acceleration are zero.
SEPARATION_MULTIPLICITY = 3
#: A contact force may be a rounding error of zero up to this fraction of the forces of spring and dashpot.
_MAX_ZERO_FORCE_RATIO = 1e-6


@inlined_kernel
def _gap(model: Model, state: State, j: int) -> float:
    """Return the gap of an element that is not held, m."""
    gap, base = model.gap_coordinate[j], model.base_coordinate[j]
    if gap >= 0:
        return state.z[gap] - state.z[base] if base >= 0 else state.z[gap]
    return state.height[j] - state.z[unsigned(model.position_index[j])]


@inlined_kernel
def _speed(model: Model, state: State, j: int) -> float:
    """Return the rate of change of the gap of an element that is not detached, m/s."""
    first, base = model.first_velocity, model.base_coordinate[j]
    speed = state.z[first + model.gap_coordinate[j]]
    return speed - state.z[first + base] if base >= 0 else speed


@inlined_kernel
def _push_of(end: int) -> float:
    """Return the direction in which the wall at an end of a gap's interval pushes: 1 (up) at the lower end."""
    return 1.0 if end == LOW else -1.0


@inlined_kernel
def _limit(model: Model, m: int, end: int) -> float:
    """Return the limit of the first signal of mode m, which is the gap of a flying mass, m."""
    return model.laws.numbers[m, 0, LOWER if end == LOW else UPPER]


@kernel
def release(
    flow: Flow, model: Model, state: State, log: Log, j: int, end: int, velocity: float, multiplicity: int
) -> None:
    """Change held element j to the mode beyond an end of the interval of its holding force, and log the event.

    `velocity`: velocity of a detached mass, m/s, positive upwards; unused if the gap is a coordinate. `multiplicity`:
    multiplicity of the zero of the gap at a wall.
    """
    laws, m, gap = model.laws, mode_number(model, state, j), model.gap_coordinate[j]
    x = unsigned(laws.exit[m, 0, end])
    if gap < 0:
        state.height[j] = state.z[unsigned(model.position_index[j])] + laws.wall_gap[m]
        state.velocity[j] = velocity
    change_mode(flow, model, state, j, laws.target[x, 0])
    m, first = mode_number(model, state, j), laws.first_lane[j]
    for lane in range(laws.first_lane[j + 1] - first):
        limit = laws.numbers[m, lane, LOWER if end == LOW else UPPER]
        zeros = multiplicity
        if laws.is_speed[m, lane]:
            zeros = multiplicity - 1
        elif gap >= 0 and state.z[gap] != limit:
            zeros = 0
        state.multiplicity[first + lane] = 0 if abs(limit) == np.inf else zeros if end == LOW else -zeros
    log_event(log, j, laws.event[x], 0.0)


@inlined_kernel
def separate(flow: Flow, model: Model, state: State, log: Log, j: int, end: int, multiplicity: int) -> None:
    """Release element j with the velocity of its body."""
    laws, m, lane = model.laws, mode_number(model, state, j), unsigned(model.laws.first_lane[j])
    x = unsigned(laws.exit[m, 0, end])
    if model.gap_coordinate[j] >= 0:
        release(flow, model, state, log, j, end, 0.0, multiplicity)
        return
    # For a detached mass, the most frequent element, the call would take longer than the rest of the event.
    state.height[j] = state.z[unsigned(model.position_index[j])] + laws.wall_gap[m]
    state.velocity[j] = state.z[unsigned(model.velocity_index[j])]
    change_mode(flow, model, state, j, laws.target[x, 0])
    state.multiplicity[lane] = multiplicity if end == LOW else -multiplicity
    log_event(log, j, laws.event[x], 0.0)


@inlined_kernel
def _released_end(model: Model, m: int) -> int:
    """Return the end of the interval at which a wall releases an element at rest."""
    return LOW if model.laws.push[m] > 0.0 else HIGH


@inlined_kernel
def _sum_forces(model: Model, state: State, force: Array) -> None:
    """Sum the forces of springs, dashpots, drive and elements on every coordinate, N."""
    affine_product(model.force, model.force_constant, 0, state.z, model.force.shape[1], force)
    for j in range(model.mass.shape[0]):
        gap, base = model.gap_coordinate[j], model.base_coordinate[j]
        if gap >= 0:
            row = model.laws.force[mode_number(model, state, j)]
            spring_force = row[0] * (_gap(model, state, j) - row[2]) + row[1] * _speed(model, state, j)
            if model.memory_coordinate[j] >= 0:
                spring_force += row[4] * state.z[model.memory_coordinate[j]]
            force[gap] += spring_force
            force[gap] += row[3]
            if base >= 0:
                force[base] -= spring_force + row[3]


@inlined_kernel
def _rebound_is_negligible(
    model: Model, state: State, j: int, push: float, wall_gap: float, rebound_speed: float, force: Array
) -> bool:
    """Return whether the height of a rebound is below the rounding of the gap; this ends a Zeno sequence.

    `wall_gap`: gap at contact, m; `rebound_speed`: relative to the wall, m/s; `force`: force on every coordinate, N.

    With a full mass matrix, other contacts also accelerate the body by an unknown amount, so an upper bound of its
    acceleration is used. A mass that is wrongly set to rest has a tensile contact force and separates immediately.
    """
    row = body = unsigned(model.position_index[j])
    if model.gap_coordinate[j] >= 0:
        row = unsigned(model.gap_coordinate[j])
    if model.coupled:
        approach_acceleration = model.gravity
        for c in range(model.inverse_mass.shape[0]):
            approach_acceleration += abs(model.inverse_mass[row, c] * force[c])
    else:
        body_acceleration = force[row] * model.inverse_mass[row, row]
        approach_acceleration = push * (body_acceleration + model.gravity)
    # The gap is a difference of heights; its rounding error is proportional to the sum of their magnitudes, m.
    height_magnitude = 2.0 * abs(state.z[body]) + abs(wall_gap)
    # A rebound at speed v reaches the height v^2 / (2 a).
    min_squared_speed = 2.0 * approach_acceleration * ROUNDING * height_magnitude
    return approach_acceleration > 0.0 and rebound_speed * rebound_speed < min_squared_speed


@inlined_kernel
def _end_impact(flow: Flow, model: Model, state: State, j: int, end: int, rebound_speed: float) -> None:
    """Set element j in flight from the wall that it hit, or at rest on this wall if the rebound speed is 0."""
    laws, m = model.laws, mode_number(model, state, j)
    lane, push = laws.first_lane[j], _push_of(end)
    if model.gap_coordinate[j] >= 0:
        state.z[model.gap_coordinate[j]] = _limit(model, m, end)
        state.z[model.first_velocity + model.gap_coordinate[j]] = push * max(rebound_speed, 0.0)
    elif rebound_speed > 0.0:
        state.height[j] = state.z[unsigned(model.position_index[j])] + _limit(model, m, end)
        state.velocity[j] = state.z[unsigned(model.velocity_index[j])] + push * rebound_speed
    x, candidate = unsigned(laws.exit[m, 0, end]), 0
    if rebound_speed > 0.0:
        change_mode(flow, model, state, j, laws.target[x, 0])
        is_limited = abs(_limit(model, mode_number(model, state, j), end)) < np.inf
        state.multiplicity[lane] = 0 if not is_limited else 1 if end == LOW else -1
        return
    while candidate + 1 < laws.target.shape[1] and laws.target[x, candidate + 1] != NONE:
        candidate += 1
    state.multiplicity[lane] = 0
    change_mode(flow, model, state, j, laws.target[x, candidate])


@kernel
def _touched_end(model: Model, state: State, j: int, gap_error: float) -> int:
    """Return the end at which a flying mass touches a wall within rounding while approaching it, or NONE.

    `gap_error`: error of the gap of the mass whose impact determined the instant, m. Allowing for it, masses that fly
    together land together.
    """
    m = mode_number(model, state, j)
    multiplicity = state.multiplicity[model.laws.first_lane[j]]
    position, gap_coordinate = state.z[unsigned(model.position_index[j])], model.gap_coordinate[j]
    gap = _gap(model, state, j)
    if gap_coordinate >= 0:
        descent_speed = -state.z[model.first_velocity + gap_coordinate]
        rounding = ROUNDING * (abs(position) + abs(gap))
    else:
        descent_speed = state.z[unsigned(model.velocity_index[j])] - state.velocity[j]
        rounding = ROUNDING * (abs(position) + abs(state.height[j]))
    rounding = max(rounding, gap_error)
    if descent_speed > 0.0 and multiplicity <= 0 and gap <= _limit(model, m, LOW) + rounding:
        return LOW
    if descent_speed < 0.0 and multiplicity >= 0 and gap >= _limit(model, m, HIGH) - rounding:
        return HIGH
    return NONE


@inlined_kernel
def _independent_impact(
    flow: Flow, model: Model, state: State, log: Log, j: int, end: int, work: ContactWorkspace
) -> None:
    """Apply the impact of element j if the mass matrix does not couple it to other elements."""
    velocity_index, m = unsigned(model.velocity_index[j]), mode_number(model, state, j)
    x, push = unsigned(model.laws.exit[m, 0, end]), _push_of(end)
    closing_speed = push * (state.z[velocity_index] - state.velocity[j])
    rebound_speed = model.laws.restitution[x] * closing_speed
    if rebound_speed > 0.0 and _rebound_is_negligible(
        model, state, j, push, _limit(model, m, end), rebound_speed, work.force
    ):
        rebound_speed = 0.0
    row = unsigned(model.position_index[j])
    inverse_mass = model.inverse_mass[row, row]
    impulse = (closing_speed + rebound_speed) / (inverse_mass + 1.0 / model.mass[j])
    state.z[velocity_index] -= push * impulse * inverse_mass
    log_event(log, j, model.laws.event[x], closing_speed)
    _end_impact(flow, model, state, j, end, rebound_speed)


@kernel
def _close_slow_openings(model: Model, state: State, work: ContactWorkspace, count: int) -> None:
    """Keep the contacts closed that an impact opens too slowly for the gap to exceed rounding.

    `count`: number of contacts that take part in the impact; they are the first entries of the arrays in `work`.

    Two masses coupled through the mass matrix can separate each other from their walls at ever shorter intervals. This
    Zeno sequence is ended in the same way as a sequence of rebounds.
    """
    changed = False
    for a in range(count):
        if work.bound[a] == FREE:
            continue
        opening_speed = work.opening_speed[a]
        for b in range(count):
            opening_speed += work.matrix[a, b] * work.reaction[b]
        if _rebound_is_negligible(
            model, state, work.damper[a], work.sign[a], work.wall_gap[a], opening_speed, work.force
        ):
            work.bound[a] = FREE
            changed = True
    if changed:
        solve_active(work, count)


@kernel
def _set_direction(model: Model, i: int, push: float, count: int, work: ContactWorkspace) -> None:
    """Write into row `count` of `work` how the contact of element i acts; `push`: direction of the wall's force."""
    gap = model.gap_coordinate[i]
    work.sign[count] = push
    work.row[count] = gap if gap >= 0 else model.position_index[i]
    work.direction[count] = push if gap >= 0 else -push
    work.own[count] = 0.0 if gap >= 0 else 1.0 / model.mass[i]


@inlined_kernel
def _collect_contact(model: Model, state: State, i: int, end: int, count: int, work: ContactWorkspace) -> None:
    """Write the contact of element i, in flight at an end of its gap or at rest, into row `count` of `work`."""
    laws, m = model.laws, mode_number(model, state, i)
    flying, gap = not laws.is_held[m], model.gap_coordinate[i]
    push = _push_of(end) if flying else laws.push[m]
    wall_gap = _limit(model, m, end) if flying else laws.wall_gap[m]
    restitution = laws.restitution[laws.exit[m, 0, end]] if flying else 0.0
    work.flying[count] = flying
    work.damper[count] = i
    _set_direction(model, i, push, count, work)
    work.wall_gap[count] = wall_gap
    work.velocity_before[count] = state.z[model.velocity_index[i]]
    work.opening_speed[count] = 0.0
    if flying and gap >= 0:
        work.opening_speed[count] = push * state.z[model.first_velocity + gap]
    elif flying:
        work.opening_speed[count] = push * (state.velocity[i] - work.velocity_before[count])
    rebound_speed = -restitution * work.opening_speed[count]
    if rebound_speed > 0.0 and _rebound_is_negligible(model, state, i, push, wall_gap, rebound_speed, work.force):
        rebound_speed = 0.0
    work.rhs[count] = work.opening_speed[count] - rebound_speed


@kernel
def _slip_by_impact(flow: Flow, model: Model, state: State, log: Log) -> None:
    """Set masses with friction to the modes of their new speeds after an impact.

    A friction force is finite, so that it transmits no impulse: masses that stick slip, and others may reverse.
    """
    laws = model.laws
    for i in range(model.mass.shape[0]):
        gap, m, first = model.gap_coordinate[i], mode_number(model, state, i), laws.first_lane[i]
        # A joint with memory is skipped, because it has no mass: the kernel detects a speed outside the interval.
        if gap < 0 or model.memory_coordinate[i] >= 0:
            continue
        speed = state.z[model.first_velocity + gap]
        for lane in range(laws.first_lane[i + 1] - first):
            if not laws.is_speed[m, lane]:
                continue
            end = LOW if laws.exit[m, lane, LOW] != NONE else HIGH
            state.multiplicity[first + lane] = 0
            if _push_of(end) * speed < 0.0:
                x = unsigned(laws.exit[m, lane, end])
                change_mode(flow, model, state, i, laws.target[x, 0])
                log_event(log, i, laws.event[x], 0.0)
        m = mode_number(model, state, i)
        if not laws.is_held[m] or laws.transmits[m]:
            continue
        if abs(speed) > ROUNDING * abs(state.z[model.velocity_index[i]]):
            release(flow, model, state, log, i, LOW if speed > 0.0 else HIGH, 0.0, 1)
        else:
            state.z[model.first_velocity + gap] = 0.0


@kernel
def _coupled_impact(flow: Flow, model: Model, state: State, log: Log, j: int, end: int, work: ContactWorkspace) -> None:
    """Apply the impact of element j, with its effect through a full mass matrix on masses that touch a wall."""
    count, landing = 0, 0
    gap_error = abs(_gap(model, state, j) - _limit(model, mode_number(model, state, j), end))
    for i in range(model.mass.shape[0]):
        m = mode_number(model, state, i)
        if not (model.laws.transmits[m] or model.laws.can_hit[m]):
            continue
        touched = LOW
        if not model.laws.is_held[m]:
            touched = end if i == j else _touched_end(model, state, i, gap_error)
            if touched == NONE:
                continue
        _collect_contact(model, state, i, touched, count, work)
        landing += work.flying[count]
        count += 1
    for a in range(count):
        work.low[a], work.high[a] = 0.0, np.inf
    contact_matrix(model, work, count)
    solve_complementarity(work, count)
    _close_slow_openings(model, state, work, count)
    for a in range(count):
        column = work.row[a]
        for row in range(model.inverse_mass.shape[0]):
            change = model.inverse_mass[row, column] * work.direction[a] * work.reaction[a]
            state.z[model.first_velocity + row] += change
    for a in range(count):
        i = work.damper[a]
        body_velocity, gap = state.z[model.velocity_index[i]], model.gap_coordinate[i]
        if work.flying[a]:
            touched = LOW if work.sign[a] > 0.0 else HIGH
            velocity = state.velocity[i] + work.sign[a] * work.reaction[a] / model.mass[i]
            rebound_speed = work.sign[a] * (velocity - body_velocity)
            if gap >= 0:
                rebound_speed = work.sign[a] * state.z[model.first_velocity + gap]
            is_plastic = work.rhs[a] == work.opening_speed[a]  # the required rebound speed is zero
            if work.bound[a] == FREE and (is_plastic or landing > 1):
                # Without rounding, masses that land together rebound at equal speeds, and land together again.
                rebound_speed = work.opening_speed[a] - work.rhs[a]
            # Before the impact, the gap of element j is zero and decreases. If its opening speed is positive
            # nevertheless, it is a rounding error, and so is a rebound speed that does not exceed it.
            if i == j and 0.0 < rebound_speed <= work.opening_speed[a]:
                rebound_speed = 0.0
            # A reaction of zero means that another impact has moved the wall away before the mass touched it.
            if work.reaction[a] > 0.0 or rebound_speed <= 0.0:
                x = model.laws.exit[mode_number(model, state, i), 0, touched]
                log_event(log, i, model.laws.event[x], -work.opening_speed[a])
            _end_impact(flow, model, state, i, touched, rebound_speed)
        elif work.bound[a] == FREE and gap >= 0:
            state.z[model.first_velocity + gap] = 0.0
        elif work.bound[a] != FREE:
            opening_speed = work.sign[a] * (work.velocity_before[a] - body_velocity)
            if gap >= 0:
                opening_speed = work.sign[a] * state.z[model.first_velocity + gap]
            if opening_speed > ROUNDING * (abs(work.velocity_before[a]) + abs(body_velocity)):
                end = LOW if work.sign[a] > 0.0 else HIGH
                release(flow, model, state, log, i, end, work.velocity_before[a], 1)
            elif gap >= 0:
                state.z[model.first_velocity + gap] = 0.0
    _slip_by_impact(flow, model, state, log)
    # The impact changes the velocities of walls, so that the rate of a gap may no longer be exactly zero.
    for i in range(model.mass.shape[0]):
        if model.laws.can_hit[mode_number(model, state, i)]:
            lane = model.laws.first_lane[i]
            state.multiplicity[lane] = min(1, max(-1, state.multiplicity[lane]))


@inlined_kernel
def _separate_independent(flow: Flow, model: Model, state: State, log: Log, work: ContactWorkspace) -> None:
    """Separate each mass whose contact force is tensile, if contacts do not affect each other."""
    force = work.force
    for i in range(model.mass.shape[0]):
        m = mode_number(model, state, i)
        if not model.laws.is_held[m]:
            continue
        row = unsigned(model.position_index[i])
        # Upward contact force on the mass divided by the mass, if it moves with its body.
        relative_acceleration = force[row] * model.inverse_mass[row, row] + model.gravity
        if model.laws.push[m] * relative_acceleration >= 0.0:
            continue
        magnitude = model.gravity
        for c in range(model.force.shape[1]):
            magnitude += abs(model.force[0, c, row] * state.z[c]) * model.inverse_mass[row, row]
        if abs(relative_acceleration) > ROUNDING * magnitude:
            separate(flow, model, state, log, i, _released_end(model, m), _TENSILE_MULTIPLICITY)


@kernel
def _separate_coupled(flow: Flow, model: Model, state: State, log: Log, work: ContactWorkspace) -> None:
    """Solve for the forces on all held masses, and release the masses whose force is at an end of its interval."""
    count = 0
    for i in range(model.mass.shape[0]):
        m = mode_number(model, state, i)
        if not model.laws.is_held[m]:
            continue
        work.damper[count] = i
        _set_direction(model, i, model.laws.push[m], count, work)
        row, is_detached = work.row[count], model.gap_coordinate[i] < 0
        free_acceleration = 0.0
        magnitude = model.gravity if is_detached else 0.0
        for c in range(model.inverse_mass.shape[0]):
            free_acceleration += model.inverse_mass[row, c] * work.force[c]
            for column in range(model.force.shape[1]):
                magnitude += abs(model.inverse_mass[row, c] * model.force[0, column, c] * state.z[column])
        work.rhs[count] = work.direction[count] * free_acceleration
        if is_detached:
            work.rhs[count] = work.sign[count] * (-model.gravity - free_acceleration)
        work.magnitude[count] = magnitude
        low, high = model.laws.numbers[m, 0, LOWER], model.laws.numbers[m, 0, UPPER]
        if work.sign[count] < 0.0:
            low, high = -high, -low
        work.low[count], work.high[count] = model.mass[i] * low, model.mass[i] * high
        count += 1
    contact_matrix(model, work, count)
    solve_complementarity(work, count)
    for a in range(count):
        if work.bound[a] == FREE:
            continue
        at_low = work.bound[a] == AT_LOW
        opening_acceleration = work.rhs[a]
        for b in range(count):
            opening_acceleration += work.matrix[a, b] * work.reaction[b]
        if not at_low:
            opening_acceleration = -opening_acceleration
        magnitude = work.magnitude[a] + abs(work.matrix[a, a] * work.reaction[a])
        if opening_acceleration > ROUNDING * magnitude:
            end = LOW if at_low == (work.sign[a] > 0.0) else HIGH
            separate(flow, model, state, log, work.damper[a], end, _TENSILE_MULTIPLICITY)


@inlined_kernel
def separate_tensile(flow: Flow, model: Model, state: State, log: Log, work: ContactWorkspace) -> None:
    """Separate every mass at rest whose contact force would be tensile by more than rounding."""
    _sum_forces(model, state, work.force)
    if model.coupled:
        _separate_coupled(flow, model, state, log, work)
    else:
        _separate_independent(flow, model, state, log, work)


@inlined_kernel
def impact(flow: Flow, model: Model, state: State, log: Log, j: int, end: int, work: ContactWorkspace) -> None:
    """Apply the impact of element j on the wall at an end of its gap; `separate_tensile` must follow."""
    x = unsigned(model.laws.exit[mode_number(model, state, j), 0, end])
    if model.coupled or model.laws.restitution[x] > 0.0:
        _sum_forces(model, state, work.force)
    if model.coupled:
        _coupled_impact(flow, model, state, log, j, end, work)
    else:
        _independent_impact(flow, model, state, log, j, end, work)


@inlined_kernel
def _is_gap(model: Model, m: int, lane: int) -> bool:
    """Return whether a signal is the gap or the speed, or a multiple of it."""
    return model.laws.factors[m, lane, 0] == 0.0 or model.laws.factors[m, lane, 1] == 0.0


@kernel
def _side_of_limit(model: Model, state: State, j: int, m: int, lane: int, end: int) -> int:
    """Return the side of a limit on which a signal of mode m is: 1 inside, 0 at the limit within rounding, -1 outside.

    Without a dashpot, the signal is zero at every touch and release. An exception is a contact that the impact of
    another element starts or ends through a full mass matrix.
    """
    laws, number = model.laws, model.laws.numbers[m, lane]
    limit = number[LOWER] if end == LOW else number[UPPER]
    if abs(limit) == np.inf:
        return 1
    speed = _speed(model, state, j)
    quantity, factor = _gap(model, state, j), laws.factors[m, lane, 0]
    if model.memory_coordinate[j] >= 0:
        quantity -= state.z[model.memory_coordinate[j]]  # the factor of the memory is minus that of the gap
    if laws.is_speed[m, lane]:
        quantity, factor = speed, laws.factors[m, lane, 1]
    distance = factor * (quantity - number[REST]) - limit
    rounding = laws.rounding[m, lane] * abs(speed)
    if not _is_gap(model, m, lane):
        dashpot_force = laws.factors[m, lane, 1] * speed
        rounding += _MAX_ZERO_FORCE_RATIO * (abs(distance) + abs(dashpot_force))
        distance += dashpot_force
    if abs(distance) <= rounding:
        return 0
    return 1 if _push_of(end) * distance > 0.0 else -1


@kernel
def _is_consistent(model: Model, state: State, j: int, m: int) -> bool:
    """Return whether each signal of mode m is inside its interval, or is a gap at a limit and moves inwards."""
    laws, speed = model.laws, _speed(model, state, j)
    for lane in range(laws.first_lane[j + 1] - laws.first_lane[j]):
        for end in range(2):
            side = _side_of_limit(model, state, j, m, lane, end)
            inward_rate = _push_of(end) * laws.numbers[m, lane, SCALE] * speed
            if side < 0 or (side == 0 and _is_gap(model, m, lane) and inward_rate <= 0.0):
                return False
    return True


@kernel
def _stop_simultaneously(flow: Flow, model: Model, state: State, log: Log, j: int) -> None:
    """Stop the masses that slide at a speed of zero within rounding at the instant at which element j stops.

    The forces that then hold these masses depend on each other.
    """
    laws = model.laws
    for i in range(model.mass.shape[0]):
        m, first = mode_number(model, state, i), laws.first_lane[i]
        if i == j or model.gap_coordinate[i] < 0 or model.memory_coordinate[i] >= 0:
            continue
        for lane in range(laws.first_lane[i + 1] - first):
            if not laws.is_speed[m, lane] or state.multiplicity[first + lane] != 0:
                continue
            # Rounding errors of a speed are proportional to its terms after a step: velocity, and displacement / step.
            displacement, velocity = state.z[model.position_index[i]], state.z[model.velocity_index[i]]
            if abs(_speed(model, state, i)) <= ROUNDING * (abs(velocity) + abs(displacement) / model.step):
                x = unsigned(laws.exit[m, lane, LOW if laws.exit[m, lane, LOW] != NONE else HIGH])
                state.z[model.first_velocity + model.gap_coordinate[i]] = 0.0
                change_mode(flow, model, state, i, laws.target[x, 0])
                log_event(log, i, laws.event[x], 0.0)
                break


@inlined_kernel
def _remember(model: Model, state: State, j: int, m: int, m_before: int) -> None:
    """Set the memory of element j so that its force does not jump at the change to mode m; its force is at a limit."""
    laws, lane = model.laws, model.laws.first_lane[j]
    force = laws.force[m_before, 3]
    state.z[model.memory_coordinate[j]] = _gap(model, state, j) - force / laws.force[m, 0]
    # The rate of the force is proportional to the speed, which is zero unless an impact has changed it.
    displacement, velocity = state.z[model.position_index[j]], state.z[model.velocity_index[j]]
    rounding = ROUNDING * (abs(velocity) + abs(displacement) / model.step)
    zeros = 2 if abs(_speed(model, state, j)) <= rounding else 1
    state.multiplicity[lane] = zeros if force < 0.0 else -zeros


@kernel
def change_force(flow: Flow, model: Model, state: State, log: Log, j: int, x: int) -> None:
    """Apply an exit without a jump of velocities to an element whose gap is a coordinate."""
    laws, first = model.laws, model.laws.first_mode[j]
    candidate = 0
    while (
        candidate + 1 < laws.target.shape[1]
        and laws.target[x, candidate + 1] != NONE
        and not _is_consistent(model, state, j, first + laws.target[x, candidate])
    ):
        candidate += 1
    m = first + laws.target[x, candidate]
    for lane in range(laws.first_lane[j + 1] - laws.first_lane[j]):
        at_low = not laws.is_held[m] and _side_of_limit(model, state, j, m, lane, LOW) == 0
        at_high = not laws.is_held[m] and _side_of_limit(model, state, j, m, lane, HIGH) == 0
        state.multiplicity[laws.first_lane[j] + lane] = 1 if at_low else -1 if at_high else 0
    if laws.force[m, 4] != 0.0:
        _remember(model, state, j, m, mode_number(model, state, j))
    if laws.is_held[m]:
        state.z[model.first_velocity + model.gap_coordinate[j]] = 0.0
        _stop_simultaneously(flow, model, state, log, j)
    change_mode(flow, model, state, j, laws.target[x, candidate])
    if laws.event[x] != NO_EVENT:
        closing_speed = -laws.push[m] * _speed(model, state, j) if laws.wall[m] > 0 else 0.0
        log_event(log, j, laws.event[x], closing_speed)
