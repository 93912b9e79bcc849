"""Steady-state motion under a sinusoidal drive: integration until the estimated distance from steady state is small.

At intervals, the state at the start of a period is compared with the states 1, 2, ... periods before. If the change r
over p periods decreases by the factor q in p periods, the distance from the steady state is r q / (1 - q). A motion is
steady when this distance is below the tolerance, relative to the motion. A motion that never repeats is irregular.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, expm1, log

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.engine.propagator import Propagator
from rig.core.engine.samples import StateSamples
from rig.core.engine.trajectory import Trajectory
from rig.core.laws.events import FLIGHT
from rig.core.numerics.jit import cached_njit

#: A repetition is detected up to this number of periods of the drive.
MAX_REPETITION = 8
#: Number of periods in a comparison, which must exceed four times the longest repetition.
COMPARED_PERIODS = 40
#: Maximum number of periods between two comparisons.
MAX_SKIPPED_PERIODS = 400
#: The motion is assumed to become periodic with a repetition if its change per repetition is below this multiple of the
#: tolerance.
SETTLING_TOLERANCES = 1e4
#: Relative changes below this value are rounding errors.
CHANGE_ROUNDING = 2e-14
#: Maximum number of multiplications in one call, about 0.1 s: interrupts are handled between calls.
MAX_WORK_PER_CALL = 1e8
#: Stored states per period, for first harmonic and peak.
INSTANTS_PER_PERIOD = 256


@dataclass(frozen=True)
class SteadyState:
    """A motion after the decay of its transient."""

    converged: bool
    repetition: int
    """Periods of the drive after which the motion repeats; 0 if it does not."""
    residual: float
    """Estimated distance from the steady state, relative to the motion; without repetition, the smallest change over 1
    to `MAX_REPETITION` periods."""
    periods: int
    """Number of periods integrated."""


def settle(
    propagator: Propagator,
    steps: float,
    level: float,
    tolerance: float,
    max_periods: int,
    is_stopped: Callable[[], bool] = lambda: False,
) -> SteadyState:
    """Integrate the motion from the start of a period until it is steady.

    `propagator`: propagator at the start of a period; `steps`: period of the drive in steps of the propagator; `level`:
    factor of the drive; `tolerance`: largest distance from the steady state, relative to the motion. `is_stopped` is
    called at intervals; `RunError` is raised if it returns true.
    """
    completed, state_scales = 0, _state_scales(propagator)
    while True:
        # A comparison costs as much as many periods of motion, so the intervals grow.
        skipped = min(completed // 4, MAX_SKIPPED_PERIODS)
        count = skipped + COMPARED_PERIODS
        comparison = _integrate(propagator, steps, level, skipped, is_stopped)
        completed += count
        changes, distances = _distances(comparison, state_scales)
        steady = np.flatnonzero(distances < tolerance)
        # A motion that settles to a short repetition is within the tolerance for a multiple of this repetition first.
        settling = np.flatnonzero(changes < SETTLING_TOLERANCES * tolerance)
        if len(steady) and steady[0] == settling[0]:
            return SteadyState(True, int(steady[0]) + 1, float(distances[steady[0]]), completed)
        if completed >= max_periods:
            return SteadyState(False, 0, float(changes.min()), completed)


def _integrate(
    propagator: Propagator, steps: float, level: float, skipped: int, is_stopped: Callable[[], bool]
) -> StateSamples:
    """Integrate the skipped periods and the compared periods, in calls short enough for interrupts."""
    max_count = max(1, int(MAX_WORK_PER_CALL / (steps * propagator.multiplications_per_step)))
    comparisons: list[StateSamples] = []
    for begin in range(0, skipped + COMPARED_PERIODS, max_count):
        if is_stopped():
            raise RunError("stopped, because another part of the frequency range failed. See the error of that part.")
        count = min(max_count, skipped + COMPARED_PERIODS - begin)
        compared = max(0, min(count, begin + count - skipped))
        comparisons.append(propagator.propagate_periods(steps, count, compared, level))
    if len(comparisons) == 1:
        return comparisons[0]
    return StateSamples(*(np.concatenate(field) for field in zip(*comparisons, strict=True)))


def _distances(comparison: StateSamples, state_scales: Array) -> tuple[Array, Array]:
    """Compare the motion with itself 1, 2, ... periods of the drive earlier.

    Returns two arrays of shape (MAX_REPETITION,): the relative change of the motion over each number of periods, and
    the estimated relative distance from the motion with this period to which it settles (inf: the change does not
    decrease).
    """
    heights = np.where(comparison.contact == FLIGHT, comparison.height, 0.0)
    vectors = np.concatenate([comparison.state[:, : state_scales.size] * state_scales, heights], axis=1)
    scale = max(float(np.abs(vectors).max()), 1e-300)
    changes, distances = [], []
    for p, (change, earlier_change) in enumerate((_changes(vectors, comparison.contact) / scale).tolist(), 1):
        changes.append(change)
        if change < CHANGE_ROUNDING:
            distances.append(change)
        elif not earlier_change > change:
            distances.append(np.inf)
        else:
            log_ratio = log(change / earlier_change) * p / (COMPARED_PERIODS // 2)
            # expm1 avoids the rounding of a ratio just below 1.
            distances.append(max(change, change * exp(log_ratio) / -expm1(log_ratio)))
    return np.array(changes), np.array(distances)


@cached_njit
def _changes(vectors: Array, contacts: NDArray[np.int8]) -> Array:
    """Compute changes over 1, 2, ... periods at the end and middle of a comparison; infinite if contacts differ.

    Returns shape (MAX_REPETITION, 2). The ratio of the changes at end and middle reveals a slow decay, which faster
    decays mask in the changes from period to period.
    """
    changes = np.zeros((MAX_REPETITION, 2))
    rows = vectors.shape[0]
    for p in range(1, MAX_REPETITION + 1):
        for position in range(2):
            end = rows - position * (COMPARED_PERIODS // 2)
            for row in range(end - p, end):
                for column in range(vectors.shape[1]):
                    change = abs(vectors[row, column] - vectors[row - p, column])
                    changes[p - 1, position] = max(changes[p - 1, position], change)
        for j in range(contacts.shape[1]):
            if contacts[rows - 1, j] != contacts[rows - 1 - p, j]:
                changes[p - 1] = np.inf
    return changes


def _state_scales(propagator: Propagator) -> Array:
    """Return scale factors of the states: displacements in m, velocities over the fastest rate; shape (states,)."""
    system, step = propagator.system, propagator.tables.step
    n, state_scales = system.coordinates, np.ones(system.states)
    state_scales[n : 2 * n] = step
    if system.states > 2 * n:
        # A coil current is scaled to the displacement of the armature that the force of the current causes in one step.
        force = np.abs(system.force_state[:, 2 * n :]).max(axis=0) / np.diag(system.mass).min()
        state_scales[2 * n :] = force * step**2
    return state_scales


def integrate_cycle(propagator: Propagator, steps: float, level: float, repetition: int) -> tuple[Trajectory, Array]:
    """Integrate one repetition of a steady-state motion; store the state at `INSTANTS_PER_PERIOD` instants per period.

    Returns the trajectory, and the initial state of each segment.
    """
    initial = propagator.state.z.copy()
    trajectory = sample_periods(propagator, steps, level, repetition)
    return trajectory, np.concatenate([initial[None], trajectory.state[:-1]])


def sample_periods(propagator: Propagator, steps: float, level: float, periods: int) -> Trajectory:
    """Integrate whole periods, with the state stored at the end of each of `INSTANTS_PER_PERIOD` intervals."""
    count = INSTANTS_PER_PERIOD * periods
    starts_period = np.arange(count) % INSTANTS_PER_PERIOD == 0
    return propagator.propagate_tone(
        np.full(count, steps / INSTANTS_PER_PERIOD), np.arange(count), starts_period, level
    )
