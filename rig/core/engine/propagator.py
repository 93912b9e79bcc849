"""Propagation of a system in time, under one of two kinds of drive; the entry point of the engine.

Time is divided into segments. Sampled drive: each sample interval is a segment; the linear interpolation of the drive
(first-order hold) is integrated exactly. Pure tone: a segment ends at each sample instant and at each start of a
period. At the start of a period the phase of the drive is reset, so that it is exact after any number of periods.

The drive states are the part of the state from which the inputs are computed. An event is a change of the regime of one
element. A discontinuity is an instant at which velocities or accelerations jump. Both are logged. A table index
identifies the tables of a configuration (which forces act in the elements).
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.engine.flow_tables import MAX_RATE_TIMES_STEP, FlowTables, tables_for
from rig.core.engine.kernel import DONE, LOG_FULL, STUCK, TABLES_MISSING, advance
from rig.core.engine.power_series import CONTACTS_UNCHECKED, STATE_ONLY, store_accelerations
from rig.core.engine.samples import MotionSamples, StateSamples, store_motion, store_state
from rig.core.engine.screening import reset_envelope
from rig.core.engine.state import (
    AMBIGUOUS_CROSSINGS,
    CONFIGURATION,
    DISCONTINUITY_FIELDS,
    EVENT_FIELDS,
    N_EVENTS,
    TABLE_INDEX,
    Log,
    State,
    empty_log,
    state_at_rest,
)
from rig.core.engine.trajectory import Trajectory
from rig.core.engine.workspace import Workspace, workspace_for
from rig.core.numerics.bernstein import N_COEFFICIENTS
from rig.core.numerics.jit import RepeatedCall, kernel
from rig.core.numerics.simd import LANES, aligned_zeros, padded_length
from rig.core.settings.quantities import LENGTH
from rig.core.system.drive_generator import DriveGenerator, first_order_hold, pure_tone
from rig.core.system.hybrid_system import HybridSystem

#: Minimum number of rows (events and discontinuities) of a new log.
LOG_ROWS = 1024
# Maximum number of steps in a sample interval or a period; this number takes some seconds of CPU time.
MAX_STEPS = 1e7
# `Segments.sets_drive`: every segment, or no segment, sets the drive at its start.
_EVERY_SEGMENT = np.ones(1, dtype=bool)
_NO_SEGMENT = np.zeros(1, dtype=bool)
# `Segments.row`: the only segment is stored in the first row, or is not stored.
_FIRST_ROW = np.zeros(1, dtype=np.int64)
_NO_ROW = np.full(1, -1)
# `Segments.steps` of a segment of zero duration.
_ZERO_STEPS = np.zeros(1)


class Segments(NamedTuple):
    """Consecutive time segments.

    steps: durations in step lengths; shape (segments,), or (1,) if all are equal. drive: at the ends of the segments;
    shape (inputs, segments + 1). sets_drive: whether the drive states are set, at the start of a segment, to the drive
    and its change over the segment; shape as of `steps`.
    row: row in which the motion at the end of each segment is stored, or -1; shape (segments,).
    """

    steps: Array
    sets_drive: NDArray[np.bool_]
    drive: Array
    row: NDArray[np.int64]

    def ends(self, step: float) -> Array:
        """Return the end of each segment, s after the start of the first."""
        ends: Array = np.cumsum(np.broadcast_to(self.steps, self.row.shape)) * step
        return ends


@kernel
def _propagate(
    flow: Any, model: Any, state: Any, workspace: Any, log: Any, segments: Segments, first: int, remaining: float,
    states: StateSamples, motion: MotionSamples, status: int,
) -> tuple[int, int, float]:  # fmt: skip
    """Propagate through segments from number `first` on, and fill the rows of `states` and the columns of `motion`.

    `remaining`: steps of segment `first` still to be propagated; negative: all. `status`: see `advance`.

    Returns (reason, segment, remaining). The reason is `DONE` after the last segment. Otherwise it is another reason of
    `advance`; after the caller has removed the cause, continue from `segment` and `remaining`.
    """
    steps, sets_drive, drive, row = segments
    inputs, n_segments = drive.shape[0], drive.shape[1] - 1
    first_drive_state = flow.rates_constant.shape[1] - 2 * inputs
    stride = 1 if steps.shape[0] > 1 else 0
    reset_envelope(workspace.envelope, flow.rates_constant.shape[1])
    for k in range(first, n_segments):
        segment_steps, stored = steps[stride * k], row[k] >= 0
        if remaining < 0.0:
            remaining = segment_steps
            if sets_drive[stride * k]:
                for i in range(inputs):
                    state.z[first_drive_state + i] = drive[i, k]
                    state.z[first_drive_state + inputs + i] = drive[i, k + 1] - drive[i, k]
        reason, remaining, status = advance(
            flow, model, state, workspace, log, k, segment_steps, remaining, status, stored
        )
        if reason != DONE:
            return reason, k, remaining
        if state.counters[TABLE_INDEX] < 0:
            return TABLES_MISSING, k, 0.0
        if stored:
            if states.table_index.shape[0] > 0:
                store_state(model, state, row[k], states)
            if motion.rows.shape[1] > 0:
                store_motion(model, state, motion, row[k], k == n_segments - 1)
        remaining = -1.0
    return DONE, n_segments, -1.0


@kernel
def _store_accelerations(
    flow: Any, coordinates: int, states: Array, table_indices: NDArray[np.int64], work: Array
) -> None:
    """Compute the accelerations for each row of `states`, and store them after the state; `work`: scratch array."""
    for k in range(states.shape[0]):
        store_accelerations(flow, coordinates, table_indices[k], states[k], work, STATE_ONLY)


#: A motion with a larger displacement has diverged, because no length in a scene is larger.
MAX_DISPLACEMENT_M = LENGTH.maximum


class Propagator:
    """Propagates a system in time.

    `drive`: how the inputs evolve within a segment; `step`: step length in seconds, see `step_for`. Raises `SceneError`
    if a damper is a bed of grains.
    """

    def __init__(self, system: HybridSystem, drive: DriveGenerator, step: float) -> None:
        system.reject_grains()
        self.system, self.drive = system, drive
        self.tables = tables_for(system, drive, step)
        dampers, elements = system.dampers, len(system.elements)
        size = padded_length(self.tables.size + 2 * system.coordinates)
        self.log = empty_log(max(LOG_ROWS, 16 * elements), self.tables.size, dampers)
        self.workspace: Workspace = workspace_for(self.tables.flow, self.tables.model.laws, size)
        self.state = state_at_rest(system, size, len(self.workspace.signals.row))
        self._buffer = aligned_zeros(LANES, padded_length(3 * system.coordinates + dampers))
        self._no_motion, self._no_states = self.motion_samples(0), self.state_samples(0)
        self._no_drive = np.zeros((len(system.inputs), 2))
        self._elapsed_s = 0.0
        self._empty_log = _copied_log(self.log, 0, 0, self.tables)
        self._propagate, self._store_accelerations = RepeatedCall(_propagate), RepeatedCall(_store_accelerations)
        self._look_up_tables()

    @property
    def ambiguous(self) -> int:
        """Number of contact decisions so far that depended on rounding."""
        return int(self.state.counters[AMBIGUOUS_CROSSINGS])

    @property
    def multiplications_per_step(self) -> int:
        """Approximate number of multiplications of a step."""
        flow = self.tables.flow
        return self.tables.size**2 if flow.has_step_matrix else flow.column.size * N_COEFFICIENTS

    def set_state(self, state: Array, drive: Array) -> NDArray[np.int64]:
        """Set the state, with dampers at rest and joints in the regimes that contain their gaps and speeds.

        Elements whose holding force would exceed its limits change their regime at once.

        `state`: shape (states,), SI units; `drive`: drive states. Returns the numbers (from 0) of these elements and
        the kinds of their events, shape (2, events).
        """
        state = state.copy()
        regimes = self.system.joint_regimes(state)
        if regimes:
            laws, self.state.regime[self.system.dampers :] = self.tables.model.laws, regimes
            forces = laws.regimes.force_index[laws.elements.first_regime + self.state.regime]
            self.state.counters[CONFIGURATION] = int(laws.elements.stride @ forces)
            self._look_up_tables()
        self.state.z[: self.system.states] = state
        self.state.z[self.system.states : self.tables.size] = drive
        self._advance(
            Segments(_ZERO_STEPS, _NO_SEGMENT, self._no_drive, _NO_ROW),
            self._no_states,
            self._no_motion,
            CONTACTS_UNCHECKED,
        )
        n_events = self.log.counts[N_EVENTS]
        started = np.array([self.log.events.damper[:n_events], self.log.events.kind[:n_events]])
        self.log.counts[:] = 0
        self._look_up_tables()
        return started

    def snapshot(self) -> State:
        """Return a copy of the complete state, for `resume`."""
        return State(*(part.copy() for part in self.state))

    def resume(self, snapshot: tuple[Array, ...]) -> None:
        """Continue from a `snapshot` of this system; the drive of the next segments may be different."""
        for current, copy in zip(self.state, snapshot, strict=True):
            current[...] = copy
        self._look_up_tables()

    def start_period(self, level: float) -> None:
        """Reset the drive to the start of a period (phase zero); `level`: factor on the tone's amplitudes."""
        self.state.z[self.system.states : self.tables.size] = (level, 0.0)

    def current_state(self) -> Trajectory:
        """Return the present state as a trajectory of one sample without events."""
        return Trajectory(
            self.state.z[None].copy(),
            self.state.counters[TABLE_INDEX : TABLE_INDEX + 1].copy(),
            self.state.height[None].copy(),
            self.tables.contacts(self.state.regime)[None],
            *self._take_log(),
        )

    def propagate_samples(self, drive: Array, interval_steps: float) -> Trajectory:
        """Propagate through the sample intervals between the columns of a sampled drive (inputs, samples + 1).

        `interval_steps`: sample interval in step lengths.
        """
        intervals = drive.shape[1] - 1
        segments = Segments(np.array([interval_steps]), _EVERY_SEGMENT, drive, np.arange(intervals))
        return self._run(segments, self.state_samples(intervals), self._no_motion)

    def propagate_interval(self, drive: Array, interval_steps: Array, states: StateSamples) -> Trajectory | None:
        """Propagate through one sample interval; fast, because the caller provides reusable arrays.

        `drive`: shape (inputs, 2). `interval_steps`: sample interval in step lengths, shape (1,). `states`: arrays for
        one sample from `state_samples`, which receive the state at the end. Returns None if there was no event.
        """
        self._advance(Segments(interval_steps, _EVERY_SEGMENT, drive, _FIRST_ROW), states, self._no_motion)
        self._elapsed_s += float(interval_steps[0]) * self.tables.step
        return Trajectory(*states, *self._take_log()) if self.log.counts[:2].any() else None

    def sample_motion(self, drive: Array, interval_steps: float, motion: MotionSamples, column: int) -> Trajectory:
        """Propagate like `propagate_samples`; store the motion in `motion` from a column on, but store no states."""
        motion.first_column[0] = column
        rows = np.arange(column, column + drive.shape[1] - 1)
        return self._run(Segments(np.array([interval_steps]), _EVERY_SEGMENT, drive, rows), self._no_states, motion)

    def motion_samples(self, samples: int) -> MotionSamples:
        """Return new arrays for the motion at a number of samples."""
        return MotionSamples(
            rows=np.empty((self._buffer.shape[1], samples)),
            contact=np.empty((self.system.dampers, samples), dtype=np.int8),
            first_column=np.zeros(1, dtype=np.int64),
            buffer=self._buffer,
        )

    def motion_parts(self, motion: MotionSamples) -> tuple[Array, Array, Array, Array]:
        """Return displacements, velocities, accelerations (points, samples) and gaps (dampers, samples), SI units."""
        n, points, rows = self.system.coordinates, len(self.system.points), motion.rows
        displacement, velocity, acceleration = (rows[k * n : k * n + points] for k in range(3))
        return displacement, velocity, acceleration, rows[3 * n : 3 * n + self.system.dampers]

    def store_present_motion(self, motion: MotionSamples, column: int) -> None:
        """Store the present motion in one column of `motion`."""
        motion.first_column[0] = column
        self._advance(Segments(_ZERO_STEPS, _NO_SEGMENT, self._no_drive, np.array([column])), self._no_states, motion)

    def propagate_tone(
        self, steps: Array, sample_row: NDArray[np.int64], new_period: NDArray[np.bool_], level: float = 1.0
    ) -> Trajectory:
        """Propagate through segments under a tone.

        `steps`: durations in step lengths; `sample_row`: row in which the state at the end of the segment is stored, or
        -1; `new_period`: whether a period of the drive begins with the segment; `level`: factor on the tone's
        amplitudes.
        """
        # At the start of a period the drive states are (level, 0), as for a constant sampled drive.
        drive = np.full((1, sample_row.size + 1), level)
        states = self.state_samples(int(sample_row.max(initial=-1)) + 1)
        return self._run(Segments(steps, new_period, drive, sample_row), states, self._no_motion)

    def propagate_periods(self, steps: float, periods: int, stored: int = 0, level: float = 1.0) -> StateSamples:
        """Propagate through periods under a tone; return the states at the ends of the last `stored` periods.

        `steps`: period in step lengths; `level`: factor on the tone's amplitudes. The events are not returned.
        """
        states, row = self.state_samples(stored), np.maximum(np.arange(stored - periods, stored), -1)
        drive = np.full((1, periods + 1), level)
        self._propagate_segments(Segments(np.array([steps]), _EVERY_SEGMENT, drive, row), states, self._no_motion)
        self.log.counts[:2] = 0
        return states

    def accelerations(self, states: Array, table_indices: NDArray[np.int64]) -> Array:
        """Return the acceleration of every coordinate for rows of a `Trajectory` [m/s²], (coordinates, samples)."""
        if not len(states):
            return np.zeros((self.system.coordinates, 0))
        first = self.tables.size
        rows = np.zeros((len(states), self.state.z.size))
        rows[:, :first] = states[:, :first]
        # A view of the indices may have another memory layout.
        table_indices = np.ascontiguousarray(table_indices)
        self._store_accelerations(
            self.tables.flow, self.system.coordinates, rows, table_indices, self.workspace.derivative
        )
        return np.ascontiguousarray(rows[:, first : first + self.system.coordinates].T)

    def state_samples(self, samples: int) -> StateSamples:
        """Return new arrays for the states at a number of samples."""
        size, elements = self.state.z.shape[0], len(self.system.elements)
        return StateSamples(
            state=np.zeros((samples, size)),
            table_index=np.zeros(samples, dtype=np.int64),
            height=np.zeros((samples, elements)),
            contact=np.zeros((samples, elements), dtype=np.int8),
        )

    def _run(self, segments: Segments, states: StateSamples, motion: MotionSamples) -> Trajectory:
        """Propagate through segments, fill `states` and `motion`, and return the trajectory."""
        self._propagate_segments(segments, states, motion)
        return Trajectory(*states, *self._take_log())

    def _propagate_segments(self, segments: Segments, states: StateSamples, motion: MotionSamples) -> None:
        """Propagate through segments, and fill `states` and `motion`."""
        self._advance(segments, states, motion)
        self._check_divergence(segments, states, motion)
        # `steps` has one entry for all segments, or one for each.
        segments_per_entry = segments.row.size // segments.steps.size
        self._elapsed_s += float(segments.steps.sum()) * segments_per_entry * self.tables.step

    def _advance(
        self, segments: Segments, states: StateSamples, motion: MotionSamples, status: int = STATE_ONLY
    ) -> None:
        """Propagate through segments; compute missing tables and enlarge the log whenever the kernel returns for it."""
        segment, remaining = 0, -1.0
        # A drive of the caller may have another memory layout.
        segments = segments._replace(drive=np.ascontiguousarray(segments.drive))
        while True:
            reason, segment, remaining = self._propagate(
                self.tables.flow, self.tables.model, self.state, self.workspace, self.log, segments, segment, remaining,
                states, motion, status,
            )  # fmt: skip
            status = STATE_ONLY
            if reason == TABLES_MISSING:
                self._look_up_tables()
            elif reason == LOG_FULL:
                self._double_log()
            elif reason == STUCK:
                self._check_divergence(segments, states, motion)
                element = self.system.elements[self.log.events[self.log.counts[N_EVENTS] - 1].damper]
                raise RunError(
                    f"{element.name} separates and lands repeatedly at one instant, which contradicts "
                    "the contact law. Please report this as a bug and attach the scene."
                )
            else:
                return

    def _double_log(self) -> None:
        """Copy the log into arrays with twice the number of rows."""
        old = self.log
        self.log = empty_log(2 * len(old.events), self.tables.size, self.system.dampers)
        for source, target in zip(old, self.log, strict=True):
            target[: len(source)] = source

    def _check_divergence(self, segments: Segments, states: StateSamples, motion: MotionSamples) -> None:
        """Raise `RunError` with the time of the first diverged sample if the motion has diverged."""
        n = self.system.coordinates
        if np.abs(self.state.z[:n]).max() <= MAX_DISPLACEMENT_M:
            return
        displacement = self.state.z[:n]
        row, ends_s = segments.row, self._elapsed_s + segments.ends(self.tables.step)
        time = ends_s[-1]
        for samples in (states.state[:, :n], motion.rows[:n].T):
            stored = samples[row[row >= 0]] if len(samples) else samples
            diverged = np.flatnonzero(~(np.abs(stored) <= MAX_DISPLACEMENT_M).all(axis=1))
            if diverged.size:
                displacement, time = stored[diverged[0]], ends_s[row >= 0][diverged[0]]
        largest = int(np.argmax(np.where(np.isfinite(displacement), np.abs(displacement), np.inf)))
        points = self.system.points
        name = points[largest] if largest < len(points) else "a damper in its cavity"
        raise RunError(
            f"the motion diverges: the displacement of {name} is {abs(displacement[largest]):.3g} m at {time:.4g} s. "
            "Reduce the drive, or increase the damping if a mode of the structure with dampers and coil spring has "
            "negative damping."
        )

    def _look_up_tables(self) -> None:
        """Set the table index of the present configuration; compute its tables if they are missing."""
        self.state.counters[TABLE_INDEX] = self.tables.table_index(int(self.state.counters[CONFIGURATION]))

    def _take_log(self) -> tuple[Any, ...]:
        """Return the content of the log, and empty it."""
        log, (events, discontinuities, _) = self.log, self.log.counts.tolist()
        if not events and not discontinuities:
            return self._empty_log
        content = _copied_log(log, events, discontinuities, self.tables)
        log.counts[:2] = 0
        return content


def _copied_log(log: Log, events: int, discontinuities: int, tables: FlowTables) -> tuple[Any, ...]:
    """Copy the first events and discontinuities of a log, in the order of the fields of `Trajectory`."""
    # Fields of a record array are looked up in Python code, which takes a multiple of the time of a copy.
    event_rows, discontinuity_rows = np.asarray(log.events)[:events], np.asarray(log.discontinuities)[:discontinuities]
    return (
        *(event_rows[name].copy() for name in EVENT_FIELDS.names or ()),
        *(discontinuity_rows[name].copy() for name in DISCONTINUITY_FIELDS.names or ()),
        *(sides[:discontinuities, side].copy() for sides in (log.state, log.damper_velocity) for side in range(2)),
        *tables.table_indices(log.configuration[:discontinuities]).T,
    )


def step_for(span: float, max_rate: float) -> tuple[float, float]:
    """Return a step length that divides a time span and is short enough for the power series.

    `span`: s; `max_rate`: largest rate of system and drive (magnitude of a pole), rad/s. Returns the step length, s,
    and the number of steps in the span. Raises `RunError` if this number exceeds `MAX_STEPS`.
    """
    steps = max(1.0, float(np.ceil(span * max_rate / MAX_RATE_TIMES_STEP)))
    if not steps <= MAX_STEPS:
        raise RunError(
            f"the fastest mode or drive of the scene, {max_rate / (2.0 * np.pi):.3g} Hz, requires {steps:.2g} time "
            f"steps in {span:.3g} s (a sample interval or a drive period); the limit is {MAX_STEPS:.0e}. Choose larger "
            "masses, softer springs, or a higher sample rate or drive frequency."
        )
    return span / steps, steps


def sampled_propagator(system: HybridSystem, interval: float) -> tuple[Propagator, float]:
    """Return a propagator under a sampled drive, and the number of steps in a sample interval (`interval`, s)."""
    step, steps = step_for(interval, system.max_rate)
    return Propagator(system, first_order_hold(len(system.inputs), interval), step), steps


def tone_propagator(
    system: HybridSystem, amplitudes: NDArray[np.complex128], omega: float, interval: float | None = None
) -> tuple[Propagator, float]:
    """Return a propagator under a tone u(t) = Re(U e^{i omega t}), and the number of steps in a period or interval.

    `amplitudes`: U of each input; `omega`: rad/s; `interval`: time that the steps divide [s]; None: a period.
    """
    span = 2.0 * np.pi / omega if interval is None else interval
    step, steps = step_for(span, max(system.max_rate, omega))
    return Propagator(system, pure_tone(amplitudes, omega), step), steps
