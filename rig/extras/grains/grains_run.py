"""Open-loop runs of scenes with beds of grains, in sections, so an interrupted run can be continued.

When LAMMPS reads a bed from a file, it recomputes neighbor lists and forces, which changes the last digits of the
motion. Therefore every run recomputes them at the end of every section: interrupted and uninterrupted runs are
identical to the bit.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array
from rig.core.engine.trajectory import event_table, event_type, events_at_start
from rig.core.scene.scene import Scene
from rig.core.simulation.energy import Energy, energy_balance
from rig.core.system.open_loop_drive import ToneDrive
from rig.extras.grains.coupling import CoupledPropagator, CoupledState, interpolate_drive

#: Time steps of the grains in a section; the work at its end takes at most as long as about a hundred steps.
STEPS_PER_SECTION = 20_000


class GrainsState(NamedTuple):
    """Results of a run up to the end of a section, and the state of beds and structure at this end."""

    coupled: CoupledState
    rows: Array  # motion so far, as in `MotionSamples.rows`; shape (rows, samples)
    contact: NDArray[np.int8]  # shape (dampers, samples so far)
    events: NDArray[np.void]  # events so far
    energy: tuple[Energy, ...]  # energy balance of each section
    ambiguous: int  # number of contact decisions within rounding error so far

    @property
    def samples(self) -> int:
        """Number of samples so far."""
        return self.contact.shape[1]


class GrainsRun:
    """Simulation of a scene with beds of grains in sections.

    `samples`: number of samples of the whole run, including the sample at its start; `rate`: sample rate [Hz]; `drive`,
    shape (inputs, samples): a tone is evaluated at every grain time step; samples are interpolated linearly.
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

    def start(self) -> GrainsState:
        """Return the state at the start of the run."""
        coupled = self.coupled
        started = coupled.set_state(self._initial, self._drive(0, 0)[:, 0])
        buffer = coupled.motion_samples(1)
        coupled.store_present_motion(buffer, 0)
        events = events_at_start(started, coupled.system)
        return GrainsState(coupled.state(), buffer.rows, buffer.contact, events, (), coupled.ambiguous)

    def resume(self, state: GrainsState) -> GrainsState:
        """Restore beds and structure to a stored state, and return it."""
        self.coupled.resume(state.coupled)
        return state

    def advance(self, state: GrainsState) -> GrainsState:
        """Simulate one more section."""
        intervals = max(1, round(STEPS_PER_SECTION / self.coupled.substeps))
        samples = min(state.samples + intervals, self._samples)
        coupled, structure = self.coupled, self.coupled.structure
        first = state.samples - 1
        drive = self._drive(first, samples - 1)
        start, initial = structure.snapshot(), structure.current_state()
        trajectory, bed_motion = coupled.propagate_steps(drive)
        buffer = coupled.motion_samples(samples - state.samples)
        coupled.fill_samples(buffer, 0, trajectory, bed_motion)
        inputs = np.vstack([drive, -bed_motion.force.sum(axis=1)])
        segment_states = np.concatenate([initial.state, trajectory.state[:-1]])
        ns = coupled.system.states
        segment_states[:, ns : ns + len(inputs)] = inputs[:, :-1].T
        segment_states[:, ns + len(inputs) : ns + 2 * len(inputs)] = np.diff(inputs).T
        durations = np.full(len(segment_states), coupled.step)
        energy = energy_balance(structure.tables, start, structure.snapshot(), trajectory, segment_states, durations)
        events_at_samples = coupled.at_samples(trajectory)
        events = event_table(
            (first + events_at_samples.event_segment) / self._rate + events_at_samples.event_offset,
            events_at_samples.event_damper,
            events_at_samples.event_kind,
            events_at_samples.event_speed,
            coupled.system,
        )
        return GrainsState(
            coupled.state(),
            np.concatenate([state.rows, buffer.rows], axis=1),
            np.concatenate([state.contact, buffer.contact], axis=1),
            np.concatenate([state.events, events]).astype(event_type(coupled.system)),
            (*state.energy, energy),
            coupled.ambiguous,
        )

    def motion(self, state: GrainsState) -> tuple[Array, Array, Array, Array]:
        """Return displacement, velocity, acceleration and gap so far; shapes as in `CoupledPropagator.motion_parts`."""
        buffer = self.coupled.motion_samples(0)
        return self.coupled.motion_parts(buffer._replace(rows=state.rows, contact=state.contact))

    def _tone(self, tone: ToneDrive) -> Callable[[int, int], Array]:
        """Return a function of two sample numbers: it evaluates the tone between them, (inputs, grain steps + 1)."""
        substeps, periods_per_step = self.coupled.substeps, self.coupled.step * tone.frequency

        def tone_between(first: int, last: int) -> Array:
            # Count periods instead of adding radians, so the phase is exact over a million periods.
            elapsed_periods = np.arange(first * substeps, last * substeps + 1) * periods_per_step
            phase = 2.0 * np.pi * (elapsed_periods - np.floor(elapsed_periods))
            return np.real(tone.amplitudes[:, None] * np.exp(1j * phase))

        return tone_between

    def _sampled(self, drive: Array) -> Callable[[int, int], Array]:
        """Return a function as `_tone` does, for a sampled drive, shape (inputs, samples)."""
        return lambda first, last: interpolate_drive(drive[:, first : last + 1], self.coupled.substeps)
