"""The input of a channel between samples: acceleration as cubics joined at samples and breaks.

Over a piece, from one node (a sample or a break) to the next, acceleration is the cubic that agrees with the
motion in four ways: acceleration at both ends, change of velocity, change of displacement. Integrated twice
it meets the motion exactly at every node; in between its error falls with the fourth power of the piece. At a
break the jump of velocity is an impulse of acceleration. A force is straight lines between its samples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.numerics.jit import unfused_kernel
from rig.simulation.motion import Motion

# A piece shorter than this share of the sample interval is straight instead of cubic: the rounding of the
# displacement, divided by the square of its length, would otherwise be taken for a violent acceleration.
STRAIGHT = 1e-4


# Column of `CubicInput.parts` with the length of a part.
LENGTH = 4
# Column of `CubicInput.parts` with the impulse at the end of a part.
JUMP = 5


class CubicInput(NamedTuple):
    """Input over the sample intervals of a block; intervals with breaks are given in parts as well.

    Four numbers describe a piece: input at its start and at its end, its average, and its moment, the average of
    input times remaining share of the piece (1/2 for a constant 1).
    """

    smooth: Array  # these numbers for the interval that ends at each sample; (4, intervals)
    # Interval to which a part belongs, ascending; for these the numbers above mean nothing; int64; (parts,).
    broken: NDArray[np.int64]
    # The numbers of each part; its length as a share of the interval; the impulse at its end, divided by the sample
    # interval; (parts, 6).
    parts: Array


class MotionInterpolator:
    """Cuts the motion of the point in one row of `Motion` into pieces, block after block."""

    def __init__(self, row: int, rate: float) -> None:
        self._row = row
        self._rate = rate
        # Acceleration, velocity and displacement at the last sample, and room for those at a part's ends.
        self._last = np.zeros(3)
        self._ends = np.zeros(3), np.zeros(3)

    def cut(self, motion: Motion) -> CubicInput:
        """Return the pieces of the next block; before sample 0 is rest: an initial velocity is an impulse there."""
        row = self._row
        acceleration, velocity = motion.acceleration[row], motion.velocity[row]
        displacement = motion.displacement[row]
        smooth = np.empty((4, acceleration.size))
        if acceleration.size == 0:
            return CubicInput(smooth, *_WITHOUT_PARTS)
        if motion.first == 0:
            self._last[2] = displacement[0]
        # Each break ends a part and every broken interval has a last part more; a run begins with one.
        breaks = motion.break_sample.size
        broken, parts = empty_parts(2 * breaks + 1) if breaks or motion.first == 0 else _WITHOUT_PARTS
        count = 0
        if motion.first == 0:
            parts[0, JUMP] = velocity[0] * self._rate
            count = 1
        if breaks:
            count = _cut(
                motion.break_sample - motion.first,
                motion.break_offset,
                (motion.break_acceleration, motion.break_velocity, motion.break_displacement),
                self._row,
                (acceleration, velocity, displacement),
                self._last,
                1.0 / self._rate,
                count,
                broken,
                parts,
                self._ends,
            )
        _smooth(acceleration, velocity, displacement, self._last, self._rate, smooth)
        return CubicInput(smooth, broken[:count], parts[:count])


def empty_parts(count: int) -> tuple[NDArray[np.int64], Array]:
    """Make room for parts of broken intervals: the intervals, and the parts."""
    return np.zeros(count, np.int64), np.zeros((count, 6))


# Of a block without breaks; nothing is written into them.
_WITHOUT_PARTS = empty_parts(0)


class ForceInterpolator:
    """Cuts a force that is given by its samples into straight lines, block after block."""

    def __init__(self) -> None:
        self._last = 0.0
        self._fresh = True

    def cut(self, force: Array) -> CubicInput:
        """Return the pieces of the next block; force is zero before sample 0 and may jump there."""
        smooth = np.empty((4, force.size))
        if force.size == 0:
            return CubicInput(smooth, *_WITHOUT_PARTS)
        smooth[0, 0], smooth[0, 1:], smooth[1] = self._last, force[:-1], force
        smooth[2] = 0.5 * (smooth[0] + force)
        smooth[3] = smooth[0] / 3.0 + force / 6.0
        cubics = CubicInput(smooth, *(empty_parts(1) if self._fresh else _WITHOUT_PARTS))
        self._last, self._fresh = float(force[-1]), False
        return cubics


@unfused_kernel
def copy_into(values: Array, target: Array) -> None:
    """Copy the first values into an array; assigning to a slice would need memory."""
    for i in range(target.size):
        target[i] = values[i]


@unfused_kernel
def _smooth(acceleration: Array, velocity: Array, displacement: Array, last: Array, rate: float, smooth: Array) -> None:
    """Describe every interval as one piece; `last` holds the last sample, and is updated."""
    end = acceleration.size
    start, mean, moment = smooth[0], smooth[2], smooth[3]
    copy_into(acceleration, smooth[1])
    start[0] = last[0]
    mean[0] = (velocity[0] - last[1]) * rate
    moment[0] = ((displacement[0] - last[2]) * rate - last[1]) * rate
    # One quantity at a time, so that several samples are processed at once.
    for i in range(1, end):
        start[i] = acceleration[i - 1]
    for i in range(1, end):
        mean[i] = (velocity[i] - velocity[i - 1]) * rate
    for i in range(1, end):
        moment[i] = ((displacement[i] - displacement[i - 1]) * rate - velocity[i - 1]) * rate
    last[0], last[1], last[2] = acceleration[end - 1], velocity[end - 1], displacement[end - 1]


@unfused_kernel
def _cut(
    interval: NDArray[np.int64],
    offset: Array,
    at_break: tuple[Array, Array, Array],
    row: int,
    rows: tuple[Array, Array, Array],
    last: Array,
    h: float,
    count: int,
    broken: NDArray[np.int64],
    parts: Array,
    ends: tuple[Array, Array],
) -> int:
    """Fill in the parts of broken intervals; return their number.

    `at_break` are acceleration and velocity, before and after, and displacement of all points at the breaks;
    `rows` are those of the point at the samples, `last` at the sample before the block.
    """
    begin_state, end_state = ends
    acceleration, velocity, displacement = at_break
    elapsed = 0.0
    for b in range(interval.size):
        k = interval[b]
        if b == 0 or interval[b - 1] != k:
            if k == 0:
                copy_into(last, begin_state)
            else:
                _pick(rows, k - 1, begin_state)
            elapsed = 0.0
        end_state[0], end_state[1], end_state[2] = acceleration[0, row, b], velocity[0, row, b], displacement[row, b]
        reached = min(max(offset[b] / h, elapsed), 1.0)
        _part(begin_state, end_state, reached - elapsed, h, parts[count])
        broken[count] = k
        parts[count, JUMP] = (velocity[1, row, b] - velocity[0, row, b]) / h
        count += 1
        begin_state[0], begin_state[1], begin_state[2] = (
            acceleration[1, row, b],
            velocity[1, row, b],
            displacement[row, b],
        )
        elapsed = reached
        if b + 1 == interval.size or interval[b + 1] != k:
            _pick(rows, k, end_state)
            _part(begin_state, end_state, 1.0 - elapsed, h, parts[count])
            broken[count] = k
            count += 1
    return count


@unfused_kernel
def _pick(rows: tuple[Array, Array, Array], sample: int, out: Array) -> None:
    """Take acceleration, velocity and displacement at a sample."""
    out[0], out[1], out[2] = rows[0][sample], rows[1][sample], rows[2][sample]


@unfused_kernel
def _part(begin_state: Array, end_state: Array, share: float, h: float, out: Array) -> None:
    """Describe the input between two nodes, each given by acceleration, velocity and displacement; no impulse."""
    out[0], out[1], out[LENGTH], out[JUMP] = begin_state[0], end_state[0], share, 0.0
    if share == 0.0:
        out[2], out[3] = 0.0, 0.0
        return
    t = share * h
    out[2] = (end_state[1] - begin_state[1]) / t
    if share < STRAIGHT:
        out[3] = (begin_state[0] - end_state[0]) / 12.0 + 0.5 * out[2]
    else:
        out[3] = ((end_state[2] - begin_state[2]) / t - begin_state[1]) / t
