"""The end of a regime: impact, rebound, separation, change of force, and their effect on other elements.

At an impact velocities jump. The masses that touch, and all *held* masses (at rest on a wall), exchange impulses. At
any other transition only the force on the element changes. With a diagonal mass matrix and one detached mass on each
body, every contact is independent. With a full mass matrix, several masses on a body, or a gap that is a coordinate, an
impact may separate other masses from their walls. Then all contacts of the instant are solved together
(`rig.core.numerics.complementarity`).

The gap is the distance from a mass to its wall, the opening speed its rate of change. A closing speed or approach speed
is the negative of the opening speed.

A Zeno sequence is infinitely many, ever lower rebounds in a finite time. The simulation ends it when the height of a
rebound is below the rounding error.

Function arguments: `j` is the number of an element from 0, `x` that of a transition, and `work` is scratch space. `end`
is the end of a signal's interval (`LOW`, `HIGH`), and `push` the direction in which the wall there pushes. `state.z`
contains coordinates and velocities, `state.height` and `state.velocity` those of detached masses in flight. The
`multiplicity` of a zero is explained in `State`.

References
----------
Pfeiffer, F., Glocker, C., "Multibody Dynamics with Unilateral Contacts", Wiley 1996, chapters 6 and 8 (contact
laws on acceleration and on impulse level).
"""

from typing import Any

import numpy as np

from rig.core.base.arrays import Array
from rig.core.engine.flow import Model
from rig.core.engine.law_tables import HIGH, LOW, LOWER, NONE, REST, SCALE, UPPER, Ints, LawTables
from rig.core.engine.state import Log, State, change_regime, log_event, regime_number
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
def _gap(element: Any, state: State, j: int) -> float:
    """Return the gap of element j if it is not held [m]."""
    gap, base = element.gap_coordinate, element.base_coordinate
    if gap >= 0:
        return state.z[gap] - state.z[base] if base >= 0 else state.z[gap]
    return state.height[j] - state.z[element.position_index]


@inlined_kernel
def _speed(element: Any, z: Array, first: int) -> float:
    """Return the rate of change of the gap of an element that is not detached [m/s]; `first`: index of velocities."""
    speed = z[first + element.gap_coordinate]
    return speed - z[first + element.base_coordinate] if element.base_coordinate >= 0 else speed


@inlined_kernel
def _push_of(end: int) -> float:
    """Return the direction in which the wall at an end of a gap's interval pushes: 1 (up) at the lower end."""
    return 1.0 if end == LOW else -1.0


@inlined_kernel
def _limit(laws: LawTables, m: int, end: int) -> float:
    """Return the limit of the first signal of regime m, which is the gap of a flying mass [m]."""
    return laws.numbers[m, 0, LOWER if end == LOW else UPPER]


@kernel
def release(
    after: Ints, model: Model, state: State, log: Log, j: int, end: int, velocity: float, multiplicity: int
) -> None:
    """Change held element j to the regime beyond an end of the interval of its holding force, and log the event.

    `velocity`: velocity of a detached mass [m/s], positive upwards; unused if the gap is a coordinate. `multiplicity`:
    multiplicity of the zero of the gap at a wall.
    """
    laws, m, element = model.laws, regime_number(model.laws.elements, state.regime, j), model.laws.elements[j]
    x, gap = unsigned(laws.transition[m, 0, end]), element.gap_coordinate
    if gap < 0:
        state.height[j] = state.z[element.position_index] + laws.regimes[m].wall_gap
        state.velocity[j] = velocity
    change_regime(after, laws, state, j, m, laws.target[x, 0])
    m = regime_number(laws.elements, state.regime, j)
    for slot in range(element.slots):
        limit = laws.numbers[m, slot, LOWER if end == LOW else UPPER]
        zeros = multiplicity
        if laws.signals[m, slot].is_speed:
            zeros = multiplicity - 1
        elif gap >= 0 and state.z[gap] != limit:
            zeros = 0
        state.multiplicity[element.first_slot + slot] = 0 if abs(limit) == np.inf else zeros if end == LOW else -zeros
    log_event(log, j, laws.transitions[x].event, 0.0)


@inlined_kernel
def separate(after: Ints, model: Model, state: State, log: Log, j: int, m: int, end: int, multiplicity: int) -> None:
    """Release element j with the velocity of its body."""
    laws, element = model.laws, model.laws.elements[j]
    if element.gap_coordinate >= 0:
        release(after, model, state, log, j, end, 0.0, multiplicity)
        return
    # For a detached mass, the most frequent element, the call would take longer than the rest of the event.
    x = unsigned(laws.transition[m, 0, end])
    state.height[j] = state.z[element.position_index] + laws.regimes[m].wall_gap
    state.velocity[j] = state.z[element.velocity_index]
    change_regime(after, laws, state, j, m, laws.target[x, 0])
    state.multiplicity[element.first_slot] = multiplicity if end == LOW else -multiplicity
    log_event(log, j, laws.transitions[x].event, 0.0)


@inlined_kernel
def _sum_forces(model: Model, state: State, force: Array) -> None:
    """Sum the forces of springs, dashpots, drive and elements on every coordinate [N]."""
    affine_product(model.force, model.force_constant, 0, state.z, model.force.shape[1], force)
    for j in range(unsigned(model.laws.elements.shape[0])):
        element = model.laws.elements[j]
        if element.gap_coordinate >= 0:
            regime = model.laws.regimes[regime_number(model.laws.elements, state.regime, j)]
            spring_force = regime.force_gap * (_gap(element, state, j) - regime.force_rest)
            spring_force += regime.force_speed * _speed(element, state.z, model.first_velocity)
            if element.slider_coordinate >= 0:
                spring_force += regime.force_slider * state.z[element.slider_coordinate]
            force[element.gap_coordinate] += spring_force
            force[element.gap_coordinate] += regime.force_constant
            if element.base_coordinate >= 0:
                force[element.base_coordinate] -= spring_force + regime.force_constant


@inlined_kernel
def _rebound_is_negligible(
    model: Model, state: State, j: int, push: float, wall_gap: float, rebound_speed: float, force: Array
) -> bool:
    """Return whether the height of a rebound is below the rounding of the gap; this ends a Zeno sequence.

    `wall_gap`: gap at contact [m]; `rebound_speed`: relative to the wall [m/s]; `force`: force on every coordinate [N].

    With a full mass matrix, other contacts also accelerate the body by an unknown amount, so an upper bound of its
    acceleration is used. A mass that is wrongly set to rest has a tensile contact force and separates immediately.
    """
    element = model.laws.elements[j]
    row = body = element.position_index
    if element.gap_coordinate >= 0:
        row = unsigned(element.gap_coordinate)
    if model.coupled:
        approach_acceleration = model.gravity
        for c in range(model.inverse_mass.shape[0]):
            approach_acceleration += abs(model.inverse_mass[row, c] * force[c])
    else:
        body_acceleration = force[row] * model.inverse_mass[row, row]
        approach_acceleration = push * (body_acceleration + model.gravity)
    # The gap is a difference of heights; its rounding error is proportional to the sum of their magnitudes [m].
    height_magnitude = 2.0 * abs(state.z[body]) + abs(wall_gap)
    # A rebound at speed v reaches the height v^2 / (2 a).
    min_squared_speed = 2.0 * approach_acceleration * ROUNDING * height_magnitude
    return approach_acceleration > 0.0 and rebound_speed * rebound_speed < min_squared_speed


@inlined_kernel
def _end_impact(
    after: Ints, model: Model, state: State, j: int, m: int, x: int, end: int, rebound_speed: float
) -> None:
    """Set element j in flight from the wall that it hit, or at rest on this wall if the rebound speed is 0."""
    laws, element = model.laws, model.laws.elements[j]
    gap, push = element.gap_coordinate, _push_of(end)
    if gap >= 0:
        state.z[gap] = _limit(laws, m, end)
        state.z[model.first_velocity + gap] = push * max(rebound_speed, 0.0)
    elif rebound_speed > 0.0:
        state.height[j] = state.z[element.position_index] + _limit(laws, m, end)
        state.velocity[j] = state.z[element.velocity_index] + push * rebound_speed
    if rebound_speed > 0.0:
        change_regime(after, laws, state, j, m, laws.target[x, 0])
        is_limited = abs(_limit(laws, regime_number(laws.elements, state.regime, j), end)) < np.inf
        state.multiplicity[element.first_slot] = 0 if not is_limited else 1 if end == LOW else -1
        return
    candidate = 0
    while candidate + 1 < laws.target.shape[1] and laws.target[x, candidate + 1] != NONE:
        candidate += 1
    state.multiplicity[element.first_slot] = 0
    change_regime(after, laws, state, j, m, laws.target[x, candidate])


@kernel
def _touched_end(model: Model, state: State, j: int, gap_error: float) -> int:
    """Return the end at which a flying mass touches a wall within rounding while approaching it, or NONE.

    `gap_error`: numerical error of the gap of the mass whose impact determined the instant, m. With this error as the
    tolerance, masses that fly with equal gaps land at the same instant.
    """
    m, element = regime_number(model.laws.elements, state.regime, j), model.laws.elements[j]
    multiplicity = state.multiplicity[element.first_slot]
    position, gap = state.z[element.position_index], _gap(element, state, j)
    if element.gap_coordinate >= 0:
        descent_speed = -state.z[model.first_velocity + element.gap_coordinate]
        rounding = ROUNDING * (abs(position) + abs(gap))
    else:
        descent_speed = state.z[element.velocity_index] - state.velocity[j]
        rounding = ROUNDING * (abs(position) + abs(state.height[j]))
    rounding = max(rounding, gap_error)
    if descent_speed > 0.0 and multiplicity <= 0 and gap <= _limit(model.laws, m, LOW) + rounding:
        return LOW
    if descent_speed < 0.0 and multiplicity >= 0 and gap >= _limit(model.laws, m, HIGH) - rounding:
        return HIGH
    return NONE


@inlined_kernel
def _independent_impact(
    after: Ints, model: Model, state: State, log: Log, j: int, m: int, x: int, end: int, work: ContactWorkspace
) -> None:
    """Apply the impact of element j if the mass matrix does not couple it to other elements."""
    element, transition, push = model.laws.elements[j], model.laws.transitions[x], _push_of(end)
    row, velocity_index = element.position_index, element.velocity_index
    closing_speed = push * (state.z[velocity_index] - state.velocity[j])
    rebound_speed = transition.restitution * closing_speed
    if rebound_speed > 0.0 and _rebound_is_negligible(
        model, state, j, push, _limit(model.laws, m, end), rebound_speed, work.force
    ):
        rebound_speed = 0.0
    inverse_mass = model.inverse_mass[row, row]
    impulse = (closing_speed + rebound_speed) / (inverse_mass + 1.0 / element.mass)
    state.z[velocity_index] -= push * impulse * inverse_mass
    log_event(log, j, transition.event, closing_speed)
    _end_impact(after, model, state, j, m, x, end, rebound_speed)


@kernel
def _close_slow_openings(model: Model, state: State, work: ContactWorkspace, count: int) -> None:
    """Keep the contacts closed that an impact opens too slowly for the gap to exceed rounding.

    `count`: number of contacts that take part in the impact; they are the first entries of the arrays in `work`.

    Two masses coupled through the mass matrix can separate each other from their walls at ever shorter intervals. This
    Zeno sequence is ended in the same way as a sequence of rebounds.
    """
    changed = False
    for a in range(count):
        contact = work.contacts[a]
        if contact.bound == FREE:
            continue
        opening_speed = contact.opening_speed
        for b in range(count):
            opening_speed += work.matrix[a, b] * work.contacts[b].reaction
        if _rebound_is_negligible(
            model, state, contact.damper, contact.sign, contact.wall_gap, opening_speed, work.force
        ):
            contact.bound = FREE
            changed = True
    if changed:
        solve_active(work, count)


@kernel
def _set_direction(element: Any, i: int, push: float, contact: Any) -> None:
    """Write into a contact how element i acts; `push`: direction of the wall's force."""
    is_coordinate = element.gap_coordinate >= 0
    contact.damper, contact.sign = i, push
    contact.row = element.gap_coordinate if is_coordinate else element.position_index
    contact.direction = push if is_coordinate else -push
    contact.own = 0.0 if is_coordinate else 1.0 / element.mass


@inlined_kernel
def _collect_contact(model: Model, state: State, i: int, end: int, count: int, work: ContactWorkspace) -> None:
    """Write the contact of element i, in flight at an end of its gap or at rest, into row `count` of `work`."""
    laws, m, contact = model.laws, regime_number(model.laws.elements, state.regime, i), work.contacts[count]
    flying, gap = not laws.regimes[m].is_held, laws.elements[i].gap_coordinate
    push = _push_of(end) if flying else laws.regimes[m].push
    restitution = laws.transitions[laws.transition[m, 0, end]].restitution if flying else 0.0
    _set_direction(laws.elements[i], i, push, contact)
    contact.flying = flying
    contact.wall_gap = _limit(laws, m, end) if flying else laws.regimes[m].wall_gap
    contact.velocity_before = state.z[laws.elements[i].velocity_index]
    contact.opening_speed = 0.0
    if flying and gap >= 0:
        contact.opening_speed = push * state.z[model.first_velocity + gap]
    elif flying:
        contact.opening_speed = push * (state.velocity[i] - contact.velocity_before)
    rebound_speed = -restitution * contact.opening_speed
    if rebound_speed > 0.0 and _rebound_is_negligible(
        model, state, i, push, contact.wall_gap, rebound_speed, work.force
    ):
        rebound_speed = 0.0
    contact.rhs = contact.opening_speed - rebound_speed


@kernel
def _slip_by_impact(after: Ints, model: Model, state: State, log: Log) -> None:
    """Set masses with friction to the regimes of their new speeds after an impact.

    A friction force is finite, so that it transmits no impulse: masses that stick slip, and others may reverse.
    """
    laws = model.laws
    for i in range(unsigned(laws.elements.shape[0])):
        element, m = laws.elements[i], regime_number(laws.elements, state.regime, i)
        # A joint with a slider is skipped, because it has no mass: the kernel detects a speed outside the interval.
        if element.gap_coordinate < 0 or element.slider_coordinate >= 0:
            continue
        speed = state.z[model.first_velocity + element.gap_coordinate]
        for slot in range(element.slots):
            if not laws.signals[m, slot].is_speed:
                continue
            end = LOW if laws.transition[m, slot, LOW] != NONE else HIGH
            state.multiplicity[element.first_slot + slot] = 0
            if _push_of(end) * speed < 0.0:
                x = unsigned(laws.transition[m, slot, end])
                change_regime(after, laws, state, i, m, laws.target[x, 0])
                log_event(log, i, laws.transitions[x].event, 0.0)
        m = regime_number(laws.elements, state.regime, i)
        if not laws.regimes[m].is_held or laws.regimes[m].transmits:
            continue
        if abs(speed) > ROUNDING * abs(state.z[element.velocity_index]):
            release(after, model, state, log, i, LOW if speed > 0.0 else HIGH, 0.0, 1)
        else:
            state.z[model.first_velocity + element.gap_coordinate] = 0.0


@kernel
def _coupled_impact(
    after: Ints, model: Model, state: State, log: Log, j: int, m: int, end: int, work: ContactWorkspace
) -> None:
    """Apply the impact of element j, with its effect through a full mass matrix on masses that touch a wall."""
    count, landing = 0, 0
    laws, first = model.laws, model.first_velocity
    gap_error = abs(_gap(laws.elements[j], state, j) - _limit(laws, m, end))
    for i in range(unsigned(laws.elements.shape[0])):
        regime = laws.regimes[regime_number(laws.elements, state.regime, i)]
        if not (regime.transmits or regime.can_hit):
            continue
        touched = LOW
        if not regime.is_held:
            touched = end if i == j else _touched_end(model, state, i, gap_error)
            if touched == NONE:
                continue
        _collect_contact(model, state, i, touched, count, work)
        landing += work.contacts[count].flying
        count += 1
    for a in range(count):
        work.contacts[a].low, work.contacts[a].high = 0.0, np.inf
    contact_matrix(model.inverse_mass, work, count)
    solve_complementarity(work, count)
    _close_slow_openings(model, state, work, count)
    for a in range(count):
        contact = work.contacts[a]
        for row in range(model.inverse_mass.shape[0]):
            state.z[first + row] += model.inverse_mass[row, contact.row] * contact.direction * contact.reaction
    for a in range(count):
        contact = work.contacts[a]
        i = contact.damper
        body_velocity, gap = state.z[laws.elements[i].velocity_index], laws.elements[i].gap_coordinate
        if contact.flying:
            touched = LOW if contact.sign > 0.0 else HIGH
            velocity = state.velocity[i] + contact.sign * contact.reaction / laws.elements[i].mass
            rebound_speed = contact.sign * (velocity - body_velocity)
            if gap >= 0:
                rebound_speed = contact.sign * state.z[first + gap]
            is_plastic = contact.rhs == contact.opening_speed  # the required rebound speed is zero
            if contact.bound == FREE and (is_plastic or landing > 1):
                # Without rounding, masses that land together rebound at equal speeds, and land together again.
                rebound_speed = contact.opening_speed - contact.rhs
            # Before the impact, the gap of element j is zero and decreases. If its opening speed is positive
            # nevertheless, it is a rounding error, and so is a rebound speed that does not exceed it.
            if i == j and 0.0 < rebound_speed <= contact.opening_speed:
                rebound_speed = 0.0
            # A reaction of zero means that another impact has moved the wall away before the mass touched it.
            m = regime_number(laws.elements, state.regime, i)
            x = unsigned(laws.transition[m, 0, touched])
            if contact.reaction > 0.0 or rebound_speed <= 0.0:
                log_event(log, i, laws.transitions[x].event, -contact.opening_speed)
            _end_impact(after, model, state, i, m, x, touched, rebound_speed)
        elif contact.bound == FREE and gap >= 0:
            state.z[first + gap] = 0.0
        elif contact.bound != FREE:
            opening_speed = contact.sign * (contact.velocity_before - body_velocity)
            if gap >= 0:
                opening_speed = contact.sign * state.z[first + gap]
            if opening_speed > ROUNDING * (abs(contact.velocity_before) + abs(body_velocity)):
                touched = LOW if contact.sign > 0.0 else HIGH
                release(after, model, state, log, i, touched, contact.velocity_before, 1)
            elif gap >= 0:
                state.z[first + gap] = 0.0
    _slip_by_impact(after, model, state, log)
    # The impact changes the velocities of walls, so that the rate of a gap may no longer be exactly zero.
    for i in range(unsigned(laws.elements.shape[0])):
        if laws.regimes[regime_number(laws.elements, state.regime, i)].can_hit:
            slot = laws.elements[i].first_slot
            state.multiplicity[slot] = min(1, max(-1, state.multiplicity[slot]))


@inlined_kernel
def _separate_independent(after: Ints, model: Model, state: State, log: Log, work: ContactWorkspace) -> None:
    """Separate each mass whose contact force is tensile, if contacts do not affect each other."""
    for i in range(unsigned(model.laws.elements.shape[0])):
        m = regime_number(model.laws.elements, state.regime, i)
        regime = model.laws.regimes[m]
        if not regime.is_held:
            continue
        row = model.laws.elements[i].position_index
        # Upward contact force on the mass divided by the mass, if it moves with its body.
        relative_acceleration = work.force[row] * model.inverse_mass[row, row] + model.gravity
        if regime.push * relative_acceleration >= 0.0:
            continue
        magnitude = model.gravity
        for c in range(model.force.shape[1]):
            magnitude += abs(model.force[0, c, row] * state.z[c]) * model.inverse_mass[row, row]
        if abs(relative_acceleration) > ROUNDING * magnitude:
            separate(after, model, state, log, i, m, LOW if regime.push > 0.0 else HIGH, _TENSILE_MULTIPLICITY)


@kernel
def _separate_coupled(after: Ints, model: Model, state: State, log: Log, work: ContactWorkspace) -> None:
    """Solve for the forces on all held masses, and release the masses whose force is at an end of its interval."""
    count = 0
    for i in range(unsigned(model.laws.elements.shape[0])):
        m, element, contact = (
            regime_number(model.laws.elements, state.regime, i),
            model.laws.elements[i],
            work.contacts[count],
        )
        if not model.laws.regimes[m].is_held:
            continue
        _set_direction(element, i, model.laws.regimes[m].push, contact)
        is_detached = element.gap_coordinate < 0
        free_acceleration = 0.0
        magnitude = model.gravity if is_detached else 0.0
        for c in range(model.inverse_mass.shape[0]):
            free_acceleration += model.inverse_mass[contact.row, c] * work.force[c]
            for column in range(model.force.shape[1]):
                magnitude += abs(model.inverse_mass[contact.row, c] * model.force[0, column, c] * state.z[column])
        contact.rhs = contact.direction * free_acceleration
        if is_detached:
            contact.rhs = contact.sign * (-model.gravity - free_acceleration)
        contact.magnitude = magnitude
        low, high = model.laws.numbers[m, 0, LOWER], model.laws.numbers[m, 0, UPPER]
        if contact.sign < 0.0:
            low, high = -high, -low
        contact.low, contact.high = element.mass * low, element.mass * high
        count += 1
    contact_matrix(model.inverse_mass, work, count)
    solve_complementarity(work, count)
    for a in range(count):
        contact = work.contacts[a]
        if contact.bound == FREE:
            continue
        at_low = contact.bound == AT_LOW
        opening_acceleration = contact.rhs
        for b in range(count):
            opening_acceleration += work.matrix[a, b] * work.contacts[b].reaction
        if not at_low:
            opening_acceleration = -opening_acceleration
        magnitude = contact.magnitude + abs(work.matrix[a, a] * contact.reaction)
        if opening_acceleration > ROUNDING * magnitude:
            end = LOW if at_low == (contact.sign > 0.0) else HIGH
            m = regime_number(model.laws.elements, state.regime, contact.damper)
            separate(after, model, state, log, contact.damper, m, end, _TENSILE_MULTIPLICITY)


@inlined_kernel
def separate_tensile(after: Ints, model: Model, state: State, log: Log, work: ContactWorkspace) -> None:
    """Separate every mass at rest whose contact force would be tensile by more than rounding."""
    _sum_forces(model, state, work.force)
    if model.coupled:
        _separate_coupled(after, model, state, log, work)
    else:
        _separate_independent(after, model, state, log, work)


@inlined_kernel
def impact(
    after: Ints, model: Model, state: State, log: Log, j: int, m: int, x: int, end: int, work: ContactWorkspace
) -> None:
    """Apply the impact of element j on the wall at an end of its gap; `separate_tensile` must follow."""
    if model.coupled or model.laws.transitions[x].restitution > 0.0:
        _sum_forces(model, state, work.force)
    if model.coupled:
        _coupled_impact(after, model, state, log, j, m, end, work)
    else:
        _independent_impact(after, model, state, log, j, m, x, end, work)


@inlined_kernel
def _is_gap(signal: Any) -> bool:
    """Return whether a signal is the gap or the speed, or a multiple of it."""
    return signal.gap_factor == 0.0 or signal.speed_factor == 0.0


@kernel
def _side_of_limit(laws: LawTables, state: State, j: int, m: int, slot: int, end: int, speed: float) -> int:
    """Return the side of a limit on which a signal of regime m is: 1 inside, 0 at it within rounding, -1 outside.

    Without a dashpot, the signal is zero at every touch and release. An exception is a contact that the impact of
    another element starts or ends through a full mass matrix.
    """
    element, signal, number = laws.elements[j], laws.signals[m, slot], laws.numbers[m, slot]
    limit = number[LOWER if end == LOW else UPPER]
    if abs(limit) == np.inf:
        return 1
    quantity, factor = _gap(element, state, j), signal.gap_factor
    if element.slider_coordinate >= 0:
        quantity -= state.z[element.slider_coordinate]  # the factor of the slider is minus that of the gap
    if signal.is_speed:
        quantity, factor = speed, signal.speed_factor
    distance = factor * (quantity - number[REST]) - limit
    rounding = signal.rounding * abs(speed)
    if not _is_gap(signal):
        dashpot_force = signal.speed_factor * speed
        rounding += _MAX_ZERO_FORCE_RATIO * (abs(distance) + abs(dashpot_force))
        distance += dashpot_force
    if abs(distance) <= rounding:
        return 0
    return 1 if _push_of(end) * distance > 0.0 else -1


@kernel
def _is_consistent(laws: LawTables, state: State, j: int, m: int, speed: float) -> bool:
    """Return whether each signal of regime m is inside its interval, or is a gap at a limit and moves inwards."""
    for slot in range(laws.elements[j].slots):
        for end in range(2):
            side = _side_of_limit(laws, state, j, m, slot, end, speed)
            inward_rate = _push_of(end) * laws.numbers[m, slot, SCALE] * speed
            if side < 0 or (side == 0 and _is_gap(laws.signals[m, slot]) and inward_rate <= 0.0):
                return False
    return True


@inlined_kernel
def _speed_rounding(element: Any, z: Array, step: float) -> float:
    """Return the rounding error of a speed [m/s]: proportional to its terms, velocity and displacement / step."""
    return ROUNDING * (abs(z[element.velocity_index]) + abs(z[element.position_index]) / step)


@kernel
def _stop_simultaneously(after: Ints, model: Model, state: State, log: Log, j: int) -> None:
    """Stop the masses that slide at a speed of zero within rounding at the instant at which element j stops.

    The forces that then hold these masses depend on each other.
    """
    laws = model.laws
    for i in range(unsigned(laws.elements.shape[0])):
        m, element = regime_number(laws.elements, state.regime, i), laws.elements[i]
        if i == j or element.gap_coordinate < 0 or element.slider_coordinate >= 0:
            continue
        for slot in range(element.slots):
            if not laws.signals[m, slot].is_speed or state.multiplicity[element.first_slot + slot] != 0:
                continue
            if abs(_speed(element, state.z, model.first_velocity)) <= _speed_rounding(element, state.z, model.step):
                x = unsigned(laws.transition[m, slot, LOW if laws.transition[m, slot, LOW] != NONE else HIGH])
                state.z[model.first_velocity + element.gap_coordinate] = 0.0
                change_regime(after, laws, state, i, m, laws.target[x, 0])
                log_event(log, i, laws.transitions[x].event, 0.0)
                break


@inlined_kernel
def _remember(model: Model, state: State, j: int, m: int, m_before: int) -> None:
    """Set the slider of element j so that its force, which is at a limit, does not jump at the change to regime m."""
    element, force = model.laws.elements[j], model.laws.regimes[m_before].force_constant
    state.z[element.slider_coordinate] = _gap(element, state, j) - force / model.laws.regimes[m].force_gap
    # The rate of the force is proportional to the speed, which is zero unless an impact has changed it.
    zeros = (
        2 if abs(_speed(element, state.z, model.first_velocity)) <= _speed_rounding(element, state.z, model.step) else 1
    )
    state.multiplicity[element.first_slot] = zeros if force < 0.0 else -zeros


@kernel
def change_force(after: Ints, model: Model, state: State, log: Log, j: int, x: int) -> None:
    """Apply a transition without a jump of velocities to an element whose gap is a coordinate."""
    laws, element, present = model.laws, model.laws.elements[j], regime_number(model.laws.elements, state.regime, j)
    event, candidate, speed = laws.transitions[x].event, 0, _speed(element, state.z, model.first_velocity)
    while (
        candidate + 1 < laws.target.shape[1]
        and laws.target[x, candidate + 1] != NONE
        and not _is_consistent(laws, state, j, element.first_regime + laws.target[x, candidate], speed)
    ):
        candidate += 1
    m = element.first_regime + laws.target[x, candidate]
    regime = laws.regimes[m]
    for slot in range(element.slots):
        at_low = not regime.is_held and _side_of_limit(laws, state, j, m, slot, LOW, speed) == 0
        at_high = not regime.is_held and _side_of_limit(laws, state, j, m, slot, HIGH, speed) == 0
        state.multiplicity[element.first_slot + slot] = 1 if at_low else -1 if at_high else 0
    if regime.force_slider != 0.0:
        _remember(model, state, j, m, present)
    if regime.is_held:
        state.z[model.first_velocity + element.gap_coordinate] = 0.0
        _stop_simultaneously(after, model, state, log, j)
    change_regime(after, laws, state, j, present, laws.target[x, candidate])
    if event != NO_EVENT:
        log_event(
            log, j, event, -regime.push * _speed(element, state.z, model.first_velocity) if regime.wall > 0 else 0.0
        )
