"""Open-loop simulation of a scene: the true motion, without sensors, converter or controller."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError, SceneError
from rig.core.base.figure_types import Axes
from rig.core.base.progress import CountProgress
from rig.core.engine.propagator import Propagator, sampled_propagator, tone_propagator
from rig.core.engine.state import State
from rig.core.engine.trajectory import Trajectory, event_table, events_at_start, gaps_and_contacts
from rig.core.numerics.memory import require_memory
from rig.core.results import Result, complete_style
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import FREQUENCY, SAMPLE_RATE, TIME, finite_number
from rig.core.simulation.energy import Energy, energy_balance
from rig.core.simulation.grains import grains_simulation
from rig.core.system.assembly import assemble
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import ToneDrive, sampled_drive, tone_drive, validate_drive

#: With more samples per period of a tone than this value, time steps divide a sample interval instead of a period.
MIN_DENSE_SAMPLES = 10


@dataclass(frozen=True, repr=False)
class Run(Result):
    """A simulated motion.

    Attributes
    ----------
    points : tuple of str
        Rows of the motion: "body 1" ... and "table" ("table 2" at the second of several shakers) if there is one.
    time : ndarray, shape (samples,)
        Time [s].
    displacement, velocity, acceleration : ndarray, shape (points, samples)
        SI; at a sample that coincides with an impact, the value after it.
    gap : ndarray, shape (dampers that move, samples)
        Height of each damper above its floor [m]; it includes the overlap of finite-duration contact. For a bed of
        grains, height of its center of mass above the initial position.
    contact : ndarray of int8, shape (dampers that move, samples)
        0 in flight, 1 at the floor, 2 at the ceiling.
    events : structured ndarray
        `time` [s], `damper` (1-based position in the scene's list), `kind` ("separation", "floor", "ceiling"; with
        finite-duration contact "touch" and "release"), `speed` (closing speed at an impact or touch, m/s).
        Grains have no events. In a scene with joints also `joint`, the number of the joint from 1; `joint` is 0 for an
        event of a damper, and `damper` is 0 for an event of a joint. `events.dtype.metadata` also contains `ambiguous`.
    ambiguous : int
        Number of contact decisions within rounding error; each was decided as no contact.
    """

    scene: Scene
    points: tuple[str, ...]
    time: Array
    displacement: Array
    velocity: Array
    acceleration: Array
    gap: Array
    contact: NDArray[np.int8]
    events: NDArray[Any]
    ambiguous: int
    _energy_balance: Callable[[], Energy] = field(repr=False, compare=False)

    def summary(self) -> str:
        """Return the duration and the largest motion in words."""
        largest = f"{1e3 * float(abs(self.displacement).max()):.4g} mm"
        return (
            f"{self.scene.name}: {', '.join(self.points)}, {self.time[-1]:.4g} s, {self.time.size} samples, "
            f"{len(self.events)} events, largest displacement {largest}"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return time and the motion of each point."""
        motion = {"displacement_m": self.displacement, "velocity_m/s": self.velocity}
        motion["acceleration_m/s²"] = self.acceleration
        return {
            "time_s": self.time,
            **{
                f"{point} {name}": row
                for name, rows in motion.items()
                for point, row in zip(self.points, rows, strict=True)
            },
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the displacement of each point over time."""
        for point, row in zip(self.points, self.displacement, strict=True):
            ax.plot(self.time, 1e3 * row, **complete_style(style, label=point, lw=0.8))
        ax.set(xlabel="time / s", ylabel="displacement / mm")

    @cached_property
    def energy(self) -> Energy:
        """The energy balance of the run [J]."""
        return self._energy_balance()


def simulate(
    scene: SceneLike,
    duration: float | str,
    rate: float | str = 5120.0,
    drive: ArrayLike | None = None,
    frequency: float | str | None = None,
    keep: Path | None = None,
    progress: CountProgress | None = None,
) -> Run:
    """Simulate a scene without sensors and controller.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`.
    duration : float or str
        Seconds, or text with a unit, such as ``"2 s"``.
    rate : float or str
        Samples of the motion per second; for a tone it has no influence on the motion.
    drive : array_like, shape (inputs, samples), optional
        A sampled drive at `rate`, with first-order hold, instead of the scene's test.
    frequency : float or str, optional
        Drive with a sine of this frequency, such as ``"49 Hz"``, instead of the test's signal. Its amplitude is the
        test's force or drive.
    keep : Path, optional
        Checkpoint file for a run with grains, which takes long. After an interruption, the same run continues from the
        file, with bit-identical results. The file is not deleted at the end.
    progress : callable, optional
        Called in runs with grains with the completed and total number of samples.

    Returns
    -------
    Run
        Motion at the samples, with all events.

    Raises
    ------
    SceneError
        If duration, rate or frequency is invalid, or the test cannot run open loop.
    RunError
        If the drive has a different shape or is not finite, or `keep` belongs to a different run.

    Notes
    -----
    Without `drive` and `frequency` the scene's test is run open loop: a sine unchanged, a stepped sine at
    its first frequency, a swept sine, hammer impacts, or free vibration. If the test controls the amplitude of a
    spring force, the drive produces that amplitude in the linear structure with resting dampers.

    Examples
    --------
    >>> import rig
    >>> run = rig.simulate(rig.load("reference-A"), duration=0.1, rate=1000.0)
    >>> run.displacement.shape, len(run.events)
    ((3, 101), 5)
    """
    scene = scene_of(scene)
    duration, rate = finite_number(duration, TIME, "`duration`"), finite_number(rate, SAMPLE_RATE, "`rate`")
    frequency = finite_number(frequency, FREQUENCY, "`frequency`")
    for name, value in (("duration", duration), ("rate", rate)):
        if value is None or value <= 0.0:
            raise SceneError(f"`{name}`: got {value!r}; expected a positive, finite number")
    system = assemble(scene)
    _check_memory(system, duration * rate)
    samples = int(duration * rate * (1.0 + 1e-12)) + 1
    if drive is None and samples < 2:
        raise SceneError(
            f"duration: got {duration:g} s, less than a sample interval at {rate:g} Hz; "
            f"expected at least {1.0 / rate:g} s"
        )
    has_grains = bool(system.grains.any())
    tone = None if drive is not None else tone_drive(scene, system, frequency)
    if tone is not None and not has_grains:
        _check_memory(system, duration * (rate + tone.frequency))
        return _simulate_tone(scene, system, tone, duration, samples, rate)
    if has_grains and tone is not None:
        return grains_simulation().simulate(scene, tone, samples, rate, keep, progress)
    sampled = sampled_drive(scene, system, samples, rate) if drive is None else _validated_drive(drive, system)
    if has_grains:
        return grains_simulation().simulate(scene, sampled, sampled.shape[1], rate, keep, progress)
    return _simulate_sampled(scene, system, sampled, rate)


def _check_memory(system: HybridSystem, instants: float) -> None:
    """Reject a run whose motion at a number of instants exceeds the memory limit."""
    values_per_instant = 3 * system.states + 3 * len(system.points) + 4 * len(system.damper_mass) + 16
    require_memory(8.0 * values_per_instant * instants, f"a motion of {instants:.3g} instants")


def _validated_drive(drive: ArrayLike, system: HybridSystem) -> Array:
    """Check a user's drive; return it as an array (inputs, samples)."""
    block = validate_drive(drive, system.inputs)
    if block.shape[1] < 2:
        raise RunError(f"drive: got {block.shape[1]} samples; expected at least 2")
    return block


def _simulate_tone(
    scene: Scene, system: HybridSystem, tone: ToneDrive, duration: float, samples: int, rate: float
) -> Run:
    """Simulate under a tone, in segments between samples and period starts."""
    is_dense = rate > MIN_DENSE_SAMPLES * tone.frequency  # many samples in a period
    propagator, steps = tone_propagator(system, tone.amplitudes, tone.omega, 1.0 / rate if is_dense else None)
    # Cosine and sine of the drive at t = 0.
    started = propagator.set_state(tone.state, np.array([1.0, 0.0]))
    times, is_sample, is_period_start = _segment_times(duration, samples, rate, tone.frequency)
    start = propagator.snapshot()
    initial = propagator.current_state()
    durations = np.diff(times).astype(np.float64)
    segment_steps = durations / propagator.tables.step
    if is_dense:
        segment_steps[is_sample[:-1] & is_sample[1:]] = steps
    trajectory = propagator.propagate_tone(segment_steps, np.arange(len(durations)), is_period_start[:-1])
    segment_starts = times[:-1].astype(np.float64)
    segment_states = np.concatenate([initial.state, trajectory.state[:-1]])
    sample_rows = np.flatnonzero(is_sample[1:])
    return _assemble_run(
        scene, propagator, rate, start, initial, trajectory, sample_rows, segment_starts, durations, segment_states,
        started,
    )  # fmt: skip


def _segment_times(
    duration: float, samples: int, rate: float, frequency: float
) -> tuple[NDArray[np.longdouble], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the end of each segment, s, and whether it is a sample, and whether a period starts there."""
    sample_times = np.arange(samples, dtype=np.longdouble) / np.longdouble(rate)
    end = max(np.longdouble(duration), sample_times[-1])
    # Period starts follow from the frequency in Hz: rounding of omega would shift them over a million periods.
    period = 1 / np.longdouble(frequency)
    periods = np.arange(1, int(end / period) + 1, dtype=np.longdouble) * period
    times, positions = np.unique(np.concatenate([sample_times, periods, [end]]), return_inverse=True)
    is_sample, is_period_start = np.zeros(len(times), dtype=bool), np.zeros(len(times), dtype=bool)
    is_sample[positions[:samples]] = True
    is_period_start[positions[samples:-1]] = True
    return times, is_sample, is_period_start


def _simulate_sampled(scene: Scene, system: HybridSystem, drive: Array, rate: float) -> Run:
    """Simulate under a sampled drive (inputs, samples), in segments between samples."""
    propagator, steps = sampled_propagator(system, 1.0 / rate)
    started = propagator.set_state(system.initial, np.concatenate([drive[:, 0], np.zeros(len(system.inputs))]))
    start = propagator.snapshot()
    initial = propagator.current_state()
    trajectory = propagator.propagate_samples(drive, steps)
    intervals = drive.shape[1] - 1
    segment_states = np.concatenate([initial.state, trajectory.state[:-1]])
    inputs, ns = len(system.inputs), system.states
    # First-order hold: this is the change of the drive within a segment.
    segment_states[:, ns + inputs : ns + 2 * inputs] = np.diff(drive, axis=1).T
    durations = np.full(intervals, 1.0 / rate)
    segment_starts = np.arange(intervals) / rate
    return _assemble_run(
        scene, propagator, rate, start, initial, trajectory, np.arange(intervals), segment_starts, durations,
        segment_states, started,
    )  # fmt: skip


def _assemble_run(
    scene: Scene, propagator: Propagator, rate: float, start: State, initial: Trajectory,
    trajectory: Trajectory, sample_rows: NDArray[np.int64], segment_starts: Array, durations: Array,
    segment_states: Array, started: NDArray[np.int64],
) -> Run:  # fmt: skip
    """Return the run from its initial state and a trajectory; row k of the trajectory is the end of segment k.

    `sample_rows`: rows that are samples; `segment_starts`, `durations`: starts and durations of the segments [s];
    `segment_states`: states at the starts; `started`: elements that change their regime at t = 0, and kinds of these
    events, shape (2, events).
    """
    system, end = propagator.system, propagator.snapshot()
    n, points = system.coordinates, len(system.points)
    states = np.concatenate([initial.state, trajectory.state[sample_rows]])
    table_indices = np.concatenate([initial.table_index, trajectory.table_index[sample_rows]])
    initial_gap, initial_contact = gaps_and_contacts(initial, system)
    gap, contact = gaps_and_contacts(trajectory, system)
    times = segment_starts[trajectory.event_segment] + trajectory.event_offset
    events = event_table(times, trajectory.event_damper, trajectory.event_kind, trajectory.event_speed, system)
    events = np.concatenate([events_at_start(started, system), events])
    return Run(
        scene=scene,
        points=system.points,
        time=np.arange(len(states)) / rate,
        displacement=np.ascontiguousarray(states[:, :points].T),
        velocity=np.ascontiguousarray(states[:, n : n + points].T),
        acceleration=propagator.accelerations(states, table_indices)[:points],
        gap=np.concatenate([initial_gap, gap[:, sample_rows]], axis=1),
        contact=np.concatenate([initial_contact, contact[:, sample_rows]], axis=1),
        events=events.astype(np.dtype(events.dtype.descr, metadata={"ambiguous": propagator.ambiguous})),
        ambiguous=propagator.ambiguous,
        _energy_balance=partial(energy_balance, propagator.tables, start, end, trajectory, segment_states, durations),
    )
