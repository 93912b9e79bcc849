"""The rig as a plant in the sense of control engineering: drive samples are its input, motion its output."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array
from rig.core.engine.propagator import Propagator, sampled_propagator
from rig.core.engine.samples import MotionSamples
from rig.core.engine.trajectory import Trajectory, event_table, events_at_start
from rig.core.laws.events import FLOOR
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import SAMPLE_RATE, positive_value
from rig.core.simulation.grains import grains_simulation
from rig.core.simulation.motion import Motion
from rig.core.system.assembly import assemble
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import validate_drive


class Plant:
    """A scene's rig under sampled drive with first-order hold.

    The motion between samples is exact, including contacts, for any division of the drive into blocks.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`.
    rate : float or str
        Samples per second, in Hz or as a string such as ``"5120 Hz"``.

    Attributes
    ----------
    inputs, drive_units : tuple of str
        Names of the inputs: "shaker" (or "shaker 1", "shaker 2", ...) and "hammer", if they exist; units of the inputs:
        N (force), m (commanded displacement of the table) or V (voltage at the amplifier).
    points : tuple of str
        "body 1" ... and "table" ("table 2" at the second of several shakers) if there is one.
    """

    def __init__(self, scene: SceneLike, rate: float | str = 5120.0) -> None:
        scene, self.rate = scene_of(scene), positive_value(rate, SAMPLE_RATE, "rate")
        self.system = assemble(scene)
        self.inputs, self.drive_units = self.system.inputs, self.system.drive_units
        self.points = self.system.points
        self._propagator, self._steps = _propagator(scene, self.system, 1.0 / self.rate)
        # Largest drive of each input before the amplifier clips; None: no input has a limit.
        limits = self.system.drive_limit
        self._drive_limit = limits[:, None] if np.isfinite(limits).any() else None
        self._dampers = len(scene.dampers)
        # Empty arrays for blocks without discontinuities or events, computed once.
        self._no_discontinuities: tuple[Array, Array, Array] | None = None
        self._no_events = event_table(
            np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), self.system
        )
        self._next_sample = 0
        self._last_drive = np.zeros((len(self.inputs), 1))

    @property
    def ambiguous(self) -> int:
        """Number of contact decisions within rounding error so far; each decision was "no contact"."""
        return self._propagator.ambiguous

    def advance(self, drive: ArrayLike) -> Motion:
        """Advance the rig by a block of drive samples.

        Parameters
        ----------
        drive : array_like, shape (inputs, samples)
            Drive at the next samples. The first sample of the first block is the drive at t = 0, when the motion
            starts.

        Returns
        -------
        Motion
            Motion at the same samples; sample k depends on drive up to k.

        Raises
        ------
        RunError
            If the drive has the wrong shape, or is not finite.
        """
        block = validate_drive(drive, self.inputs, self._next_sample)
        if self._drive_limit is not None:
            # Faster than `numpy.clip` by a factor of two.
            block = np.minimum(np.maximum(block, -self._drive_limit), self._drive_limit)
        first, samples = self._next_sample, block.shape[1]
        buffer = self._propagator.motion_samples(samples)
        started = np.zeros((2, 0), dtype=np.int64)
        offset = 0
        if first == 0 and samples:
            offset = 1
            self._last_drive = block[:, :1].copy()
            started = self._propagator.set_state(
                self.system.initial, np.concatenate([block[:, 0], np.zeros(len(self.inputs))])
            )
            self._propagator.store_present_motion(buffer, 0)
        drive_from_last = np.concatenate([self._last_drive, block[:, offset:]], axis=1)
        trajectory = self._propagator.sample_motion(drive_from_last, self._steps, buffer, offset)
        self._last_drive = drive_from_last[:, -1:].copy()
        self._next_sample += samples
        return self._motion(buffer, trajectory, first + offset, first, started)

    def _motion(
        self, buffer: MotionSamples, trajectory: Trajectory, first_end: int, first: int, started: NDArray[np.int64]
    ) -> Motion:
        """Return the motion of a block; segment s of the trajectory ends at sample `first_end` + s."""
        system, interval = self.system, 1.0 / self.rate
        displacement, velocity, acceleration, gap = self._propagator.motion_parts(buffer)
        discontinuities = (
            self._discontinuities(trajectory)
            if self._no_discontinuities is None or len(trajectory.state_before)
            else self._no_discontinuities
        )
        events = self._no_events
        if len(trajectory.event_segment):
            times = (first_end + trajectory.event_segment - 1) * interval + trajectory.event_offset
            events = event_table(times, trajectory.event_damper, trajectory.event_kind, trajectory.event_speed, system)
        if started.size:
            events = np.concatenate([events_at_start(started, system), events])
        return Motion(
            first=first,
            displacement=displacement,
            velocity=velocity,
            acceleration=acceleration,
            gap=self._for_all_dampers(gap, 0.0),
            contact=self._for_all_dampers(buffer.contact, FLOOR),
            discontinuity_sample=first_end + trajectory.discontinuity_segment,
            discontinuity_offset=np.minimum(trajectory.discontinuity_offset, interval),
            discontinuity_displacement=discontinuities[0],
            discontinuity_velocity=discontinuities[1],
            discontinuity_acceleration=discontinuities[2],
            events=events,
        )

    def _discontinuities(self, trajectory: Trajectory) -> tuple[Array, Array, Array]:
        """Return displacements, velocities and accelerations at the discontinuities of a block, as in `Motion`."""
        n, points = self.system.coordinates, len(self.system.points)
        before, after = trajectory.state_before, trajectory.state_after
        accelerations = self._propagator.accelerations(
            np.concatenate([before, after]),
            np.concatenate([trajectory.table_index_before, trajectory.table_index_after]),
        )
        discontinuities = (
            np.ascontiguousarray(before[:, :points].T),
            np.array([before[:, n : n + points].T, after[:, n : n + points].T]),
            accelerations.reshape(n, 2, len(before))[:points].transpose(1, 0, 2),
        )
        if not len(before):
            self._no_discontinuities = discontinuities
        return discontinuities

    def _for_all_dampers(self, rows: NDArray[Any], constant: float) -> NDArray[Any]:
        """Add rows with a constant for dampers that cannot move; shape (dampers, samples)."""
        if len(rows) == self._dampers:
            return rows
        all_dampers = np.full((self._dampers, rows.shape[1]), constant, dtype=rows.dtype)
        all_dampers[self.system.damper_number - 1] = rows
        return all_dampers


def _propagator(scene: Scene, system: HybridSystem, interval: float) -> tuple[Propagator | Any, float]:
    """Return the propagator of the system and its number of steps in a sample interval."""
    if not system.grains.any():
        return sampled_propagator(system, interval)
    coupled, steps = grains_simulation().propagator(scene, interval)
    return coupled, steps
