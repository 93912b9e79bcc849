"""Open-loop runs of scenes with beds of grains, in stretches, so that an interrupted run can be continued.

When LAMMPS reads a bed from a file, it recomputes neighbours and forces, which changes the last digits of the motion.
Therefore every run recomputes them at the end of every stretch: interrupted and uninterrupted runs are identical to
the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.arrays import Array
from rig.engine.trajectory import EVENT, event_table
from rig.grain_beds.coupling import CoupledPropagator, CoupledState, interpolated
from rig.scene.scene import Scene
from rig.simulation.energy import Energy, ends_of, ledger
from rig.system.open_loop_drive import ToneDrive

#: Grain time steps in a stretch: the work at its end takes as long as about a hundred steps at most.
STRETCH = 20_000


class Course(NamedTuple):
    """Results of a run up to the end of a stretch."""

    state: CoupledState
    rows: Array  # shape (rows of `MotionSamples`, samples so far)
    contact: NDArray[np.int8]  # shape (dampers, samples so far)
    events: NDArray[np.void]  # events so far
    energy: tuple[Energy, ...]  # energy balance of each stretch
    ambiguous: int  # number of contact decisions within rounding so far

    @property
    def samples(self) -> int:
        """Number of samples so far."""
        return self.contact.shape[1]


class GrainsRun:
    """Simulation of a scene with beds of grains from stretch to stretch.

    `samples`: number of samples of the whole run, including the sample at its start; `rate`: sample rate, Hz;
    `drive`, shape (inputs, samples): a tone is evaluated at every grain time step; a sampled drive is interpolated
    linearly.
    """

    def __init__(self, scene: Scene, samples: int, rate: float, drive: ToneDrive | ArrayLike) -> None:
        self._scene, self._samples, self._rate = scene, samples, rate
        self.coupled = CoupledPropagator(scene, 1.0 / rate)
        self._initial = self.coupled.system.initial
        self._drive: Callable[[int, int], Array]
        if isinstance(drive, ToneDrive):
            self._initial, self._drive = drive.state, self._tone(drive)
        else:
            self._drive = self._sampled(np.asarray(drive, dtype=np.float64))

    def begun(self) -> Course:
        """Return the course at the start of the run."""
        coupled = self.coupled
        lifted = coupled.place(self._initial, self._drive(0, 0)[:, 0])
        seen = coupled.motion_samples(1)
        coupled.sample_present(seen, 0)
        zeros = np.zeros(len(lifted))
        events = event_table(zeros, lifted, zeros.astype(np.int64), zeros, coupled.system)
        return Course(coupled.state(), seen.rows, seen.contact, events, (), coupled.ambiguous)

    def resumed(self, course: Course) -> Course:
        """Restore beds and structure to the end of a course, and return it."""
        self.coupled.resume(course.state)
        return course

    def longer(self, course: Course) -> Course:
        """Simulate one more stretch from the end of a course."""
        intervals = max(1, round(STRETCH / self.coupled.substeps))
        samples = min(course.samples + intervals, self._samples)
        coupled, structure = self.coupled, self.coupled.structure
        first = course.samples - 1
        drive = self._drive(first, samples - 1)
        start, at_start = ends_of(structure), structure.present()
        trajectory, beds = coupled.march(drive)
        seen = coupled.motion_samples(samples - course.samples)
        coupled.show(seen, 0, trajectory, beds)
        ports = np.vstack([drive, -beds.force.sum(axis=1)])
        begins = np.concatenate([at_start.state, trajectory.state[:-1]])
        ns = coupled.system.states
        begins[:, ns : ns + len(ports)] = ports[:, :-1].T
        begins[:, ns + len(ports) : ns + 2 * len(ports)] = np.diff(ports).T
        durations = np.full(len(begins), coupled.step)
        energy = ledger(
            self._scene, structure.tables, start, ends_of(structure), trajectory, begins, durations
        )
        happened = coupled.at_samples(trajectory)
        events = event_table(
            (first + happened.event_segment) / self._rate + happened.event_offset,
            happened.event_damper,
            happened.event_kind,
            happened.event_speed,
            coupled.system,
        )
        return Course(
            coupled.state(),
            np.concatenate([course.rows, seen.rows], axis=1),
            np.concatenate([course.contact, seen.contact], axis=1),
            np.concatenate([course.events, events]).astype(EVENT),
            (*course.energy, energy),
            coupled.ambiguous,
        )

    def parts(self, course: Course) -> tuple[Array, Array, Array, Array]:
        """Return the results of a course in the form of `CoupledPropagator.parts`."""
        seen = self.coupled.motion_samples(0)
        return self.coupled.parts(seen._replace(rows=course.rows, contact=course.contact))

    def _tone(self, tone: ToneDrive) -> Callable[[int, int], Array]:
        substeps, in_a_step = self.coupled.substeps, self.coupled.step * tone.frequency

        def columns(first: int, last: int) -> Array:
            # Count turns instead of adding radians, so that the phase is exact over a million periods.
            turns = np.arange(first * substeps, last * substeps + 1) * in_a_step
            phase = 2.0 * np.pi * (turns - np.floor(turns))
            return np.real(tone.amplitudes[:, None] * np.exp(1j * phase))

        return columns

    def _sampled(self, drive: Array) -> Callable[[int, int], Array]:
        return lambda first, last: interpolated(drive[:, first : last + 1], self.coupled.substeps)
