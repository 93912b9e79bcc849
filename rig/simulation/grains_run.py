"""Open-loop runs of scenes with beds of grains, stretch by stretch, so that a run goes on where it was stopped.

A bed that LAMMPS reads finds its neighbours and forces anew, and moves on with other last digits than one that goes on.
So at the end of every stretch of every run the beds find them anew: a run that was stopped and one that was not have
the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.engine.trajectory import EVENT, Array, event_table
from rig.grain_beds.coupling import CoupledPropagator, CoupledState, interpolated
from rig.scene.scene import Scene
from rig.simulation.energy import Energy, ends_of, ledger
from rig.system.open_loop_drive import ToneDrive

#: Steps of the grains in a stretch: what comes at its end takes as long as some hundred at most.
STRETCH = 20_000


class Course(NamedTuple):
    """What a run has come to at the end of a stretch.

    Attributes
    ----------
    state : CoupledState
    rows : ndarray, shape (rows of `MotionSamples`, samples so far)
    contact : ndarray of int8, shape (dampers, samples so far)
    events : structured ndarray
        So far.
    energy : tuple of Energy
        Of each stretch.
    ambiguous : int
        Decisions that lay within rounding so far.
    """

    state: CoupledState
    rows: Array
    contact: NDArray[np.int8]
    events: NDArray[np.void]
    energy: tuple[Energy, ...]
    ambiguous: int

    @property
    def samples(self) -> int:
        """Samples so far."""
        return self.contact.shape[1]


class GrainsRun:
    """The way of a scene with beds of grains from stretch to stretch.

    Parameters
    ----------
    scene : Scene
    samples : int
        Of the whole run, the one at its start among them.
    rate : float
        Samples in a second.
    drive : ToneDrive or array_like, shape (inputs, samples)
        A tone is followed from step to step of the grains, a sampled drive in straight lines.
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
        """Give the course of the start alone."""
        coupled = self.coupled
        lifted = coupled.place(self._initial, self._drive(0, 0)[:, 0])
        seen = coupled.motion_samples(1)
        coupled.sample_present(seen, 0)
        zeros = np.zeros(len(lifted))
        events = event_table(zeros, lifted, zeros.astype(np.int64), zeros, coupled.system)
        return Course(coupled.state(), seen.rows, seen.contact, events, (), coupled.ambiguous)

    def resumed(self, course: Course) -> Course:
        """Put beds and structure at the end of a course, and give that."""
        self.coupled.resume(course.state)
        return course

    def longer(self, course: Course) -> Course:
        """Go on for a stretch from the end of a course, where this run is."""
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
        """Give what is seen in a course, as `CoupledPropagator.parts` does."""
        seen = self.coupled.motion_samples(0)
        return self.coupled.parts(seen._replace(rows=course.rows, contact=course.contact))

    def _tone(self, tone: ToneDrive) -> Callable[[int, int], Array]:
        substeps, in_a_step = self.coupled.substeps, self.coupled.step * tone.frequency

        def columns(first: int, last: int) -> Array:
            # Turns are counted, not radians added up: a million periods keep their phase.
            turns = np.arange(first * substeps, last * substeps + 1) * in_a_step
            phase = 2.0 * np.pi * (turns - np.floor(turns))
            return np.real(tone.amplitudes[:, None] * np.exp(1j * phase))

        return columns

    def _sampled(self, drive: Array) -> Callable[[int, int], Array]:
        return lambda first, last: interpolated(drive[:, first : last + 1], self.coupled.substeps)
