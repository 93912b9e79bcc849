"""Beds of grains coupled to the structure: force and motion are exchanged at every time step.

A *bed* is the material of one damper, here simulated as grains. LAMMPS moves the grains in the frame of their cavity.
The structure and its other dampers are propagated exactly over a step h under the forces of the beds. These forces are
interpolated linearly from F to F' over the step, so the body receives the impulse (F + F') h / 2. In the velocity
Verlet scheme of LAMMPS, the walls exert the same impulse on the grains, within rounding error.

In the frame of the cavity, the velocities of the grains change by the negative of the body's velocity change. At the
beginning of a step, the change by the body's acceleration over half a step is applied, and at the end the remainder of
the exact change. The exchange is of second order in h, as is LAMMPS's scheme, and conserves momentum.

A *discontinuity* is an instant at which a velocity or an acceleration of the structure jumps: an impact or a
separation.
"""

from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.engine.propagator import sampled_propagator
from rig.core.engine.samples import MotionSamples, StateSamples
from rig.core.engine.trajectory import Trajectory, gaps_and_contacts
from rig.core.laws.events import CEILING, FLIGHT, FLOOR
from rig.core.scene.scene import Scene
from rig.core.system.assembly import assemble
from rig.core.system.hybrid_system import FORCE_OF_BED, HybridSystem
from rig.core.system.spheres import spheres_of
from rig.extras.grains.bed import WALLS
from rig.extras.grains.packing import bed_top, settled_positions
from rig.extras.grains.shared_bed import new_bed


class BedStates(NamedTuple):
    """Motion of the beds at the start and after each of a number of steps."""

    force: Array  # upward force of floor, ceiling and side on the grains [N]; shape (beds, walls, steps + 1)
    gap: Array  # rise of the center of mass above its height in the settled bed [m]; shape (beds, steps + 1)


class CoupledState(NamedTuple):
    """State of a coupled system, for `CoupledPropagator.resume`."""

    structure: tuple[Array, ...]  # `Propagator.snapshot` of the structure
    beds: tuple[bytes, ...]  # `Bed.state_bytes` of each bed


class CoupledPropagator:
    """Propagates a system with beds of grains; has the interface of `rig.core.engine.propagator.Propagator`.

    `interval`: sample interval of the drive [s]. In `system`, each bed is one mass; `structure` propagates structure
    and dampers without grains, with the beds' forces as inputs. `bodies`: coordinate of the body of each bed; `step`:
    time step of the grains [s], of which a sample interval has `substeps`.
    """

    def __init__(self, scene: Scene, interval: float) -> None:
        self.system = assemble(scene)
        spheres = spheres_of(scene)
        self.substeps = max(1, int(np.ceil(interval / min(each.longest_step() for each in spheres.values()))))
        self.step = interval / self.substeps
        self.bodies = np.array([scene.dampers[index].body - 1 for index in spheres])
        self.structure, steps = sampled_propagator(_with_bed_inputs(scene, self.system, self.bodies), self.step)
        self._propagator_steps = np.array([steps])
        numbers = self.system.damper_number.tolist()
        self._bed_rows = np.array([numbers.index(index + 1) for index in spheres], dtype=np.intp)
        self._rows_without_grains = np.flatnonzero(~self.system.grains)
        # Number of each element of the structure among the elements of the scene.
        joints = np.arange(self.system.dampers, len(self.system.elements))
        self._elements_without_grains = np.concatenate([self._rows_without_grains, joints])
        self.beds = []
        for each in spheres.values():
            positions = settled_positions(each)
            ceiling = bed_top(each, positions) + each.clearance
            self.beds.append(new_bed(each, positions, ceiling, scene.gravity, self.step))
        self._force = np.array([bed.forces() for bed in self.beds])
        self._velocity, self._acceleration = np.zeros((2, len(self.beds)))

    @property
    def ambiguous(self) -> int:
        """Number of decisions so far, for dampers without grains, that rounding errors could have reversed."""
        return self.structure.ambiguous

    @property
    def momentum(self) -> Array:
        """Upward momentum of each bed in the fixed frame [kg m/s]; shape (beds,)."""
        grains = [bed.momentum + bed.mass * speed for bed, speed in zip(self.beds, self._velocity, strict=True)]
        return np.array(grains)

    def set_state(self, state: Array, drive: Array) -> NDArray[np.int64]:
        """Set the structure's state with every damper on its floor; return the events, as `Propagator.set_state`."""
        inputs = np.concatenate([drive[: len(self.system.inputs)], -self._force.sum(axis=1)])
        # Drive states: the inputs and their changes over the step, here zero.
        elements, kinds = self.structure.set_state(state, np.concatenate([inputs, np.zeros(len(inputs))]))
        self._read_beds()
        return np.array([self._elements_without_grains[elements], kinds], dtype=np.int64)

    def state(self) -> CoupledState:
        """Return the state from which the motion continues bit-identically; see `Bed.state_bytes`."""
        beds = tuple(bed.state_bytes() for bed in self.beds)
        self._read_beds()
        return CoupledState(self.structure.snapshot(), beds)

    def resume(self, state: CoupledState) -> None:
        """Continue from a state of this system."""
        self.structure.resume(state.structure)
        for bed, stored in zip(self.beds, state.beds, strict=True):
            bed.resume(stored)
        self._read_beds()

    def propagate_steps(self, drive: Array) -> tuple[Trajectory, BedStates]:
        """Propagate through time steps of the grains; `drive`: drive at the ends of steps, shape (inputs, steps + 1).

        Returns the trajectory of `structure`, whose segments are the steps, and the motion of the beds.
        """
        steps = drive.shape[1] - 1
        forces = np.empty((len(self.beds), len(WALLS), steps + 1))
        gap = np.empty((len(self.beds), steps + 1))
        forces[:, :, 0], gap[:, 0] = self._force, [bed.gap for bed in self.beds]
        inputs = np.vstack([drive, np.zeros((len(self.beds), steps + 1))])
        bed_inputs = inputs[len(drive) :]
        bed_inputs[:, 0] = -self._force.sum(axis=1)
        samples, sample = self.structure.state_samples(steps), self.structure.state_samples(1)
        event_logs: list[tuple[int, Trajectory]] = []
        for k in range(steps):
            predicted_change = 0.5 * self.step * self._acceleration
            for bed_index, bed in enumerate(self.beds):
                bed.add_velocity(-predicted_change[bed_index])
                bed.advance()
                forces[bed_index, :, k + 1] = bed.forces()
                gap[bed_index, k + 1] = bed.gap
            bed_inputs[:, k + 1] = -forces[:, :, k + 1].sum(axis=1)
            events = self.structure.propagate_interval(inputs[:, k : k + 2], self._propagator_steps, sample)
            if events is not None:
                event_logs.append((k, events))
            # Apply the remainder of the velocity change of the bodies to the grains.
            velocity = sample.state[0, self.system.coordinates + self.bodies]
            for bed, change in zip(self.beds, velocity - self._velocity - predicted_change, strict=True):
                bed.add_velocity(-change)
            self._velocity = velocity
            self._acceleration = sample.state[0, self.structure.tables.size + self.bodies]
            samples.state[k], samples.table_index[k] = sample.state[0], sample.table_index[0]
            samples.height[k], samples.contact[k] = sample.height[0], sample.contact[0]
        self._force = forces[:, :, -1].copy()
        return _join(self.structure.current_state(), samples, event_logs), BedStates(forces, gap)

    def _read_beds(self) -> None:
        """Read the beds' current forces, and the velocities and accelerations of their bodies under these forces."""
        self._force = np.array([bed.forces() for bed in self.beds])
        current = self.structure.current_state()
        first_bed_input = self.structure.system.states + len(self.system.inputs)
        current.state[0, first_bed_input : first_bed_input + len(self.beds)] = -self._force.sum(axis=1)
        self._velocity = current.state[0, self.system.coordinates + self.bodies]
        self._acceleration = self.structure.accelerations(current.state, current.table_index)[self.bodies, 0]

    def motion_samples(self, samples: int) -> MotionSamples:
        """Allocate arrays for a number of samples."""
        rows = 3 * self.system.coordinates + self.system.dampers
        return MotionSamples(
            np.empty((rows, samples)),
            np.empty((self.system.dampers, samples), dtype=np.int8),
            np.zeros(1, dtype=np.int64),
            np.zeros((0, 0)),
        )

    def motion_parts(self, samples: MotionSamples) -> tuple[Array, Array, Array, Array]:
        """Return displacements, velocities, accelerations (points, samples) and gaps (dampers, samples)."""
        n, points, rows = self.system.coordinates, len(self.system.points), samples.rows
        displacement, velocity, acceleration = (rows[k * n : k * n + points] for k in range(3))
        return displacement, velocity, acceleration, rows[3 * n :]

    def store_present_motion(self, samples: MotionSamples, column: int) -> None:
        """Write the current motion into one column of the samples."""
        gap = np.array([[bed.gap] for bed in self.beds])
        self._fill_columns(
            samples, slice(column, column + 1), self.structure.current_state(), self._force[:, :, None], gap
        )

    def sample_motion(self, drive: Array, interval_steps: float, samples: MotionSamples, column: int) -> Trajectory:
        """Propagate like `Propagator.sample_motion`; `interval_steps` is not used, but belongs to the interface."""
        trajectory, beds = self.propagate_steps(interpolate_drive(drive, self.substeps))
        self.fill_samples(samples, column, trajectory, beds)
        return self.at_samples(trajectory)

    def fill_samples(self, samples: MotionSamples, column: int, trajectory: Trajectory, beds: BedStates) -> None:
        """Fill the samples from a column on with the motion at the ends of sample intervals."""
        last_steps = slice(self.substeps - 1, None, self.substeps)
        states = {name: getattr(trajectory, name)[last_steps] for name in StateSamples._fields}
        at_ends = replace(trajectory, **states)
        ends = slice(self.substeps, None, self.substeps)
        columns = slice(column, column + len(at_ends.table_index))
        self._fill_columns(samples, columns, at_ends, beds.force[:, :, ends], beds.gap[:, ends])

    def at_samples(self, trajectory: Trajectory) -> Trajectory:
        """Renumber events and discontinuities by sample interval instead of time step; the states remain."""

        def in_intervals(segment: NDArray[np.int64], offset: Array) -> tuple[NDArray[np.int64], Array]:
            """Convert numbers of steps, and times in steps, to numbers of sample intervals and times in these."""
            return segment // self.substeps, offset + (segment % self.substeps) * self.step

        event_segment, event_offset = in_intervals(trajectory.event_segment, trajectory.event_offset)
        discontinuity_segment, discontinuity_offset = in_intervals(
            trajectory.discontinuity_segment, trajectory.discontinuity_offset
        )
        return replace(
            trajectory,
            event_segment=event_segment,
            event_offset=event_offset,
            event_damper=self._elements_without_grains[trajectory.event_damper],
            discontinuity_segment=discontinuity_segment,
            discontinuity_offset=discontinuity_offset,
        )

    def accelerations(self, states: Array, table_indices: NDArray[np.int64]) -> Array:
        """Return the acceleration of every coordinate for rows of a `Trajectory`, shape (coordinates, samples)."""
        return self.structure.accelerations(states, table_indices)

    def _fill_columns(
        self, samples: MotionSamples, columns: slice, trajectory: Trajectory, bed_force: Array, bed_gap: Array
    ) -> None:
        """Fill columns with the states of a trajectory and the motion of the beds at the same instants."""
        n, without_grains = self.system.coordinates, self._rows_without_grains
        samples.rows[: 2 * n, columns] = trajectory.state[:, : 2 * n].T
        samples.rows[2 * n : 3 * n, columns] = self.accelerations(trajectory.state, trajectory.table_index)
        gap, contact = gaps_and_contacts(trajectory, self.structure.system)
        samples.rows[3 * n + without_grains, columns], samples.contact[without_grains, columns] = gap, contact
        floor, ceiling = np.abs(bed_force[:, 0]), np.abs(bed_force[:, 1])
        samples.rows[3 * n + self._bed_rows, columns] = bed_gap
        samples.contact[self._bed_rows, columns] = np.where(
            floor + ceiling == 0.0, FLIGHT, np.where(floor >= ceiling, FLOOR, CEILING)
        )


def interpolate_drive(drive: Array, substeps: int) -> Array:
    """Interpolate the columns of a drive linearly; returns shape (inputs, intervals * substeps + 1).

    >>> interpolate_drive(np.array([[0.0, 1.0, 3.0]]), 2)
    array([[0. , 0.5, 1. , 2. , 3. ]])
    """
    fraction = np.arange(substeps) / substeps
    start, change = drive[:, :-1, None], np.diff(drive, axis=1)[:, :, None]
    return np.concatenate([(start + change * fraction).reshape(len(drive), -1), drive[:, -1:]], axis=1)


def _with_bed_inputs(scene: Scene, system: HybridSystem, bodies: NDArray[np.intp]) -> HybridSystem:
    """Assemble a scene without its beds of grains, in the same coordinates, with the beds' forces as inputs.

    `system`: system of the scene; the result has the same initial state, which includes the beds' weight; `bodies`:
    coordinates on which the forces act.
    """
    numbers = system.damper_number[system.grains]
    dampers_without_grains = [damper for number, damper in enumerate(scene.dampers, 1) if number not in numbers]
    system_without_beds = assemble(scene.replace(dampers=dampers_without_grains))
    bed_inputs = np.zeros((system.coordinates, len(bodies)))
    bed_inputs[bodies, np.arange(len(bodies))] = 1.0
    no_effect = np.zeros((len(system_without_beds.rate_state), len(bodies)))
    return replace(
        system_without_beds,
        inputs=(*system_without_beds.inputs, *(f"{FORCE_OF_BED} {number}" for number in numbers)),
        drive_units=(*system_without_beds.drive_units, *("N" for _ in bodies)),
        drive_limit=np.append(system_without_beds.drive_limit, np.full(len(bodies), np.inf)),
        force_drive=np.hstack([system_without_beds.force_drive, bed_inputs]),
        rate_drive=np.hstack([system_without_beds.rate_drive, no_effect]),
        state_power=np.hstack([system_without_beds.state_power, no_effect]),
        elements=tuple(element for element in system.elements if not element.is_grains),
        initial=system.initial,
    )


def _join(empty_log: Trajectory, samples: StateSamples, event_logs: list[tuple[int, Trajectory]]) -> Trajectory:
    """Join states, events and discontinuities of all steps to one trajectory; `empty_log`: empty arrays."""
    logs = {
        item.name: np.concatenate([getattr(empty_log, item.name), *(getattr(log, item.name) for _, log in event_logs)])
        for item in fields(Trajectory)
        if item.name not in StateSamples._fields
    }
    for name in ("event_segment", "discontinuity_segment"):
        logs[name] = np.repeat(
            np.array([k for k, _ in event_logs], dtype=np.int64), [len(getattr(log, name)) for _, log in event_logs]
        )
    return Trajectory(*samples, **logs)
