"""Contact laws at impacts and separations, compared with explicit mechanics: momentum, separations and velocities.

`state.z` has the displacements and velocities of the bodies; `state.height` and `state.velocity` are those of dampers
in flight. `state.regime` of a bed is FLIGHT, FLOOR or CEILING. `TABLE_INDEX` -1 means that the matrices of the
contacts have not been looked up.

`state.multiplicity` is the multiplicity of the gap's zero for a damper that has just left a wall: 1 after a rebound, 2
after a separation without relative velocity; negative at the ceiling. Otherwise it is 0.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rig
from rig.core.engine.law_tables import HIGH, LOW, NONE
from rig.core.engine.propagator import Propagator
from rig.core.engine.resets import (
    _close_slow_openings,
    _rebound_is_negligible,
    _separate_coupled,
    _separate_independent,
    _sum_forces,
    _touched_end,
    impact,
    separate_tensile,
)
from rig.core.engine.state import N_EVENTS, PRESENT_SEGMENT, TABLE_INDEX, State, regime_number
from rig.core.laws.events import CEILING, FLIGHT, FLOOR, SEPARATION
from rig.core.numerics.complementarity import AT_LOW, FREE, ROUNDING
from rig.core.system.assembly import assemble
from rig.core.system.drive_generator import pure_tone
from tests.rig.numerics.test_complementarity import solve_by_enumeration

CLEARANCE = 2e-3  # m
# Direction of the contact force of a wall on the damper.
SIGN = {FLOOR: 1.0, CEILING: -1.0}
# End of the interval of the gap at each wall.
END = {FLOOR: LOW, CEILING: HIGH, FLIGHT: NONE}
REGIMES = {FLIGHT: "flight", FLOOR: "floor", CEILING: "ceiling"}
FINITE_MODES = {FLIGHT: "free", FLOOR: "on floor", CEILING: "on ceiling"}


def propagator(coupling: float, restitution: float = 0.0, finite_contacts: int = 0, uncoupled: int = 0) -> Propagator:
    """Return the engine for three bodies with a damper each.

    `coupling`: off-diagonal elements of the mass matrix, kg; `finite_contacts`: number of dampers, from the first, with
    finite-duration contact; `uncoupled`: number of bodies, from the last, without coupling.
    """
    contact = {"contact": {"duration": "2 ms"}}
    dampers = [
        {"body": body, "mass": 0.1 * body, "clearance": CLEARANCE, "restitution": restitution}
        | (contact if body <= finite_contacts else {})
        for body in (1, 2, 3)
    ]
    coupled = np.arange(3) < 3 - uncoupled
    mass = np.diag([1.0, 0.8, 0.6]) + coupling * (1 - np.eye(3)) * np.outer(coupled, coupled)
    scene = rig.Scene(
        structure={
            "matrices": {
                "mass": mass.tolist(),
                "stiffness": (4e3 * np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])).tolist(),
            }
        },
        dampers=dampers,
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 10.0, "force": 1.0},
    )
    return Propagator(assemble(scene), pure_tone(np.ones(1), 60.0), 2e-3)


def impact_and_separate(engine: Propagator, damper: int, wall: int) -> None:
    """Apply the impact of a damper on a wall 0.25 s after the start of segment 7; then separate tensile contacts."""
    after, model, work = engine.tables.flow.after, engine.tables.model, engine.workspace.contact
    engine.log.counts[PRESENT_SEGMENT], engine.log.present_offset[0] = 7, 0.25
    m, end = regime_number(model.laws.elements, engine.state.regime, damper), END[wall]
    impact(after, model, engine.state, engine.log, damper, m, model.laws.transition[m, 0, end], end, work)
    separate_tensile(after, model, engine.state, engine.log, work)


def randomize(engine: Propagator, contacts: list[int], seed: int) -> State:
    """Set and return a random state with given contacts; dampers in flight are away from their walls."""
    random, state, model = np.random.default_rng(seed), engine.state, engine.tables.model
    size = engine.tables.size
    state.z[:size] = 1e-3 * random.standard_normal(size)
    state.z[model.laws.elements.velocity_index] = random.standard_normal(3)
    state.regime[:] = contacts
    state.height[:] = state.z[model.laws.elements.position_index] + random.uniform(0.2, 0.8, 3) * CLEARANCE
    state.velocity[:] = random.standard_normal(3)
    state.counters[TABLE_INDEX] = -1
    return state


CONTACTS = st.lists(st.sampled_from([FLIGHT, FLOOR, CEILING]), min_size=3, max_size=3)


@given(contacts=CONTACTS, finite_contacts=st.integers(0, 3), seed=st.integers(0, 10_000))
def test_finite_contact_forces_equal_the_system_matrices(contacts: list[int], finite_contacts: int, seed: int) -> None:
    engine = propagator(0.1, finite_contacts=finite_contacts)
    state, model, system = randomize(engine, contacts, seed), engine.tables.model, engine.system
    names = [(FINITE_MODES if j < finite_contacts else REGIMES)[wall] for j, wall in enumerate(contacts)]
    force, constant = system.contact_forces(system.configuration(names))
    z, drive = state.z[: system.states], state.z[system.states : engine.tables.size]
    expected = (system.force_state + force) @ z + constant + system.force_constant
    expected += system.force_drive @ (engine.drive.output @ drive)
    work = engine.workspace.contact
    _sum_forces(model, state, work.force)
    np.testing.assert_allclose(work.force[: system.coordinates], expected, rtol=1e-9, atol=1e-9)


@given(
    coupled=st.booleans(),
    restitution=st.sampled_from([0.0, 0.4]),
    wall=st.sampled_from([FLOOR, CEILING]),
    contacts=CONTACTS,
    impacting=st.integers(0, 2),
    seed=st.integers(0, 10_000),
)
@settings(deadline=None)
def test_impact_obeys_the_contact_laws(coupled, restitution, wall, contacts, impacting, seed):
    engine = propagator(0.15 if coupled else 0.0, restitution)
    contacts[impacting] = FLIGHT
    state, model = randomize(engine, contacts, seed), engine.tables.model
    position, body_velocity = state.z[model.laws.elements.position_index], state.z[model.laws.elements.velocity_index]
    damper_velocity = np.where(state.regime == FLIGHT, state.velocity, body_velocity)
    sign, closing_speed = SIGN[wall], 0.1 + abs(damper_velocity[impacting])
    state.height[impacting] = height = position[impacting] + (CLEARANCE if wall == CEILING else 0.0)
    damper_velocity[impacting] = state.velocity[impacting] = body_velocity[impacting] - sign * closing_speed
    impact_and_separate(engine, impacting, wall)
    body_velocity_after = state.z[model.laws.elements.velocity_index]
    damper_velocity_after = np.where(state.regime == FLIGHT, state.velocity, body_velocity_after)

    # Momentum is conserved. Impulses are compressive. They act on another damper only if it is in contact and its body
    # is coupled.
    impulse = model.laws.elements.mass * (damper_velocity_after - damper_velocity)
    np.testing.assert_allclose(engine.system.mass @ (body_velocity_after - body_velocity), -impulse, atol=1e-12)
    walls = np.array([wall if j == impacting else contacts[j] for j in range(3)])
    for j in range(3):
        assert SIGN.get(walls[j], 0.0) * impulse[j] >= -1e-12
        assert j == impacting or (coupled and walls[j] != FLIGHT) or impulse[j] == 0.0

    # The damper rebounds with the restitution, from its wall.
    rebound_speed = sign * (damper_velocity_after[impacting] - body_velocity_after[impacting])
    assert rebound_speed == pytest.approx(restitution * closing_speed, abs=1e-12)
    if restitution:
        assert state.height[impacting] == height
        assert state.multiplicity[impacting] == sign
    if state.regime[impacting] == wall:
        assert state.multiplicity[impacting] == 0

    # The log has the impact and all separations.
    log, count = engine.log, engine.log.counts[N_EVENTS]
    (k,) = np.flatnonzero(log.events.kind[:count] != SEPARATION)
    instant = log.events.segment[k], log.events.offset[k]
    assert (*instant, log.events.damper[k], log.events.kind[k]) == (7, 0.25, impacting, wall)
    assert log.events.speed[k] == pytest.approx(closing_speed)
    separated = [int(j) for j in log.events.damper[:count][log.events.kind[:count] == SEPARATION]]
    rebounded = {impacting} if restitution else set()
    assert {j for j in range(3) if walls[j] != FLIGHT and state.regime[j] == FLIGHT} - rebounded == set(separated)
    for j in separated:
        # A separated damper has its velocity before the impact, or the velocity of its wall after the impact.
        opening_speed = SIGN[walls[j]] * (damper_velocity_after[j] - body_velocity_after[j])
        assert damper_velocity_after[j] == (body_velocity_after[j] if opening_speed == 0.0 else body_velocity[j])
        assert opening_speed >= 0.0 and state.height[j] == position[j] + (CLEARANCE if walls[j] == CEILING else 0.0)


@given(coupled=st.booleans(), contacts=CONTACTS, seed=st.integers(0, 10_000))
@settings(deadline=None)
def test_separated_dampers_solve_the_complementarity_problem(coupled: bool, contacts: list[int], seed: int) -> None:
    engine = propagator(0.15 if coupled else 0.0)
    state, model, system = randomize(engine, contacts, seed), engine.tables.model, engine.system
    work = engine.workspace.contact
    _sum_forces(model, state, work.force)
    # Complementarity: acceleration away from the wall (matrix @ reaction + bias) and contact force (reaction) are not
    # negative, and one of them is zero for each damper. A damper with a positive acceleration separates.
    in_contact = np.flatnonzero(np.array(contacts) != FLIGHT)
    sign = np.array([SIGN[contacts[j]] for j in in_contact])
    inverse = np.linalg.inv(system.mass)
    free_acceleration = inverse @ work.force[:3]  # of the bodies without contacts
    bias = sign * (-model.gravity - free_acceleration[in_contact])
    matrix = sign[:, None] * inverse[np.ix_(in_contact, in_contact)] * sign + np.diag(
        1.0 / model.laws.elements.mass[in_contact]
    )
    reaction = solve_by_enumeration(matrix, bias)
    separate_tensile(engine.tables.flow.after, model, state, engine.log, work)
    separated = in_contact[(reaction == 0.0) & (matrix @ reaction + bias > 1e-9)]
    assert set(np.flatnonzero(state.regime == FLIGHT)) & set(in_contact) == set(separated)
    assert engine.log.events.damper[: engine.log.counts[N_EVENTS]].tolist() == separated.tolist()
    for j in separated:
        on_floor = contacts[j] == FLOOR
        assert state.velocity[j] == state.z[model.laws.elements.velocity_index[j]]
        assert state.height[j] == state.z[model.laws.elements.position_index[j]] + (0.0 if on_floor else CLEARANCE)
        assert state.multiplicity[j] == (2 if on_floor else -2)


@pytest.mark.parametrize("wall", [FLOOR, CEILING])
@pytest.mark.parametrize("coupled", [False, True])
def test_rebound_within_rounding_stays_in_contact(wall: int, coupled: bool) -> None:
    engine = propagator(0.2 if coupled else 0.0)
    state, model, work = engine.state, engine.tables.model, engine.workspace.contact
    # A rebound is negligible if its height v^2 / (2 a) is within the rounding error ROUNDING * coordinate_scale of the
    # gap. With coupling, a is an upper bound of the acceleration.
    row, wall_gap = model.laws.elements.position_index[1], CLEARANCE if wall == CEILING else 0.0
    state.z[row], coordinate_scale = -0.3, 2 * 0.3 + wall_gap
    contact = model, state, 1, SIGN[wall], wall_gap
    force = np.array([3.0, -20.0 * SIGN[wall] - 10.0, 5.0])
    if not coupled:
        force[1] = 8.0 if wall == FLOOR else -25.0
    inverse = np.linalg.inv(engine.system.mass)[1]
    acceleration_limit = model.gravity + np.abs(inverse * force).sum()
    if not coupled:
        acceleration_limit = SIGN[wall] * (model.gravity + inverse[1] * force[1])
    speed_limit = np.sqrt(2 * acceleration_limit * ROUNDING * coordinate_scale)
    work.force[:3] = force
    assert _rebound_is_negligible(*contact, 0.999 * speed_limit, work.force)
    assert not _rebound_is_negligible(*contact, 1.001 * speed_limit, work.force)
    if not coupled:
        # The contact force would be tensile.
        work.force[1] = -100.0 * SIGN[wall]
        assert not _rebound_is_negligible(*contact, 1e-30, work.force)


@pytest.mark.parametrize("wall", [FLOOR, CEILING])
@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize(("ratio", "separates"), [(-2.0, False), (0.0, False), (0.99, False), (1.01, True)])
def test_tension_within_rounding_does_not_separate(wall: int, coupled: bool, ratio: float, separates: bool) -> None:
    engine = propagator(0.2 if coupled else 0.0)
    state, model, system = randomize(engine, [FLIGHT, wall, FLIGHT], 3), engine.tables.model, engine.system
    # The state is far from rest, so that large terms nearly cancel.
    state.z[: engine.tables.size] *= 1e3
    terms = np.hstack([system.force_state, system.force_drive @ engine.drive.output])
    inverse = np.linalg.inv(system.mass)[1]
    acceleration_scale = model.gravity + np.abs(inverse) @ np.abs(terms * state.z[: terms.shape[1]]).sum(axis=1)
    assert np.count_nonzero(inverse) == (3 if coupled else 1) and acceleration_scale > 1e3 * model.gravity
    # `ratio`: acceleration away from the wall over its rounding error.
    acceleration = -SIGN[wall] * ratio * ROUNDING * acceleration_scale
    work = engine.workspace.contact
    work.force[:3] = 0.0, (acceleration - model.gravity) / inverse[1], 0.0
    separate_tensile_dampers = _separate_coupled if coupled else _separate_independent
    engine.log.counts[PRESENT_SEGMENT], engine.log.present_offset[0] = 7, 0.25
    separate_tensile_dampers(engine.tables.flow.after, model, state, engine.log, work)
    assert (state.regime[1] == FLIGHT) == separates and engine.log.counts[N_EVENTS] == separates
    if separates:
        log = engine.log
        assert (log.events.segment[0], log.events.offset[0], log.events.damper[0]) == (7, 0.25, 1)


@pytest.mark.parametrize("wall", [FLOOR, CEILING])
@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize(("closing_speed", "stays"), [(1e-9, True), (1e-3, False)])
def test_only_a_negligible_rebound_comes_to_rest(wall: int, coupled: bool, closing_speed: float, stays: bool) -> None:
    engine = propagator(0.2 if coupled else 0.0, restitution=0.4)
    state, model = engine.state, engine.tables.model
    state.regime[:], state.counters[TABLE_INDEX] = FLIGHT, -1
    # The wall of body 1 accelerates towards its damper; the other dampers are far from their walls.
    state.z[model.laws.elements.position_index] = -1e-3 if wall == FLOOR else 1e-2
    state.z[model.laws.elements.velocity_index] = 0.25
    state.height[:], state.velocity[:] = state.z[model.laws.elements.position_index] + 0.5 * CLEARANCE, 0.25
    state.height[0] = state.z[model.laws.elements.position_index[0]] + (CLEARANCE if wall == CEILING else 0.0)
    state.velocity[0] = 0.25 - SIGN[wall] * closing_speed
    momentum = (
        engine.system.mass @ state.z[model.laws.elements.velocity_index] + model.laws.elements.mass * state.velocity
    )
    impact_and_separate(engine, 0, wall)
    assert state.regime.tolist() == [wall if stays else FLIGHT, FLIGHT, FLIGHT]
    assert state.multiplicity[0] == (0 if stays else SIGN[wall])
    body_velocity = state.z[model.laws.elements.velocity_index]
    damper_velocity = np.where(state.regime == FLIGHT, state.velocity, body_velocity)
    after = engine.system.mass @ body_velocity + model.laws.elements.mass * damper_velocity
    np.testing.assert_allclose(after, momentum, atol=1e-15)
    rebound_speed = SIGN[wall] * (damper_velocity[0] - body_velocity[0])
    assert rebound_speed == (0.0 if stays else pytest.approx(0.4 * closing_speed, rel=1e-9))


def test_uncoupled_damper_stays_at_rest() -> None:
    engine = propagator(0.2, uncoupled=1)
    state, model = engine.state, engine.tables.model
    state.regime[:], state.counters[TABLE_INDEX] = (FLIGHT, FLIGHT, FLOOR), -1
    state.height[:], state.velocity[:] = state.z[model.laws.elements.position_index] + 0.5 * CLEARANCE, 0.0
    state.height[0], state.velocity[0] = state.z[model.laws.elements.position_index[0]], -0.5
    impact_and_separate(engine, 0, FLOOR)
    assert state.z[model.laws.elements.velocity_index[2]] == 0.0 and state.regime.tolist() == [FLOOR, FLIGHT, FLOOR]
    assert engine.log.counts[N_EVENTS] == 1


@pytest.mark.parametrize("wall", [FLOOR, CEILING])
@pytest.mark.parametrize(("ratio", "closed"), [(0.999, True), (1.001, False)])
def test_slowly_opened_contact_stays_closed(wall: int, ratio: float, closed: bool) -> None:
    # An impact opens the contact of damper 1 at `ratio` times the largest speed v at which the gap v^2 / (2 a) stays
    # within rounding error. The reactions solve opening_speed + matrix @ reaction = 0 for the closed contacts
    # (`bound`).
    engine = propagator(0.2)
    state, model, work = engine.state, engine.tables.model, engine.workspace.contact
    row, work.contacts.sign[0], work.contacts.wall_gap[0] = (
        model.laws.elements.position_index[1],
        SIGN[wall],
        CLEARANCE if wall == CEILING else 0.0,
    )
    state.z[row], coordinate_scale = -0.3, 2 * 0.3 + work.contacts.wall_gap[0]
    work.force[:3] = 3.0, -20.0, 5.0
    acceleration_limit = model.gravity + np.abs(np.linalg.inv(engine.system.mass)[1] * work.force[:3]).sum()
    speed_limit = np.sqrt(2 * acceleration_limit * ROUNDING * coordinate_scale)
    matrix, reaction = np.array([[3.0, -0.5], [-0.5, 2.0]]), np.array([0.0, 0.25])
    work.contacts.damper[:2], work.contacts.bound[:2] = (1, 2), (AT_LOW, FREE)
    work.matrix[:2, :2], work.contacts.reaction[:2] = matrix, reaction
    work.contacts.opening_speed[:2] = ratio * speed_limit - matrix[0] @ reaction, -0.5
    work.contacts.rhs[:2] = work.contacts.opening_speed[:2]
    _close_slow_openings(model, state, work, 2)
    assert (work.contacts.bound[:2] == FREE).tolist() == [closed, True]
    expected = np.linalg.solve(matrix, -work.contacts.rhs[:2]) if closed else reaction
    np.testing.assert_allclose(work.contacts.reaction[:2], expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("gap", "closing_speed", "multiplicity", "wall"),
    [
        (0.0, 1.0, 0, FLOOR),
        (1e-17, 1.0, 0, FLOOR),
        (1e-12, 1.0, 0, FLIGHT),
        (0.0, -1.0, 0, FLIGHT),
        (0.0, 0.0, 0, FLIGHT),
        (0.0, 1.0, 1, FLIGHT),
        (0.0, 1.0, -1, FLOOR),
        (CLEARANCE, -1.0, 0, CEILING),
        (CLEARANCE - 1e-17, -1.0, 0, CEILING),
        (CLEARANCE - 1e-12, -1.0, 0, FLIGHT),
        (CLEARANCE, 1.0, 0, FLIGHT),
        (CLEARANCE, -1.0, -1, FLIGHT),
        (CLEARANCE, -1.0, 1, CEILING),
    ],
)
def test_damper_in_flight_touches_only_an_approaching_wall(gap, closing_speed, multiplicity, wall):
    # `gap`, `closing_speed`: to the floor; `wall`: the touched wall, or FLIGHT.
    engine = propagator(0.1)
    state, model = engine.state, engine.tables.model
    state.regime[1] = FLIGHT
    state.z[model.laws.elements.position_index[1]], state.z[model.laws.elements.velocity_index[1]] = -1.0 / 64, 0.5
    state.height[1], state.velocity[1] = -1.0 / 64 + gap, 0.5 - closing_speed
    state.multiplicity[1] = multiplicity
    assert _touched_end(model, state, 1, 0.0) == END[wall]


def test_negligible_coupling_changes_no_event() -> None:
    events = []
    # Mass matrix elements between the bodies, kg: none, and as small as a rounding error.
    for coupling in (0.0, 4e-16):
        scene = rig.Scene(
            structure={"matrices": {"mass": [[1.0, coupling], [coupling, 1.0]], "stiffness": [[4e3, 0.0], [0.0, 5e3]]}},
            dampers=[{"body": body, "mass": 0.1, "clearance": CLEARANCE} for body in (1, 2)],
            shaker={"kind": "force", "body": [1, 2]},
            test={"kind": "sine", "frequency": 10.0, "force": 12.0},
        )
        events.append(rig.simulate(scene, 1.0, rate=200.0).events)
    assert len(events[0]) > 30
    assert events[0][["damper", "kind"]].tolist() == events[1][["damper", "kind"]].tolist()
    np.testing.assert_allclose(events[0]["time"], events[1]["time"], atol=1e-9)
