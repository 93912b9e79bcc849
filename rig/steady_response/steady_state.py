"""Steady motion under a sinusoidal drive: integration until the residual of the period map is small enough.

At intervals, the state at the start of a period is compared with the states 1, 2, ... periods before. For a linear
decay with ratio q per period, the residual r corresponds to an error of r q / (1 - q). A motion is steady when this
error is below the tolerance, relative to the motion. A motion that never repeats is irregular.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, expm1, log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.engine.propagator import Propagator
from rig.engine.state import FLIGHT
from rig.engine.trajectory import Trajectory
from rig.errors import RunError
from rig.numerics.jit import stored

#: Longest repetition that is detected, in periods of the drive.
LONGEST_REPETITION = 8
#: Periods in a comparison; more than four times the longest repetition.
LOOK = 40
#: Largest number of periods between two comparisons.
MOST_SKIPPED = 400
#: A motion within this many tolerances of a repetition is assumed to converge to it.
SETTLING = 1e4
#: Relative changes below this value are rounding errors.
ROUNDING = 2e-14
#: Multiplications in one call, about 0.1 s, so that interrupts are handled between calls.
_HEARD = 1e8
#: Stored states per period, for first harmonic and peak.
MARKS = 256


@dataclass(frozen=True)
class Steady:
    """A motion after the decay of its transient."""

    converged: bool
    repetition: int
    """Periods of the drive after which the motion repeats; 0 if it does not."""
    residual: float
    """Estimated distance from the steady state, relative to the motion."""
    periods: int  # Periods that were followed


def settle(
    propagator: Propagator,
    steps: float,
    level: float,
    tolerance: float,
    longest: int,
    stopped: Callable[[], bool] = lambda: False,
) -> Steady:
    """Integrate the motion from the start of a period until it is steady.

    `march`: propagator at the start of a period; `steps`: period of the drive in step lengths; `level`: level of the
    drive; `tolerance`: largest distance from the steady state, relative to the motion; `longest`: largest number of
    periods; `stopped`: called at intervals; returns whether to stop. Raises `RunError` if `stopped` returns true.
    """
    done, units = 0, _units(propagator)
    while True:
        # A comparison costs as much as many periods of motion, so the intervals grow.
        skipped = min(done // 4, MOST_SKIPPED)
        count = skipped + LOOK
        looked = _follow(propagator, steps, level, skipped, stopped)
        done += count
        changes, left = _distances(looked, units)
        steady = np.flatnonzero(left < tolerance)
        # Before it settles to a short repetition, a motion first satisfies the tolerance for a longer repetition.
        settling = np.flatnonzero(changes < SETTLING * tolerance)
        if len(steady) and steady[0] == settling[0]:
            return Steady(True, int(steady[0]) + 1, float(left[steady[0]]), done)
        if done >= longest:
            return Steady(False, 0, float(changes.min()), done)


class _Look(NamedTuple):
    """States at the ends of periods; shape (periods, ...)."""

    state: Array
    height: Array
    mode: NDArray[np.int8]


def _follow(
    propagator: Propagator, steps: float, level: float, skipped: int, stopped: Callable[[], bool]
) -> _Look:
    """Integrate the skipped periods and those of a comparison, in calls short enough for interrupts."""
    at_once = max(1, int(_HEARD / (steps * propagator.work)))
    seen: list[_Look] = []
    for begin in range(0, skipped + LOOK, at_once):
        if stopped():
            raise RunError("stopped")
        count = min(at_once, skipped + LOOK - begin)
        rows = np.maximum(np.arange(count) + min(begin - skipped, 0), -1)
        found = propagator.through_marks(np.full(count, steps), rows, np.ones(count, dtype=bool), level)
        seen.append(_Look(found.state, found.height, found.mode))
    return _Look(*(np.concatenate(parts) for parts in zip(*seen, strict=True)))


def _distances(look: _Look, units: Array) -> tuple[Array, Array]:
    """Compute relative changes over 1, 2, ... periods, and estimated distances from motions with that repetition."""
    vectors = _vectors(look, units)
    scale = max(float(np.abs(vectors).max()), 1e-300)
    present, left = [], []
    for p, (change, earlier) in enumerate((_changes(vectors, look.mode) / scale).tolist(), 1):
        present.append(change)
        if change < ROUNDING:
            left.append(change)
        elif not earlier > change:
            left.append(np.inf)
        else:
            fall = log(change / earlier) * p / (LOOK // 2)
            # expm1 avoids the rounding of a ratio just below 1.
            left.append(max(change, change * exp(fall) / -expm1(fall)))
    return np.array(present), np.array(left)


@stored
def _changes(vectors: Array, modes: NDArray[np.int8]) -> Array:
    """Compute changes over 1, 2, ... periods at the end and middle of a comparison; infinite if contacts differ."""
    # The ratio of both identifies a slow decay, which faster decays mask from period to period.
    changes = np.zeros((LONGEST_REPETITION, 2))
    rows = vectors.shape[0]
    for p in range(1, LONGEST_REPETITION + 1):
        for when in range(2):
            end = rows - when * (LOOK // 2)
            for row in range(end - p, end):
                for column in range(vectors.shape[1]):
                    change = abs(vectors[row, column] - vectors[row - p, column])
                    changes[p - 1, when] = max(changes[p - 1, when], change)
        for j in range(modes.shape[1]):
            if modes[rows - 1, j] != modes[rows - 1 - p, j]:
                changes[p - 1] = np.inf
    return changes


def _units(propagator: Propagator) -> Array:
    """Return scale factors of the states: displacements in m, velocities over the fastest rate; shape (states,)."""
    system, step = propagator.system, propagator.tables.step
    n, units = system.coordinates, np.ones(system.states)
    units[n : 2 * n] = step
    if system.states > 2 * n:
        # The coil current is scaled as the displacement of the armature caused by its force over a step.
        force = np.abs(system.force_state[:, 2 * n :]).max(axis=0) / np.diag(system.mass).min()
        units[2 * n :] = force * step**2
    return units


def _vectors(look: _Look, units: Array) -> Array:
    """Return scaled states at the starts of periods, and heights of dampers in flight."""
    heights = np.where(look.mode == FLIGHT, look.height, 0.0)
    return np.concatenate([look.state[:, : units.size] * units, heights], axis=1)


def one_cycle(
    propagator: Propagator, steps: float, level: float, repetition: int
) -> tuple[Trajectory, Array]:
    """Integrate one repetition of a steady motion, with states stored at `MARKS` instants per period.

    Returns `begins`, initial states of the segments.
    """
    count = MARKS * repetition
    anew = np.zeros(count, dtype=bool)
    anew[::MARKS] = True
    first = propagator.state.z.copy()
    trajectory = propagator.through_marks(np.full(count, steps / MARKS), np.arange(count), anew, level)
    return trajectory, np.concatenate([first[None], trajectory.state[:-1]])
