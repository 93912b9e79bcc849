"""A system in motion: the kernel's state, its log, and the two ways to drive it through time.

Sampled drive: one segment for each sample interval, the drive exact inside (first-order hold). Pure tone:
segments between marks; a mark is a sample instant, or the start of a period, where the drive's phase is set
exactly again, so that a million periods keep it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.engine.flow_tables import REACH, tables_for
from rig.engine.kernel import DONE, LOG_FULL, NEED_TABLE, STUCK, advance
from rig.engine.power_series import STALE, UNSETTLED, differentiate
from rig.engine.samples import MotionSamples, StateSamples, keep_state, show_motion
from rig.engine.screening import fold_envelope
from rig.engine.state import CONFIGURATION, SLOT, empty_log, state_at_rest
from rig.engine.trajectory import Trajectory
from rig.engine.workspace import Workspace, workspace_for
from rig.errors import RunError, SceneError
from rig.numerics.bernstein import LENGTH as TERMS
from rig.numerics.jit import compiled
from rig.numerics.simd import LANES, padded, zeros
from rig.scene.quantities import LENGTH
from rig.system.hybrid_system import Drive, HybridSystem, sampled, tone

LOG_ROWS = 1024
# Steps in a sample interval or a period; a processor takes some seconds for as many.
MOST_STEPS = 1e7
#: Every segment begins with the drive set again.
EVERY = np.ones(1, dtype=bool)
#: The row of the only segment.
_FIRST = np.zeros(1, dtype=np.int64)
# A segment in which no time passes.
_NO_TIME, _NEVER, _NOWHERE = np.zeros(1), np.zeros(1, dtype=bool), np.full(1, -1)


class Segments(NamedTuple):
    """A way through time between the columns of a drive.

    steps, renew: length in step lengths, and whether the segment begins with the drive and its change over the
    segment as drive states; one entry, or one for each segment. drive (inputs, segments + 1). row (segments,): where
    the motion at the end of each goes, or -1.
    """

    steps: Array
    renew: NDArray[np.bool_]
    drive: Array
    row: NDArray[np.int64]

    def ends(self, step: float) -> Array:
        """Time after the start at the end of each, s."""
        ends: Array = np.cumsum(np.broadcast_to(self.steps, self.row.shape)) * step
        return ends


@compiled
def _propagate(
    flow: Any, model: Any, state: Any, workspace: Any, log: Any, way: Segments, begin: int, left: float,
    kept: StateSamples, seen: MotionSamples, known: int,
) -> tuple[int, int, float]:  # fmt: skip
    """Propagate through segments, filling the rows (columns) of what is kept (seen).

    Returns early, with the segment and the steps left in it (negative: not begun), if the kernel needs something.
    """
    steps, renew, drive, row = way
    inputs, segments = drive.shape[0], drive.shape[1] - 1
    first = flow.rates_constant.shape[1] - 2 * inputs
    stride = 1 if steps.shape[0] > 1 else 0
    fold_envelope(flow, workspace)
    for k in range(begin, segments):
        whole, shown = steps[stride * k], row[k] >= 0
        if left < 0.0:
            left = whole
            if renew[stride * k]:
                for i in range(inputs):
                    state.z[first + i] = drive[i, k]
                    state.z[first + inputs + i] = drive[i, k + 1] - drive[i, k]
        status, left, known = advance(flow, model, state, workspace, log, k, whole, left, known, shown)
        if status != DONE:
            return status, k, left
        if state.counters[SLOT] < 0:
            return NEED_TABLE, k, 0.0
        if shown:
            if kept.slot.shape[0] > 0:
                keep_state(state, row[k], kept)
            if seen.rows.shape[1] > 0:
                show_motion(flow, model, state, seen, row[k], k == segments - 1)
        left = -1.0
    return DONE, segments, -1.0


@compiled
def _accelerations(flow: Any, model: Any, states: Array, slots: NDArray[np.int64], work: Array) -> None:
    for k in range(states.shape[0]):
        differentiate(flow, model, slots[k], states[k], work, STALE)


#: Bodies farther from rest than this have run away, m: no length in a scene is larger.
FARTHEST = LENGTH.most


class Propagator:
    """A system on its way through time.

    `step`: step length in seconds; `step_for` finds one.
    """

    def __init__(self, system: HybridSystem, drive: Drive, step: float) -> None:
        if system.grains.any():
            number = system.damper_number[system.grains][0]
            raise SceneError(
                f"dampers[{number}] is a bed of grains, which only rig simulate, rig grains and daq "
                "record can simulate. Remove its grains: to treat the bed as one mass."
            )
        self.system, self.drive = system, drive
        self.tables = tables_for(system, drive, step)
        dampers, size = system.dampers, padded(self.tables.size + 2 * system.coordinates)
        self.state = state_at_rest(size, dampers)
        self.log = empty_log(max(LOG_ROWS, 16 * dampers), size, dampers)
        self.workspace: Workspace = workspace_for(self.tables.flow, size)
        self.state.counters[CONFIGURATION] = system.at_rest
        self._window = zeros(LANES, padded(3 * system.coordinates + dampers))
        self._unseen, self._unkept = self.motion_samples(0), self.room(0)
        self._no_drive = np.zeros((len(system.inputs), 2))
        self._elapsed = 0.0
        self._find_table()

    @property
    def ambiguous(self) -> int:
        """Number of decisions that lay within rounding so far."""
        return int(self.state.counters[3])

    @property
    def work(self) -> int:
        """Count the multiplications of a step, about."""
        flow = self.tables.flow
        return self.tables.size**2 if flow.stepping else flow.column.size * TERMS

    def place(self, state: Array, drive: Array) -> NDArray[np.int64]:
        """Put the system at a state with every damper on its floor; dampers whose contact would pull lift off.

        Returns dampers (from 0) that lifted off at once.
        """
        self.state.z[: self.system.states] = state
        self.state.z[self.system.states : self.tables.size] = drive
        self._go(Segments(_NO_TIME, _NEVER, self._no_drive, _NOWHERE), self._unkept, self._unseen, UNSETTLED)
        lifted = self.log.damper[: self.log.filled[0]].copy()
        self.log.filled[:] = 0
        self._find_table()
        return lifted

    def snapshot(self) -> tuple[Array, ...]:
        """Copy of the whole state of motion, for `resume`."""
        return tuple(part.copy() for part in self.state)

    def resume(self, snapshot: tuple[Array, ...]) -> None:
        """Go on from a state of motion of this system, perhaps under another drive."""
        for part, kept in zip(self.state, snapshot, strict=True):
            part[...] = kept
        self._find_table()

    def start_period(self, level: float) -> None:
        """Set the tone to the start of a period."""
        self.state.z[self.system.states : self.tables.size] = (level, 0.0)

    def present(self) -> Trajectory:
        """Present state as a course of one sample in which nothing happened."""
        return Trajectory(
            self.state.z[None].copy(),
            self.state.counters[SLOT : SLOT + 1].copy(),
            self.state.height[None].copy(),
            self.state.mode[None].astype(np.int8),
            *self._page(),
        )

    def through_samples(self, drive: Array, interval_steps: float) -> Trajectory:
        """Run through the sample intervals between the columns of a sampled drive (inputs, samples + 1)."""
        intervals = drive.shape[1] - 1
        way = Segments(np.array([interval_steps]), EVERY, drive, np.arange(intervals))
        return self._run(way, self.room(intervals), self._unseen)

    def through_interval(self, drive: Array, interval_steps: Array, kept: StateSamples) -> Trajectory | None:
        """Run through one sample interval, as one of very many: what may be made once is given.

        `kept`: of one sample, for the state at the end; see `room`. Returns None if nothing happened.
        """
        self._go(Segments(interval_steps, EVERY, drive, _FIRST), kept, self._unseen)
        self._elapsed += float(interval_steps[0]) * self.tables.step
        return Trajectory(*kept, *self._page()) if self.log.filled[:2].any() else None

    def sample_motion(
        self, drive: Array, interval_steps: float, seen: MotionSamples, column: int
    ) -> Trajectory:
        """Do the same, but instead of keeping states fill what is seen, from a column on."""
        seen.begin[0] = column
        rows = np.arange(column, column + drive.shape[1] - 1)
        return self._run(Segments(np.array([interval_steps]), EVERY, drive, rows), self._unkept, seen)

    def motion_samples(self, samples: int) -> MotionSamples:
        """Room for what is seen at a number of samples."""
        return MotionSamples(
            rows=np.empty((self._window.shape[1], samples)),
            contact=np.empty((self.system.dampers, samples), dtype=np.int8),
            begin=np.zeros(1, dtype=np.int64),
            window=self._window,
        )

    def parts(self, seen: MotionSamples) -> tuple[Array, Array, Array, Array]:
        """Displacements, velocities and accelerations (points, samples) and gaps (dampers, samples) in it."""
        n, points, rows = self.system.coordinates, len(self.system.points), seen.rows
        displacement, velocity, acceleration = (rows[k * n : k * n + points] for k in range(3))
        return displacement, velocity, acceleration, rows[3 * n : 3 * n + self.system.dampers]

    def sample_present(self, seen: MotionSamples, column: int) -> None:
        """Fill one column of what is seen with the present motion."""
        seen.begin[0] = column
        self._go(Segments(_NO_TIME, _NEVER, self._no_drive, np.array([column])), self._unkept, seen)

    def through_marks(
        self,
        steps: Array,
        sample_row: NDArray[np.int64],
        new_period: NDArray[np.bool_],
        level: float = 1.0,
    ) -> Trajectory:
        """Run through segments of given lengths under a tone.

        `steps`: lengths in step lengths; `sample_row`: row in which to keep the state at the end of the segment, or
        -1; `new_period`: whether the segment begins with a period of the drive; `level`: times the amplitudes of the
        tone.
        """
        # The tone's states (cos, sin) begin a period as a drive that does not change would.
        drive = np.full((1, len(steps) + 1), level)
        kept = self.room(int(sample_row.max(initial=-1)) + 1)
        return self._run(Segments(steps, new_period, drive, sample_row), kept, self._unseen)

    def accelerations(self, states: Array, slots: NDArray[np.int64]) -> Array:
        """Acceleration of every coordinate for rows of a `Trajectory`, shape (coordinates, samples)."""
        if not len(states):
            return np.zeros((self.system.coordinates, 0))
        _accelerations(self.tables.flow, self.tables.model, states, slots, self.workspace.derivative)
        behind = self.tables.size
        return np.ascontiguousarray(states[:, behind : behind + self.system.coordinates].T)

    def room(self, samples: int) -> StateSamples:
        """Room for the states at a number of samples."""
        size, dampers = self.state.z.shape[0], self.system.dampers
        return StateSamples(
            state=np.zeros((samples, size)),
            slot=np.zeros(samples, dtype=np.int64),
            height=np.zeros((samples, dampers)),
            mode=np.zeros((samples, dampers), dtype=np.int8),
        )

    def _run(self, way: Segments, kept: StateSamples, seen: MotionSamples) -> Trajectory:
        self._go(way, kept, seen)
        self._need_bounded(way, kept, seen)
        self._elapsed += float(way.steps.sum()) * (way.row.size // way.steps.size) * self.tables.step
        return Trajectory(*kept, *self._page())

    def _go(self, way: Segments, kept: StateSamples, seen: MotionSamples, known: int = STALE) -> None:
        begin, left = 0, -1.0
        while True:
            status, begin, left = _propagate(
                self.tables.flow, self.tables.model, self.state, self.workspace, self.log, way, begin, left,
                kept, seen, known,
            )  # fmt: skip
            known = STALE
            if status == NEED_TABLE:
                self._find_table()
            elif status == LOG_FULL:
                self._double_log()
            elif status == STUCK:
                self._need_bounded(way, kept, seen)
                damper = self.system.damper_number[self.log.damper[self.log.filled[0] - 1]]
                raise RunError(
                    f"damper {damper} separates and lands repeatedly at one instant, which contradicts "
                    "the contact law. Report this with the scene."
                )
            else:
                return

    def _double_log(self) -> None:
        full = self.log
        self.log = empty_log(2 * len(full.segment), self.state.z.size, self.system.dampers)
        for before, after in zip(full, self.log, strict=True):
            after[: len(before)] = before

    def _need_bounded(self, way: Segments, kept: StateSamples, seen: MotionSamples) -> None:
        """Refuse a motion that has run away, saying where it was first seen to."""
        n = self.system.coordinates
        if np.abs(self.state.z[:n]).max() <= FARTHEST:
            return
        far = self.state.z[:n]
        row, ends = way.row, self._elapsed + way.ends(self.tables.step)
        time = ends[-1]
        for samples in (kept.state[:, :n], seen.rows[:n].T):
            shown = samples[row[row >= 0]] if len(samples) else samples
            away = np.flatnonzero(~(np.abs(shown) <= FARTHEST).all(axis=1))
            if away.size:
                far, time = shown[away[0]], ends[row >= 0][away[0]]
        q = int(np.argmax(np.where(np.isfinite(far), np.abs(far), np.inf)))
        name = self.system.points[q] if q < len(self.system.points) else "a damper in its cavity"
        raise RunError(
            f"the motion diverges: {name} is {abs(far[q]):.3g} m away from rest {time:.4g} s after the "
            "start. Check for negative damping, with riding dampers or with the coil spring attached, "
            "and for a drive that is too large."
        )

    def _find_table(self) -> None:
        self.state.counters[SLOT] = self.tables.slot(int(self.state.counters[CONFIGURATION]))

    def _page(self) -> tuple[Any, ...]:
        """Take what the log holds and empty it."""
        log, (events, breaks, _) = self.log, self.log.filled
        page = (
            *(part[:events].copy() for part in (log.segment, log.offset, log.damper, log.kind, log.closing)),
            *(part[:breaks].copy() for part in (log.break_segment, log.break_offset, log.before, log.after)),
            *(part[:breaks].copy() for part in (log.speed_before, log.speed_after)),
            *self.tables.slots_of(log.configuration[:breaks]).T,
        )
        log.filled[:2] = 0
        return page


def step_for(span: float, fastest: float) -> tuple[float, float]:
    """Step length that divides a time span and stays within reach of the series; (step, steps in the span)."""
    steps = max(1.0, float(np.ceil(span * fastest / REACH)))
    if not steps <= MOST_STEPS:
        raise RunError(
            f"the fastest motion of the scene, {fastest / (2.0 * np.pi):.3g} Hz, needs {steps:.2g} "
            f"steps in {span:.3g} s (a sample interval or a period); the limit is {MOST_STEPS:.0e}. "
            "Choose larger masses, softer springs, or a higher rate or frequency."
        )
    return span / steps, steps


def sampled_propagator(system: HybridSystem, interval: float) -> tuple[Propagator, float]:
    """March under a sampled drive, and the number of steps in a sample interval."""
    step, steps = step_for(interval, system.fastest)
    return Propagator(system, sampled(len(system.inputs), interval), step), steps


def tone_propagator(
    system: HybridSystem, amplitudes: NDArray[np.complex128], omega: float, interval: float | None = None
) -> tuple[Propagator, float]:
    """March under a tone u(t) = Re(U e^{i omega t}), and the number of steps in a period, or in a shorter interval."""
    span = 2.0 * np.pi / omega if interval is None else interval
    step, steps = step_for(span, max(system.fastest, omega))
    return Propagator(system, tone(amplitudes, omega), step), steps
