"""Assembly of the hybrid linear system of a scene, which the engine simulates.

A damper's *bed* is its particles, modeled as one mass in a cavity of a body. The bed *rides* while it is at rest on the
floor of the cavity; otherwise it *flies*.
"""

from __future__ import annotations

from typing import NamedTuple, assert_never

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.errors import SceneError
from rig.scene.damper import Damper, TimedContact, Wall, Walls
from rig.scene.scene import Scene
from rig.scene.shaker import Coil, ElectrodynamicShaker, ForceShaker, Shaker, TableShaker, at_shaker
from rig.system.hybrid_system import HybridSystem
from rig.system.landing import spring_damper
from rig.system.structural_model import StructuralModel, structural_model

#: Maximum number of free dampers: contact configurations are bits of a 64-bit integer.
MAX_DAMPERS = 62
#: A stiffness matrix has an inverse if its condition number is at most this; rounding limits it to about 1e16.
MAX_CONDITION = 1e13


def assemble(scene: Scene) -> HybridSystem:
    """Return the hybrid linear system of a scene, in its initial state.

    The coordinates are the bodies, then the tables (heads) of the shakers that have one, then the beds with
    finite-duration contact. Dampers that are locked or have no clearance are part of the mass matrix; the others are
    free. Raises `SceneError` if there are more free dampers than `MAX_DAMPERS`, or the test starts from the static
    equilibrium of a structure without support.
    """
    model = structural_model(scene)
    bodies = len(model.mass)
    masses, body, locked = model.bed_mass, model.bed_body, model.locked
    free = np.flatnonzero(~locked)
    finite_contact = any(scene.dampers[j].contact is not None for j in free)
    # Finite-duration contact needs two bits of a configuration: contact, and contact with the ceiling.
    limit = MAX_DAMPERS // 2 if finite_contact else MAX_DAMPERS
    if len(free) > limit:
        condition = " with finite-duration contact" if finite_contact else ""
        raise SceneError(
            f"dampers: got {len(free)} dampers that are not locked; expected at most {limit}{condition}. Lock or "
            "remove some."
        )
    weight = np.zeros(bodies)
    np.subtract.at(weight, body[locked], masses[locked] * scene.gravity)
    equations = _without_free_beds(scene, model, weight)
    clearance = np.array([scene.dampers[j].clearance for j in free], dtype=np.float64)
    restitution = np.array([scene.dampers[j].restitution for j in free], dtype=np.float64)
    walls = _stiffness_and_damping(equations.mass, [scene.dampers[j] for j in free], masses[free])
    gap_coordinate = np.full(len(free), -1, dtype=np.intp)
    for row, j in enumerate(free):
        if scene.dampers[j].contact is not None:
            gap_coordinate[row] = equations.add_bed(body[j], masses[j], scene.gravity)
    system = equations.system(
        gravity=scene.gravity,
        coordinate=body[free],
        masses=masses[free],
        clearance=clearance,
        restitution=restitution,
        number=free + 1,
        gap_coordinate=gap_coordinate,
        walls=walls,
        grains=np.array([scene.dampers[j].grains is not None for j in free], dtype=bool),
    )
    system.initial[:] = _initial_state(scene, system)
    return system


def matrices_without_free_beds(scene: Scene) -> tuple[Array, Array, Array]:
    """Return mass [kg], damping [N s/m] and stiffness [N/m] of bodies and tables, shape (coordinates, coordinates)."""
    model = structural_model(scene)
    equations = _without_free_beds(scene, model, np.zeros(len(model.mass)))
    return equations.mass, equations.damping, equations.stiffness


def _without_free_beds(scene: Scene, model: StructuralModel, weight: Array) -> _Equations:
    """Return the equations of bodies and tables with their inputs.

    `weight`: constant force of the locked beds on each body, N, shape (bodies,), upwards and therefore negative.
    """
    equations = _Equations(len(model.mass), model.with_bed_masses(), weight)
    for number, shaker in enumerate(scene.shakers, 1):
        drive, table_name = (at_shaker(noun, number, len(scene.shakers)) for noun in ("shaker", "table"))
        _add_shaker(equations, shaker, drive, table_name)
    if scene.hammer is not None:
        equations.add_input("hammer", "N", {scene.hammer - 1: 1.0})
    return equations


class _Coil(NamedTuple):
    """The coil of an electrodynamic shaker with a voltage amplifier; its current is a state.

    `gain`: gain of the amplifier, V/V; `table`: row of its table; `column`: column of its drive among the inputs.
    """

    coil: Coil
    gain: float
    table: int
    column: int


class _Equations:
    """The equations of motion during assembly, in SI units.

    `points`: names of the bodies and tables. `mass`, `damping`, `stiffness`: matrices of all coordinates. `weight`:
    constant force on each coordinate. `inputs`, `units`: names and units of the drives; `input_forces`: for each input,
    the force on each coordinate per unit.
    """

    def __init__(self, bodies: int, structure: StructuralModel, weight: Array) -> None:
        self.points = [f"body {j + 1}" for j in range(bodies)]
        self.mass, self.weight = structure.mass.copy(), weight
        self.damping, self.stiffness = structure.damping.copy(), structure.stiffness.copy()
        self.inputs: list[str] = []
        self.units: list[str] = []
        self.input_forces: list[dict[int, float]] = []
        self.coils: list[_Coil] = []

    def add_table(self, name: str, mass: float) -> int:
        """Add a table (shaker head) without support, of a mass [kg]; return its row."""
        self.points.append(name)
        return self._add_coordinate(mass)

    def add_bed(self, body: int, mass: float, gravity: float) -> int:
        """Add a bed in free fall, whose coordinate is its height above the floor of its cavity; return its row."""
        row = self._add_coordinate(mass)
        self.mass[body, body] += mass
        self.mass[body, row] = self.mass[row, body] = mass
        self.weight[[body, row]] -= mass * gravity
        return row

    def _add_coordinate(self, mass: float) -> int:
        """Add a coordinate with a mass [kg] and no other elements; return its row."""
        row = len(self.mass)
        enlarged = np.zeros((3, row + 1, row + 1))
        enlarged[:, :row, :row] = self.mass, self.damping, self.stiffness
        self.mass, self.damping, self.stiffness = enlarged
        self.mass[row, row] = mass
        self.weight = np.append(self.weight, 0.0)
        return row

    def add_input(self, name: str, unit: str, forces: dict[int, float]) -> None:
        """Add an input; `forces`: its force on coordinates by their row, N per unit of the input."""
        self.inputs.append(name)
        self.units.append(unit)
        self.input_forces.append(forces)

    def add_spring(self, first: int, second: int, stiffness: float) -> None:
        """Add a spring of a stiffness [N/m] between two coordinates."""
        self.stiffness[[first, second], [first, second]] += stiffness
        self.stiffness[[first, second], [second, first]] -= stiffness

    def system(
        self, gravity: float, coordinate: NDArray[np.intp], masses: Array, clearance: Array,
        restitution: Array, number: NDArray[np.intp], gap_coordinate: NDArray[np.intp], walls: tuple[Array, Array],
        grains: NDArray[np.bool_],
    ) -> HybridSystem:  # fmt: skip
        """Return the system; the arguments are the fields of `HybridSystem` for the free dampers."""
        n, n_coils = len(self.mass), len(self.coils)
        force_state = np.hstack([-self.stiffness, -self.damping, np.zeros((n, n_coils))])
        force_drive = np.zeros((n, len(self.inputs)))
        for column, forces in enumerate(self.input_forces):
            for row, value in forces.items():
                force_drive[row, column] = value
        rate_state = np.zeros((n_coils, 2 * n + n_coils))
        rate_drive = np.zeros((n_coils, len(self.inputs)))
        for k, (coil, gain, table, column) in enumerate(self.coils):
            force_state[table, 2 * n + k] = coil.force_factor
            rate_state[k, n + table] = -coil.force_factor / coil.inductance
            rate_state[k, 2 * n + k] = -coil.resistance / coil.inductance
            rate_drive[k, column] = gain / coil.inductance
        return HybridSystem(
            points=tuple(self.points),
            inputs=tuple(self.inputs),
            drive_units=tuple(self.units),
            gravity=gravity,
            mass=self.mass,
            force_state=force_state,
            force_drive=force_drive,
            force_constant=self.weight,
            rate_state=rate_state,
            rate_drive=rate_drive,
            damper_coordinate=coordinate,
            damper_mass=masses,
            clearance=clearance,
            restitution=restitution,
            damper_number=number,
            gap_coordinate=gap_coordinate,
            wall_stiffness=walls[0],
            wall_damping=walls[1],
            grains=grains,
            initial=np.zeros(2 * n + n_coils),
        )


def _add_shaker(equations: _Equations, shaker: Shaker, drive: str, table_name: str) -> None:
    """Add a shaker; `drive` and `table_name` are the names of its input and its table."""
    match shaker:
        case ForceShaker():
            equations.add_input(drive, "N", {body - 1: 1.0 for body in shaker.bodies})
        case TableShaker():
            # The position servo is ideally stiff, so that the spring acts on the body, but not on the table. It is a
            # critically damped second-order low-pass filter of the drive.
            table = equations.add_table(table_name, 1.0)
            body = shaker.body - 1
            corner_rate = 2.0 * np.pi * shaker.bandwidth
            equations.stiffness[body, body] += shaker.spring
            equations.stiffness[body, table] -= shaker.spring
            equations.stiffness[table, table] = corner_rate**2
            equations.damping[table, table] = 2.0 * corner_rate
            equations.add_input(drive, "m", {table: corner_rate**2})
        case ElectrodynamicShaker():
            coil, armature, amplifier = shaker.coil, shaker.armature, shaker.amplifier
            table = equations.add_table(table_name, armature.mass)
            equations.add_spring(shaker.body - 1, table, shaker.spring)
            equations.stiffness[table, table] += armature.stiffness
            equations.damping[table, table] += armature.damping
            if amplifier.mode == "voltage":
                equations.coils.append(_Coil(coil, amplifier.gain, table, len(equations.inputs)))
                equations.add_input(drive, "V", {})
            else:
                equations.add_input(drive, "V", {table: amplifier.gain * coil.force_factor})
        case _ as never:
            assert_never(never)


def _stiffness_and_damping(mass: Array, dampers: list[Damper], bed_mass: Array) -> tuple[Array, Array]:
    """Return stiffness and damping of floor and ceiling of each damper, (dampers, 2); 0 for instant contact.

    `mass` is the mass matrix without the dampers that move, `bed_mass` their masses, kg.
    """
    stiffness, damping = np.zeros((2, len(dampers), 2))
    if all(damper.contact is None for damper in dampers):
        return stiffness, damping
    inverse_mass = np.diag(np.linalg.inv(mass))
    for row, damper in enumerate(dampers):
        contact = damper.contact
        if contact is None:
            continue
        walls = (contact.floor, contact.ceiling) if isinstance(contact, Walls) else (contact, contact)
        reduced_mass = 1.0 / (1.0 / bed_mass[row] + inverse_mass[damper.body - 1])
        for wall_index, wall in enumerate(walls):
            stiffness[row, wall_index], damping[row, wall_index] = _wall_stiffness_and_damping(
                wall, damper.restitution, reduced_mass
            )
    return stiffness, damping


def _wall_stiffness_and_damping(wall: Wall, restitution: float, mass: float) -> tuple[float, float]:
    """Return stiffness [N/m] and damping [N s/m] of a wall; `mass`: reduced mass of bed and body, kg."""
    if isinstance(wall, TimedContact):
        return spring_damper(wall.duration, restitution, mass)
    return wall.stiffness, wall.damping


def _initial_state(scene: Scene, system: HybridSystem) -> Array:
    """Return the state at t = 0 without drive, with all dampers on their floors."""
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
    """Return the coordinates at rest under the weight of the dampers, m.

    Raises `SceneError` if nothing supports the structure.
    """
    n = system.coordinates
    load = system.force_constant.copy()
    riding = ~system.finite_contact
    np.subtract.at(load, system.damper_coordinate[riding], system.damper_mass[riding] * system.gravity)
    if not load.any():
        return np.zeros(n)
    stiffness = -(system.force_state + system.contact_forces(system.all_on_floor)[0])[:, :n]
    if not stiffness.any() or (np.linalg.cond(stiffness) > MAX_CONDITION and _is_singular(stiffness)):
        raise SceneError(
            f"scene {scene.name!r}: the structure has no support, so it has no static equilibrium under the weight of "
            "the dampers. Add springs to ground, or set gravity: 0 or test: {start: empty}."
        )
    return np.linalg.solve(stiffness, load)


def _is_singular(stiffness: Array) -> bool:
    """Return whether a stiffness matrix is singular within rounding error.

    Its diagonal is first scaled to 1, because a large ratio of springs makes the condition number of a regular matrix
    large.
    """
    scale = np.sqrt(np.abs(np.diag(stiffness)))
    scale[scale == 0.0] = 1.0
    return bool(np.linalg.cond(stiffness / scale / scale[:, None]) > MAX_CONDITION)


def spring_force_row(scene: Scene, system: HybridSystem) -> Array:
    """Return the row whose product with the state is the force of the driven shaker's coil spring on its body, N.

    The row is zero without a coil spring.
    """
    row = np.zeros(system.states)
    shaker = scene.driven_shaker
    if shaker is not None and shaker.spring is not None:
        row[system.points.index(scene.at_driven("table"))] = shaker.spring
        row[shaker.bodies[0] - 1] = -shaker.spring
    return row
