"""Assembly of the hybrid linear system of a scene, which the engine simulates.

A damper's *bed* is its particles, modeled as one mass in a cavity of a body. The bed *rests* while it lies on a
wall of the cavity; otherwise it *flies*.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.base.once import once_per_object
from rig.core.equations import Equations
from rig.core.laws.friction_joint import friction_joint
from rig.core.laws.landing import dashpot, spring_damper
from rig.core.laws.law import Law
from rig.core.laws.particle_bed import particle_bed
from rig.core.laws.sliding_mass import sliding_mass
from rig.core.laws.spring_mass import spring_mass
from rig.core.laws.stop import stop
from rig.core.laws.wall_contact import wall_contact
from rig.core.scene.damper import Damper, TimedContact, Wall, walls_of
from rig.core.scene.joint import FrictionJoint, Stop
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import at_shaker
from rig.core.system.hybrid_system import Element, HybridSystem
from rig.core.system.structural_model import StructuralModel, ground_connection, structural_model

#: Maximum number of free dampers. A configuration is a 64-bit integer, with one bit for each damper.
MAX_DAMPERS = 62
#: A stiffness matrix has an inverse if its condition number is at most this value; rounding limits it to about 1e16.
MAX_CONDITION = 1e13


@once_per_object
def assemble(scene: Scene) -> HybridSystem:
    """Return the hybrid linear system of a scene, in its initial state.

    The coordinates are the displacements of the bodies, then of the tables (heads) of shakers, then of the beds with
    finite-duration contact and of the masses on springs. Dampers that are locked or have no clearance are part of the
    mass matrix; the others are free. Raises `SceneError` if there are more free dampers than `MAX_DAMPERS`, or if the
    test starts from a static equilibrium that does not exist, because the structure has no support.
    """
    model = structural_model(scene)
    bodies = len(model.mass)
    masses, body, locked = model.damper_mass, model.damper_body, model.locked
    free = np.flatnonzero(~locked)
    finite_contact = any(scene.dampers[j].contact is not None for j in free)
    # With finite-duration contact a damper has three configurations: no contact, lower wall, upper wall.
    limit = MAX_DAMPERS // 2 if finite_contact else MAX_DAMPERS
    if scene.joints and len(free) + len(scene.joints) > MAX_DAMPERS // 2:
        raise SceneError(
            f"joints: got {len(free)} dampers that are not locked and {len(scene.joints)} joints; expected at most "
            f"{MAX_DAMPERS // 2} together. Remove some."
        )
    if len(free) > limit:
        condition = " with finite-duration contact" if finite_contact else ""
        raise SceneError(
            f"dampers: got {len(free)} dampers that are not locked; expected at most {limit}{condition}. Lock or "
            "remove some."
        )
    weight = np.zeros(bodies)
    np.subtract.at(weight, body[locked], masses[locked] * scene.gravity)
    equations = _without_free_beds(scene, model, weight)
    inverse_mass = np.diag(np.linalg.inv(equations.matrices()[0])) if finite_contact else np.zeros(bodies)
    elements = tuple(
        _element(equations, scene, number=int(j) + 1, mass=float(masses[j]), inverse_mass=float(inverse_mass[body[j]]))
        for j in free
    )
    joints = tuple(_joint(equations, joint, number) for number, joint in enumerate(scene.joints, 1))
    system = _system(equations, scene.gravity, elements + joints)
    if scene.joints:
        system = _with_joints_at_rest(scene, system)
    system.initial[:] = _initial_state(scene, system)
    return system


def matrices_without_free_beds(scene: Scene) -> tuple[Array, Array, Array]:
    """Return M [kg], C [N s/m] and K [N/m] of bodies, tables and masses on springs, (coordinates, coordinates)."""
    model = structural_model(scene)
    equations = _without_free_beds(scene, model, np.zeros(len(model.mass)))
    for mass in model.tuned:
        equations.support(_add_bed(equations, mass.body, mass.mass, 0.0), mass.stiffness, mass.damping)
    return equations.matrices()


def _without_free_beds(scene: Scene, model: StructuralModel, weight: Array) -> Equations:
    """Return equations of bodies and tables with inputs; `weight`: (negative) weight of locked beds [N], (bodies,)."""
    structure = model.with_damper_masses()
    ground = partial(ground_connection, scene.structure, structure)
    equations = Equations(structure.mass, structure.damping, structure.stiffness, weight, ground)
    for number, shaker in enumerate(scene.shakers, 1):
        shaker.add_to(equations, *(at_shaker(noun, number, len(scene.shakers)) for noun in ("shaker", "table")))
    if scene.hammer is not None:
        equations.add_input("hammer", "N", {scene.hammer - 1: 1.0})
    return equations


def _element(equations: Equations, scene: Scene, number: int, mass: float, inverse_mass: float) -> Element:
    """Return the element of a damper; if its gap must be a coordinate, add the bed to the equations first.

    `mass`: mass of the bed [kg]; `inverse_mass`: diagonal element of the inverse mass matrix of its body, 1/kg.
    """
    damper, gap = scene.dampers[number - 1], -1
    if damper.spring is not None or damper.contact is not None:
        gap = _add_bed(equations, damper.body - 1, mass, scene.gravity)
    declare: Callable[..., Law] = partial(particle_bed, damper.restitution)
    if damper.contact is not None:
        declare = partial(wall_contact, *_stiffness_and_damping(damper, 1.0 / (1.0 / mass + inverse_mass)))
    if damper.spring is not None:
        equations.support(gap, damper.spring, damper.dashpot)
        equations.weight[gap] = 0.0  # the gap is measured from the position in which the spring carries the weight
        declare = partial(spring_mass, declare, damper.clearance_below)
    if damper.friction is not None:
        gap = _add_bed(equations, damper.body - 1, mass, gravity=0.0)  # the weight acts across the direction of motion
        declare = partial(sliding_mass, damper.friction * mass * scene.gravity, damper.restitution)
    return Element(
        declare, damper.body - 1, gap, mass, damper.clearance, damper.restitution, number, damper.grains is not None
    )


def _joint(equations: Equations, joint: Stop | FrictionJoint, number: int) -> Element:
    lower, upper = joint.ends
    gap, base = (lower, -1) if upper is None else (upper, -1 if lower is None else lower)
    assert gap is not None
    mass, direction = equations.matrices()[0], np.zeros(len(equations.mass))
    direction[gap] = 1.0
    if base >= 0:
        direction[base] = -1.0
    accelerated_mass = float(1.0 / (direction @ np.linalg.solve(mass, direction)))
    damping = joint.damping
    if joint.restitution is not None:
        damping = dashpot(joint.stiffness, joint.restitution, accelerated_mass)
    declare: Callable[..., Law] = partial(stop, joint.stiffness, damping, upper is None)
    clearance, slider = joint.gap, -1
    if joint.slip_force is not None:
        declare, clearance = partial(friction_joint, joint.stiffness), joint.slip_force / joint.stiffness
        slider = equations.add_coordinate(1.0)  # no force acts on the slider, so its mass is arbitrary
    return Element(declare, gap, gap, accelerated_mass, clearance, 0.0, number, is_joint=True, base=base, slider=slider)


def _with_joints_at_rest(scene: Scene, system: HybridSystem) -> HybridSystem:
    """Return the system with its joints at the start in the regimes of the static equilibrium."""
    # The equilibrium with assumed closed stops determines which stops are closed, until the set no longer changes.
    for _ in range(2 + 2 * len(scene.joints)):
        state = np.zeros(system.states)
        if scene.test is None or scene.test.start == "settled":
            state[: system.coordinates] = static_equilibrium(scene, system)
        regimes, present = system.joint_regimes(state), system.elements[system.dampers :]
        joints = tuple(
            replace(joint, start=list(joint.law.regimes)[regime])
            for joint, regime in zip(present, regimes, strict=True)
        )
        if joints == present:
            break
        system = replace(system, elements=system.elements[: system.dampers] + joints)
    return system


def _system(equations: Equations, gravity: float, elements: tuple[Element, ...]) -> HybridSystem:
    """Return the system of equations; the other arguments are fields of `HybridSystem`."""
    mass, damping, stiffness = equations.matrices()
    n, currents, n_inputs = len(mass), equations.currents, len(equations.inputs)
    force_state = np.hstack([-stiffness, -damping, np.zeros((n, len(currents)))])
    force_drive = np.zeros((n, n_inputs))
    for column, forces in enumerate(equations.input_forces):
        for row, value in forces.items():
            force_drive[row, column] = value
    rate_state = np.zeros((len(currents), 2 * n + len(currents)))
    rate_drive, state_power = np.zeros((2, len(currents), n_inputs))
    for k, current in enumerate(currents):
        force_state[current.row, 2 * n + k] = current.force_factor
        rate_state[k, n + current.row] = -current.force_factor / current.inductance
        rate_state[k, 2 * n + k] = -current.resistance / current.inductance
        rate_drive[k, current.column] = current.gain / current.inductance
        state_power[k, current.column] = current.gain
    return HybridSystem(
        points=tuple(equations.points),
        inputs=tuple(equations.inputs),
        drive_units=tuple(equations.units),
        drive_limit=np.array(equations.drive_limit),
        gravity=gravity,
        mass=mass,
        force_state=force_state,
        force_drive=force_drive,
        force_constant=equations.weight,
        rate_state=rate_state,
        rate_drive=rate_drive,
        state_energy=np.array([current.inductance for current in currents]),
        state_loss=np.array([current.resistance for current in currents]),
        state_power=state_power,
        prescribed=np.array(equations.prescribed, dtype=np.intp),
        reaction=equations.reaction(),
        elements=elements,
        initial=np.zeros(2 * n + len(currents)),
    )


def _add_bed(equations: Equations, body: int, mass: float, gravity: float) -> int:
    """Add a bed in free fall, whose coordinate is its height above its lower wall; return its row."""
    row = equations.add_coordinate(mass)
    equations.mass[body, body] += mass
    equations.mass[body, row] = equations.mass[row, body] = mass
    equations.weight[[body, row]] -= mass * gravity
    return row


def _stiffness_and_damping(damper: Damper, reduced_mass: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return stiffness [N/m] and damping [N s/m] of lower and upper wall; `reduced_mass`: of bed and body [kg]."""
    walls = walls_of(damper.contact)
    lower, upper = (
        _wall_stiffness_and_damping(wall, damper.restitution, reduced_mass) for wall in (walls[0], walls[-1])
    )
    return (lower[0], upper[0]), (lower[1], upper[1])


def _wall_stiffness_and_damping(wall: Wall, restitution: float, mass: float) -> tuple[float, float]:
    """Return stiffness [N/m] and damping [N s/m] of a wall; `mass`: reduced mass of bed and body [kg]."""
    if isinstance(wall, TimedContact):
        return spring_damper(wall.duration, restitution, mass)
    return wall.stiffness, wall.damping


def _initial_state(scene: Scene, system: HybridSystem) -> Array:
    """Return the state at t = 0 without drive, with resting dampers."""
    state = np.zeros(system.states)
    n = system.coordinates
    test = scene.test
    if test is None or test.start == "settled":
        state[:n] = static_equilibrium(scene, system)
    bodies = scene.structure.bodies
    motion = None if test is None else test.initial_motion(bodies, lambda: structural_model(scene).modes.shapes)
    if motion is not None:
        state[:bodies] += motion[0]
        state[n : n + bodies] += motion[1]
    return state


def static_equilibrium(scene: Scene, system: HybridSystem) -> Array:
    """Return coordinates at rest under the weight of the dampers [m], without friction; `SceneError` if unsupported."""
    n = system.coordinates
    sliders = [element.slider for element in system.elements if element.slider >= 0]
    frictionless = replace(system, elements=tuple(element for element in system.elements if element.slider < 0))
    force, constant = frictionless.contact_forces(frictionless.start)
    load = system.force_constant + constant
    np.subtract.at(load, system.damper_coordinate, system.detached_mass * system.gravity)
    if not load.any():
        return np.zeros(n)
    stiffness = -(system.force_state + force)[:, :n]
    # No spring acts on a mass that slides freely; it remains in the middle.
    free = {*system.gap_coordinate[: system.dampers].tolist(), *sliders}
    supported = [i for i in range(n) if stiffness[i].any() or i not in free]
    stiffness, load = stiffness[np.ix_(supported, supported)], load[supported]
    if not stiffness.any() or (np.linalg.cond(stiffness) > MAX_CONDITION and _is_singular(stiffness)):
        raise SceneError(
            f"scene {scene.name!r}: the structure has no support, so it has no static equilibrium under the weight of "
            "the dampers. Add springs to ground, or set gravity: 0 or test: {start: empty}."
        )
    position = np.zeros(n)
    position[supported] = np.linalg.solve(stiffness, load)
    for element in system.elements:
        if element.slider >= 0:
            position[element.slider] = element.along_gap(position)
    return position


def _is_singular(stiffness: Array) -> bool:
    """Return whether a stiffness matrix is singular within rounding error."""
    # Without the scaling of its diagonal to 1, different springs would give a regular matrix a large condition number.
    scale = np.sqrt(np.abs(np.diag(stiffness)))
    scale[scale == 0.0] = 1.0
    return bool(np.linalg.cond(stiffness / scale / scale[:, None]) > MAX_CONDITION)


def force_row(scene: Scene, system: HybridSystem) -> Array:
    """Return the row vector that gives the driven shaker's force [N] from the state; zeros if it is the drive."""
    if scene.driven_shaker is None:
        return np.zeros(system.states)
    table = scene.at_driven("table")
    return scene.driven_shaker.force_row(system.states, system.points.index(table) if table in system.points else None)
