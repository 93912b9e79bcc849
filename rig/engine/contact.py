"""Contact laws of dampers with instant contact: impact, rebound, separation, and their effect on other dampers.

A damper is in `FLIGHT`, or at rest on the `FLOOR` or at the `CEILING` of its cavity. Contact is unilateral: its force
is never tensile. With a diagonal mass matrix and one damper in each body, every contact is independent. With a full
mass matrix, or several dampers in a body, an impact may separate other dampers from their walls. Then all contacts of
the instant are solved together (`rig.numerics.complementarity`).

The gap is the distance from a damper to its wall, the opening speed its rate of change. A closing speed or approach
speed is the negative of the opening speed.

A Zeno sequence is infinitely many, ever lower rebounds in a finite time. The simulation ends it when the height of a
rebound is below the rounding error.

Function arguments: `j` is the number of a damper from 0, and `work` is scratch space. `state.z` contains displacements
and velocities of the bodies, `state.height` and `state.velocity` those of the dampers in flight. The `multiplicity` of
a gap's zero is the number of leading terms of its power series in time (gap, rate, ...) that are exactly zero.

References
----------
Pfeiffer, F., Glocker, C., "Multibody Dynamics with Unilateral Contacts", Wiley 1996, chapters 6 and 8 (contact
laws on acceleration and on impulse level).
"""

from __future__ import annotations

from rig.arrays import Array
from rig.engine.finite_contact import wall_force
from rig.engine.flow import Flow, Model
from rig.engine.state import CEILING, FLIGHT, FLOOR, SEPARATION, Log, State, log_event, toggle_contact
from rig.numerics.complementarity import ROUNDING, ContactWorkspace, contact_matrix, solve_active, solve_complementarity
from rig.numerics.jit import inlined_kernel, kernel
from rig.numerics.simd import affine_product

#: Multiplicity of the gap's zero when a damper separates under tension: gap and its rate are zero.
_TENSILE_MULTIPLICITY = 2


@inlined_kernel
def _set_flying(flow: Flow, model: Model, state: State, j: int, velocity: float, multiplicity: int) -> None:
    """Change damper j from rest on its wall to flight with a velocity, m/s, positive upwards."""
    height = state.z[model.position_index[j]]
    if state.contact[j] == CEILING:
        height += model.clearance[j]
        multiplicity = -multiplicity
    state.height[j] = height
    state.velocity[j] = velocity
    state.contact[j] = FLIGHT
    state.multiplicity[j] = multiplicity
    toggle_contact(flow, model, state, j)


@inlined_kernel
def separate(flow: Flow, model: Model, state: State, log: Log, j: int, multiplicity: int) -> None:
    """Separate damper j from its wall with the velocity of the wall, and log the event."""
    _set_flying(flow, model, state, j, state.z[model.velocity_index[j]], multiplicity)
    log_event(log, j, SEPARATION, 0.0)


@inlined_kernel
def _contact_direction(contact: int) -> float:
    """Return the direction in which a wall pushes a damper: 1 (up) for the floor, -1 for the ceiling."""
    return -1.0 if contact == CEILING else 1.0


@inlined_kernel
def _sum_forces(model: Model, state: State, force: Array) -> None:
    """Sum the forces of springs, dashpots, drive and finite-duration contacts on every coordinate, N."""
    affine_product(model.force, model.force_constant, 0, state.z, model.force.shape[1], force)
    for j in range(model.mass.shape[0]):
        if model.gap_coordinate[j] >= 0 and state.contact[j] != FLIGHT:
            force[model.gap_coordinate[j]] += _contact_direction(state.contact[j]) * wall_force(
                model, state.z, j, state.contact[j]
            )


@inlined_kernel
def _rebound_is_negligible(model: Model, state: State, j: int, rebound_speed: float, force: Array) -> bool:
    """Return whether the height of a rebound is below the rounding of the gap; this ends a Zeno sequence.

    `rebound_speed`: relative to the wall, m/s; `force`: on every coordinate, N.

    With a full mass matrix, other contacts also accelerate the body by an unknown amount, so an upper bound of its
    acceleration is used. A damper that is wrongly set to rest has a tensile contact force and separates immediately.
    """
    row = model.position_index[j]
    if model.coupled:
        approach_acceleration = model.gravity
        for c in range(model.inverse_mass.shape[0]):
            approach_acceleration += abs(model.inverse_mass[row, c] * force[c])
    else:
        body_acceleration = force[row] * model.inverse_mass[row, row]
        approach_acceleration = _contact_direction(state.contact[j]) * (body_acceleration + model.gravity)
    # The gap is a difference of heights; its rounding error is proportional to the sum of their magnitudes, m.
    height_magnitude = 2.0 * abs(state.z[row])
    if state.contact[j] == CEILING:
        height_magnitude += model.clearance[j]
    # A rebound at speed v reaches the height v^2 / (2 a).
    min_squared_speed = 2.0 * approach_acceleration * ROUNDING * height_magnitude
    return approach_acceleration > 0.0 and rebound_speed * rebound_speed < min_squared_speed


@inlined_kernel
def _end_impact(flow: Flow, model: Model, state: State, j: int, rebound_speed: float) -> None:
    """Set damper j in flight from the wall that it hit (`state.contact`), or at rest on it for rebound speed 0."""
    sign = _contact_direction(state.contact[j])
    if rebound_speed > 0.0:
        height = state.z[model.position_index[j]]
        if state.contact[j] == CEILING:
            height += model.clearance[j]
        state.height[j] = height
        state.velocity[j] = state.z[model.velocity_index[j]] + sign * rebound_speed
        state.contact[j] = FLIGHT
        state.multiplicity[j] = 1 if sign > 0.0 else -1
    else:
        state.multiplicity[j] = 0
        toggle_contact(flow, model, state, j)


@kernel
def _touched_wall(model: Model, state: State, j: int) -> int:
    """Return the wall that a flying damper touches within rounding error while approaching it, or FLIGHT."""
    position = state.z[model.position_index[j]]
    gap = state.height[j] - position
    floor_approach_speed = state.z[model.velocity_index[j]] - state.velocity[j]
    rounding = ROUNDING * (abs(position) + abs(state.height[j]))
    if floor_approach_speed > 0.0 and state.multiplicity[j] <= 0 and gap <= rounding:
        return FLOOR
    if floor_approach_speed < 0.0 and state.multiplicity[j] >= 0 and gap >= model.clearance[j] - rounding:
        return CEILING
    return FLIGHT


@inlined_kernel
def _independent_impact(
    flow: Flow, model: Model, state: State, log: Log, j: int, wall: int, work: ContactWorkspace
) -> None:
    """Apply the impact of damper j if the mass matrix does not couple it to other dampers."""
    velocity_index = model.velocity_index[j]
    state.contact[j] = wall
    sign = _contact_direction(wall)
    closing_speed = sign * (state.z[velocity_index] - state.velocity[j])
    rebound_speed = model.restitution[j] * closing_speed
    if rebound_speed > 0.0 and _rebound_is_negligible(model, state, j, rebound_speed, work.force):
        rebound_speed = 0.0
    inverse_mass = model.inverse_mass[model.position_index[j], model.position_index[j]]
    impulse = (closing_speed + rebound_speed) / (inverse_mass + 1.0 / model.mass[j])
    state.z[velocity_index] -= sign * impulse * inverse_mass
    log_event(log, j, wall, closing_speed)
    _end_impact(flow, model, state, j, rebound_speed)


@kernel
def _close_slow_openings(model: Model, state: State, work: ContactWorkspace, count: int) -> None:
    """Keep the contacts closed that an impact opens too slowly for the gap to exceed rounding.

    `count`: number of contacts that take part in the impact; they are the first entries of the arrays in `work`.

    Two dampers coupled through the mass matrix can separate each other from their walls at ever shorter intervals. This
    Zeno sequence is ended in the same way as a sequence of rebounds.
    """
    changed = False
    for a in range(count):
        if work.active[a]:
            continue
        opening_speed = work.opening_speed[a]
        for b in range(count):
            opening_speed += work.matrix[a, b] * work.reaction[b]
        if _rebound_is_negligible(model, state, work.damper[a], opening_speed, work.force):
            work.active[a] = True
            changed = True
    if changed:
        solve_active(work, count)


@kernel
def _coupled_impact(
    flow: Flow, model: Model, state: State, log: Log, j: int, wall: int, work: ContactWorkspace
) -> None:
    """Apply the impact of damper j, with its effect through a full mass matrix on dampers that touch a wall."""
    count = 0
    for i in range(model.mass.shape[0]):
        if model.gap_coordinate[i] >= 0:
            continue
        work.flying[count] = state.contact[i] == FLIGHT
        if work.flying[count]:
            contact = wall if i == j else _touched_wall(model, state, i)
            if contact == FLIGHT:
                continue
            state.contact[i] = contact
        sign = _contact_direction(state.contact[i])
        work.damper[count] = i
        work.sign[count] = sign
        work.velocity_before[count] = state.z[model.velocity_index[i]]
        work.opening_speed[count] = (
            sign * (state.velocity[i] - work.velocity_before[count]) if work.flying[count] else 0.0
        )
        rebound_speed = -model.restitution[i] * work.opening_speed[count]
        if rebound_speed > 0.0 and _rebound_is_negligible(model, state, i, rebound_speed, work.force):
            rebound_speed = 0.0
        work.rhs[count] = work.opening_speed[count] - rebound_speed
        count += 1
    contact_matrix(model, work, count)
    solve_complementarity(work, count)
    _close_slow_openings(model, state, work, count)
    for a in range(count):
        column = model.position_index[work.damper[a]]
        for row in range(model.inverse_mass.shape[0]):
            change = model.inverse_mass[row, column] * work.sign[a] * work.reaction[a]
            state.z[model.first_velocity + row] -= change
    for a in range(count):
        i = work.damper[a]
        body_velocity = state.z[model.velocity_index[i]]
        if work.flying[a]:
            damper_velocity = state.velocity[i] + work.sign[a] * work.reaction[a] / model.mass[i]
            rebound_speed = work.sign[a] * (damper_velocity - body_velocity)
            is_plastic = work.rhs[a] == work.opening_speed[a]  # the required rebound speed is zero
            if work.active[a] and is_plastic:
                rebound_speed = 0.0
            # The gap of damper j is zero and decreasing. A new opening speed up to the opening speed before the impact
            # is a rounding error.
            if i == j and 0.0 < rebound_speed <= work.opening_speed[a]:
                rebound_speed = 0.0
            # Without reaction, another impact has moved the wall away before the damper touched it.
            if work.reaction[a] > 0.0 or rebound_speed <= 0.0:
                log_event(log, i, state.contact[i], -work.opening_speed[a])
            _end_impact(flow, model, state, i, rebound_speed)
        elif not work.active[a]:
            opening_speed = work.sign[a] * (work.velocity_before[a] - body_velocity)
            if opening_speed > ROUNDING * (abs(work.velocity_before[a]) + abs(body_velocity)):
                _set_flying(flow, model, state, i, work.velocity_before[a], 1)
                log_event(log, i, SEPARATION, 0.0)
    # The impact changes the velocities of walls: the rate of a gap that was zero need not be zero any more.
    for i in range(model.mass.shape[0]):
        if state.contact[i] == FLIGHT:
            state.multiplicity[i] = min(1, max(-1, state.multiplicity[i]))


@inlined_kernel
def _separate_independent(flow: Flow, model: Model, state: State, log: Log, work: ContactWorkspace) -> None:
    """Separate each damper whose contact force is tensile, if contacts do not affect each other."""
    force = work.force
    for i in range(model.mass.shape[0]):
        if model.gap_coordinate[i] >= 0 or state.contact[i] == FLIGHT:
            continue
        row = model.position_index[i]
        # Upward contact force on the damper divided by its mass, if it moves with its body.
        relative_acceleration = force[row] * model.inverse_mass[row, row] + model.gravity
        if _contact_direction(state.contact[i]) * relative_acceleration >= 0.0:
            continue
        magnitude = model.gravity
        for c in range(model.force.shape[1]):
            magnitude += abs(model.force[0, c, row] * state.z[c]) * model.inverse_mass[row, row]
        if abs(relative_acceleration) > ROUNDING * magnitude:
            separate(flow, model, state, log, i, _TENSILE_MULTIPLICITY)


@kernel
def _separate_coupled(flow: Flow, model: Model, state: State, log: Log, work: ContactWorkspace) -> None:
    """Solve for the forces of all closed contacts, and separate the dampers without a compressive force."""
    count = 0
    for i in range(model.mass.shape[0]):
        if model.gap_coordinate[i] >= 0 or state.contact[i] == FLIGHT:
            continue
        row = model.position_index[i]
        free_acceleration = 0.0
        magnitude = model.gravity
        for c in range(model.inverse_mass.shape[0]):
            free_acceleration += model.inverse_mass[row, c] * work.force[c]
            for column in range(model.force.shape[1]):
                magnitude += abs(model.inverse_mass[row, c] * model.force[0, column, c] * state.z[column])
        work.damper[count] = i
        work.sign[count] = _contact_direction(state.contact[i])
        work.rhs[count] = work.sign[count] * (-model.gravity - free_acceleration)
        work.magnitude[count] = magnitude
        count += 1
    contact_matrix(model, work, count)
    solve_complementarity(work, count)
    for a in range(count):
        if work.reaction[a] == 0.0:
            opening_acceleration = work.rhs[a]
            for b in range(count):
                opening_acceleration += work.matrix[a, b] * work.reaction[b]
            if opening_acceleration > ROUNDING * work.magnitude[a]:
                separate(flow, model, state, log, work.damper[a], _TENSILE_MULTIPLICITY)


@inlined_kernel
def separate_tensile(flow: Flow, model: Model, state: State, log: Log, work: ContactWorkspace) -> None:
    """Separate every damper at rest whose contact force would be tensile by more than rounding."""
    _sum_forces(model, state, work.force)
    if model.coupled:
        _separate_coupled(flow, model, state, log, work)
    else:
        _separate_independent(flow, model, state, log, work)


@inlined_kernel
def impact(flow: Flow, model: Model, state: State, log: Log, j: int, wall: int, work: ContactWorkspace) -> None:
    """Apply the impact of damper j with a wall: velocities jump. `separate_tensile` must follow."""
    if model.coupled or model.restitution[j] > 0.0:
        _sum_forces(model, state, work.force)
    if model.coupled:
        _coupled_impact(flow, model, state, log, j, wall, work)
    else:
        _independent_impact(flow, model, state, log, j, wall, work)
