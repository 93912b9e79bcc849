"""Beds of grains coupled to the structure: force and motion are exchanged at every time step.

The structure with its other dampers is propagated exactly over a step h under the beds' forces, which are interpolated
linearly over the step. The body therefore receives the impulse (F + F') h / 2, which equals within rounding the impulse
of the walls on the grains in LAMMPS's velocity Verlet scheme. In the frame of the cavity, the velocities of the grains
change by the opposite of the body's velocity change: half a step of the body's acceleration at the beginning, and the
remainder of the exact change at the end. Scheme and exchange are of second order in h; each exchange conserves
momentum.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.engine.propagator import sampled_propagator
from rig.engine.samples import MotionSamples, StateSamples
from rig.engine.state import CEILING, FLIGHT, FLOOR
from rig.engine.trajectory import Trajectory, gaps_and_contacts
from rig.grain_beds.bed import WALLS
from rig.grain_beds.packing import highest, settled
from rig.grain_beds.shared_bed import new_bed
from rig.grain_beds.spheres import spheres_of
from rig.scene.scene import Scene
from rig.system.assembly import assemble
from rig.system.hybrid_system import FORCE_OF_BED, HybridSystem


class BedStates(NamedTuple):
    """Motion of the beds at the steps of a march.

    force (beds, walls, steps + 1): upward force of floor, ceiling and side on the grains, N.
    lift (beds, steps + 1): height of the center of mass above that of the settled bed, m.
    """

    force: Array
    lift: Array


class CoupledState(NamedTuple):
    """State of a coupled system, for `CoupledPropagator.resume`.

    structure : `Propagator.snapshot` of the structure.
    beds : `Bed.state_bytes` of each.
    begin, impulse (beds,): momentum at the start, and impulse of the bodies since then, kg m/s.
    elapsed_steps : steps since the start.
    """

    structure: tuple[Array, ...]
    beds: tuple[bytes, ...]
    begin: Array
    impulse: Array
    elapsed_steps: int


class CoupledPropagator:
    """Propagates a system with beds of grains; otherwise as `rig.engine.propagator.Propagator`.

    `interval`: sample interval of the drive, s; divided into the steps that the grains need; `system`: the scene's,
    in which each bed is one mass; `structure`: the structure with the dampers without grains, and the beds' forces
    as additional inputs; `substeps`: steps in a sample interval; `step`: s; `bodies`: coordinate of each bed's body.
    """

    def __init__(self, scene: Scene, interval: float) -> None:
        self.system = assemble(scene)
        spheres = spheres_of(scene)
        self.substeps = max(1, int(np.ceil(interval / min(each.longest_step() for each in spheres.values()))))
        self.step = interval / self.substeps
        self.bodies = np.array([scene.dampers[row].body - 1 for row in spheres])
        inner = _with_bed_inputs(scene, self.system, self.bodies)
        self.structure, steps = sampled_propagator(inner, self.step)
        self._steps = np.array([steps])
        number = self.system.damper_number.tolist()
        self._rows = np.array([number.index(row + 1) for row in spheres], dtype=np.intp)
        self._others = np.flatnonzero(~self.system.grains)
        self.beds = []
        for each in spheres.values():
            positions = settled(each)
            ceiling = highest(each, positions) + each.clearance
            self.beds.append(new_bed(each, positions, ceiling, scene.gravity, self.step))
        self._mass = np.array([bed.mass for bed in self.beds])
        self._force = np.array([bed.forces() for bed in self.beds])
        self._velocity, self._acceleration, self._begin, self._impulse = np.zeros((4, len(self.beds)))
        self._elapsed_steps = 0

    @property
    def ambiguous(self) -> int:
        """Number of decisions within rounding so far, at dampers without grains."""
        return self.structure.ambiguous

    @property
    def momentum(self) -> Array:
        """Upward momentum of each bed, kg m/s; shape (beds,)."""
        return np.array([bed.momentum for bed in self.beds]) + self._mass * self._velocity

    @property
    def momentum_errors(self) -> Array:
        """Momentum change of each bed less the impulses of body and gravity, kg m/s; shape (beds,)."""
        weight = self._mass * self.system.gravity
        return np.asarray(self.momentum - self._begin - (self._impulse - weight * (self._elapsed_steps * self.step)))

    def set_state(self, state: Array, drive: Array) -> NDArray[np.int64]:
        """Set the structure's state with every damper on its floor; returns the dampers that separate at once."""
        columns = np.concatenate([drive[: len(self.system.inputs)], -self._force.sum(axis=1)])
        separated = self.structure.set_state(state, np.concatenate([columns, np.zeros(len(columns))]))
        self._read_beds()
        self._begin = self.momentum
        return np.asarray(self._others[separated], dtype=np.int64)

    def state(self) -> CoupledState:
        """Return the state from which the motion continues with the same bits; see `Bed.state_bytes`."""
        beds = tuple(bed.state_bytes() for bed in self.beds)
        self._read_beds()
        return CoupledState(self.structure.snapshot(), beds, self._begin, self._impulse.copy(), self._elapsed_steps)

    def resume(self, state: CoupledState) -> None:
        """Continue from a state of this system."""
        self.structure.resume(state.structure)
        for bed, stored in zip(self.beds, state.beds, strict=True):
            bed.resume(stored)
        self._begin, self._impulse, self._elapsed_steps = (state.begin, state.impulse.copy(), state.elapsed_steps)
        self._read_beds()

    def march(self, drive: Array) -> tuple[Trajectory, BedStates]:
        """Advance through the steps between the columns of a drive (inputs, steps + 1).

        Returns `trajectory`, of `structure`; its segments are the steps.
        """
        steps = drive.shape[1] - 1
        forces = np.empty((len(self.beds), len(WALLS), steps + 1))
        lift = np.empty((len(self.beds), steps + 1))
        forces[:, :, 0], lift[:, 0] = self._force, [bed.lift for bed in self.beds]
        columns = np.vstack([drive, np.zeros((len(self.beds), steps + 1))])
        bed_inputs = columns[len(drive) :]
        bed_inputs[:, 0] = -self._force.sum(axis=1)
        samples, sample = self.structure.state_samples(steps), self.structure.state_samples(1)
        event_logs: list[tuple[int, Trajectory]] = []
        for k in range(steps):
            predicted_change = 0.5 * self.step * self._acceleration
            for row, bed in enumerate(self.beds):
                bed.kick(-predicted_change[row])
                bed.advance()
                forces[row, :, k + 1] = bed.forces()
                lift[row, k + 1] = bed.lift
            bed_inputs[:, k + 1] = -forces[:, :, k + 1].sum(axis=1)
            events = self.structure.through_interval(columns[:, k : k + 2], self._steps, sample)
            if events is not None:
                event_logs.append((k, events))
            # Apply the remainder of the velocity change of the bodies to the grains.
            velocity = sample.state[0, self.system.coordinates + self.bodies]
            for bed, change in zip(self.beds, velocity - self._velocity - predicted_change, strict=True):
                bed.kick(-change)
            self._velocity = velocity
            self._acceleration = sample.state[0, self.structure.tables.size + self.bodies]
            samples.state[k], samples.slot[k] = sample.state[0], sample.slot[0]
            samples.height[k], samples.mode[k] = sample.height[0], sample.mode[0]
        self._force = forces[:, :, -1].copy()
        self._impulse -= 0.5 * self.step * (bed_inputs[:, :-1] + bed_inputs[:, 1:]).sum(axis=1)
        self._elapsed_steps += steps
        return _join(self.structure.current_state(), samples, event_logs), BedStates(forces, lift)

    def _read_beds(self) -> None:
        """Read the beds' present forces, and the motion of their bodies under them."""
        self._force = np.array([bed.forces() for bed in self.beds])
        current = self.structure.current_state()
        bed_columns = self.structure.system.states + len(self.system.inputs)
        current.state[0, bed_columns : bed_columns + len(self.beds)] = -self._force.sum(axis=1)
        self._velocity = current.state[0, self.system.coordinates + self.bodies]
        self._acceleration = self.structure.accelerations(current.state, current.slot)[self.bodies, 0]

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

    def sample_present(self, samples: MotionSamples, column: int) -> None:
        """Fill one column with the present motion."""
        lift = np.array([[bed.lift] for bed in self.beds])
        self._fill_samples(
            samples, slice(column, column + 1), self.structure.current_state(), self._force[:, :, None], lift
        )

    def sample_motion(self, drive: Array, interval_steps: float, samples: MotionSamples, column: int) -> Trajectory:
        """Advance through the sample intervals between the columns of a drive; fill the samples from a column on."""
        fine = interpolated(drive, self.substeps)
        trajectory, beds = self.march(fine)
        self.fill_samples(samples, column, trajectory, beds)
        return self.at_samples(trajectory)

    def fill_samples(self, samples: MotionSamples, column: int, trajectory: Trajectory, beds: BedStates) -> None:
        """Fill the samples from a column on with the motion at the ends of sample intervals."""
        last = slice(self.substeps - 1, None, self.substeps)
        ends_only = {name: getattr(trajectory, name)[last] for name in ("state", "slot", "height", "mode")}
        at = replace(trajectory, **ends_only)
        ends = slice(self.substeps, None, self.substeps)
        columns = slice(column, column + len(at.slot))
        self._fill_samples(samples, columns, at, beds.force[:, :, ends], beds.lift[:, ends])

    def at_samples(self, trajectory: Trajectory) -> Trajectory:
        """Convert the positions of events and breaks from steps to sample intervals."""

        def counted(segment: NDArray[np.int64], offset: Array) -> tuple[NDArray[np.int64], Array]:
            return segment // self.substeps, offset + (segment % self.substeps) * self.step

        event_segment, event_offset = counted(trajectory.event_segment, trajectory.event_offset)
        break_segment, break_offset = counted(trajectory.break_segment, trajectory.break_offset)
        return replace(
            trajectory,
            event_segment=event_segment,
            event_offset=event_offset,
            event_damper=self._others[trajectory.event_damper],
            break_segment=break_segment,
            break_offset=break_offset,
        )

    def accelerations(self, states: Array, slots: NDArray[np.int64]) -> Array:
        """Return the acceleration of every coordinate for rows of a `Trajectory`, shape (coordinates, samples)."""
        return self.structure.accelerations(states, slots)

    def _fill_samples(self, samples: MotionSamples, columns: slice, at: Trajectory, force: Array, lift: Array) -> None:
        n = self.system.coordinates
        samples.rows[: 2 * n, columns] = at.state[:, : 2 * n].T
        samples.rows[2 * n : 3 * n, columns] = self.accelerations(at.state, at.slot)
        gap, contact = gaps_and_contacts(at, self.structure.system)
        samples.rows[3 * n + self._others, columns], samples.contact[self._others, columns] = gap, contact
        floor, ceiling = np.abs(force[:, 0]), np.abs(force[:, 1])
        samples.rows[3 * n + self._rows, columns] = lift
        samples.contact[self._rows, columns] = np.where(
            floor + ceiling == 0.0, FLIGHT, np.where(floor >= ceiling, FLOOR, CEILING)
        )


def interpolated(drive: Array, substeps: int) -> Array:
    """Interpolate the columns of a drive linearly; returns shape (inputs, intervals * substeps + 1).

    >>> interpolated(np.array([[0.0, 1.0, 3.0]]), 2)
    array([[0. , 0.5, 1. , 2. , 3. ]])
    """
    fraction = np.arange(substeps) / substeps
    start, change = drive[:, :-1, None], np.diff(drive, axis=1)[:, :, None]
    return np.concatenate([(start + change * fraction).reshape(len(drive), -1), drive[:, -1:]], axis=1)


def _with_bed_inputs(scene: Scene, system: HybridSystem, bodies: NDArray[np.intp]) -> HybridSystem:
    """Compile a scene without its beds of grains, in the same coordinates, with the beds' forces as inputs.

    `system`: the scene's; its initial state, which includes the beds' weight, is also that of the result; `bodies`:
    coordinates on which the forces act.
    """
    numbers = system.damper_number[system.grains]
    others = [damper for number, damper in enumerate(scene.dampers, 1) if number not in numbers]
    system_without_beds = assemble(scene.replace(dampers=others))
    bed_inputs = np.zeros((system.coordinates, len(bodies)))
    bed_inputs[bodies, np.arange(len(bodies))] = 1.0
    return replace(
        system_without_beds,
        inputs=(*system_without_beds.inputs, *(f"{FORCE_OF_BED} {number}" for number in numbers)),
        drive_units=(*system_without_beds.drive_units, *("N" for _ in bodies)),
        force_drive=np.hstack([system_without_beds.force_drive, bed_inputs]),
        rate_drive=np.hstack(
            [system_without_beds.rate_drive, np.zeros((len(system_without_beds.rate_drive), len(bodies)))]
        ),
        damper_number=system.damper_number[~system.grains],
        initial=system.initial,
    )


def _join(current_state: Trajectory, samples: StateSamples, event_logs: list[tuple[int, Trajectory]]) -> Trajectory:
    """Join the steps of a march: states, events and breaks."""
    logs = {
        item.name: np.concatenate(
            [getattr(current_state, item.name), *(getattr(log, item.name) for _, log in event_logs)]
        )
        for item in fields(Trajectory)
        if item.name.startswith(("event", "break", "before", "after", "speed"))
    }
    for name in ("event_segment", "break_segment"):
        logs[name] = np.repeat(
            np.array([k for k, _ in event_logs], dtype=np.int64), [len(getattr(log, name)) for _, log in event_logs]
        )
    return Trajectory(*samples, **logs)
