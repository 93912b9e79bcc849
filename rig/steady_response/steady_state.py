"""Steady motion under a tone: the motion is followed until the period map's residual proves that it has decayed.

After every few periods the state at the start of a period is compared with the states 1, 2, ... periods before.
The residual r of a linear decay with ratio q per period leaves an error of r q / (1 - q); a motion counts as
steady when that is below the tolerance, relative to the motion. What never repeats is called irregular.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, expm1, log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.engine.propagator import Propagator
from rig.engine.state import FLIGHT
from rig.engine.trajectory import Array, Trajectory
from rig.errors import RunError
from rig.numerics.jit import stored

#: Longest repetition looked for, in periods of the drive.
LONGEST_REPETITION = 8
#: Periods that a look compares; more than four times the longest repetition.
LOOK = 40
#: Periods between two looks at most.
MOST_SKIPPED = 400
#: What lies within this many tolerances of a repetition is taken to be on its way there.
SETTLING = 1e4
#: Changes below this are rounding.
ROUNDING = 2e-14
#: Multiplications of one call: about a tenth of a second.
_HEARD = 1e8
#: States kept in one period for its first harmonic and its peak.
MARKS = 256


@dataclass(frozen=True)
class Steady:
    """A motion after its transient."""

    converged: bool
    repetition: int
    """Periods of the drive after which it repeats; 0 if it does not."""
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
    """Follow the motion from the start of a period until it is steady.

    Parameters
    ----------
    march : Propagator
        At the start of a period.
    steps : float
        Step lengths in a period.
    level : float
        Of the tone.
    tolerance : float
        Largest distance from the steady state, relative to the motion.
    longest : int
        Periods after which to give up.
    stopped : callable
        Asked now and then whether nobody wants the motion any more.

    Raises
    ------
    RunError
        If so.
    """
    done, units = 0, _units(propagator)
    while True:
        # Looking costs as much as many periods of motion: look at growing intervals.
        skipped = min(done // 4, MOST_SKIPPED)
        count = skipped + LOOK
        looked = _follow(propagator, steps, level, skipped, stopped)
        done += count
        changes, left = _distances(looked, units)
        steady = np.flatnonzero(left < tolerance)
        # A motion that has nearly settled to a shorter repetition passes for a longer one first.
        settling = np.flatnonzero(changes < SETTLING * tolerance)
        if len(steady) and steady[0] == settling[0]:
            return Steady(True, int(steady[0]) + 1, float(left[steady[0]]), done)
        if done >= longest:
            return Steady(False, 0, float(changes.min()), done)


class _Look(NamedTuple):
    """Motion at the ends of periods; shape (periods, ...)."""

    state: Array
    height: Array
    mode: NDArray[np.int8]


def _follow(
    propagator: Propagator, steps: float, level: float, skipped: int, stopped: Callable[[], bool]
) -> _Look:
    """Go on for some periods unseen and for a look, in calls short enough for an interrupt to be heard between them."""
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
    """Change over 1, 2, ... periods, and estimated distance from a motion that repeats so, relative to the motion."""
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
            # By expm1, because a ratio just below 1 rounds to 1.
            left.append(max(change, change * exp(fall) / -expm1(fall)))
    return np.array(present), np.array(left)


@stored
def _changes(vectors: Array, modes: NDArray[np.int8]) -> Array:
    """Largest change over 1, 2, ... periods at the end, and half a look before; infinite where contacts differ.

    The ratio of both reveals a slow decay, which faster decays hide from period to period.
    """
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
    """Give what makes the parts of a state comparable: metres, velocities over the fastest rate; shape (states,)."""
    system, step = propagator.system, propagator.tables.step
    n, units = system.coordinates, np.ones(system.states)
    units[n : 2 * n] = step
    if system.states > 2 * n:
        # The coil's current, as the armature's motion that its force makes over a step.
        force = np.abs(system.force_state[:, 2 * n :]).max(axis=0) / np.diag(system.mass).min()
        units[2 * n :] = force * step**2
    return units


def _vectors(look: _Look, units: Array) -> Array:
    """States at the starts of periods in comparable units, and heights of dampers in flight."""
    heights = np.where(look.mode == FLIGHT, look.height, 0.0)
    return np.concatenate([look.state[:, : units.size] * units, heights], axis=1)


def one_cycle(
    propagator: Propagator, steps: float, level: float, repetition: int
) -> tuple[Trajectory, Array]:
    """Follow one repetition of a steady motion with its states kept at `MARKS` instants of every period.

    Returns
    -------
    begins : float64 (segments, size)
        States at which the segments begin.
    """
    count = MARKS * repetition
    anew = np.zeros(count, dtype=bool)
    anew[::MARKS] = True
    first = propagator.state.z.copy()
    trajectory = propagator.through_marks(np.full(count, steps / MARKS), np.arange(count), anew, level)
    return trajectory, np.concatenate([first[None], trajectory.state[:-1]])
