"""Interpolation of the motion and the force at a sensor between samples, as cubic segments.

The simulation gives the motion at nodes: at the samples, and at discontinuities. A discontinuity is an instant between
samples at which velocity or acceleration jumps. A segment extends from a node to the next node. Over a segment,
acceleration is the cubic that matches four given values: acceleration at both ends, change of velocity, change of
displacement. The second integral of the cubic is therefore exact at every node. Between nodes, its error falls with the
fourth power of the segment's length. A jump of velocity at a discontinuity is an impulse of acceleration. A force is
interpolated linearly between its samples.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.numerics.jit import unfused_kernel
from rig.core.simulation.motion import Motion

# A segment shorter than this fraction of the sample interval is a parabola that ignores the change of displacement,
# because the division by the square of the segment's length would amplify the rounding error of the displacement.
MIN_CUBIC_FRACTION = 1e-4

# Column of `CubicInput.segments` with the length of a segment.
LENGTH = 4
# Column of `CubicInput.segments` with the impulse at the end of a segment.
IMPULSE = 5


class CubicInput(NamedTuple):
    """Input over the sample intervals of a block.

    Four numbers describe a cubic: its values at the start and at the end, its mean, and its *moment*: its double
    integral over the square of the segment's length (1/2 for a constant 1). An interval without discontinuities is
    one segment.
    """

    # Start, end, mean and moment of each interval; undefined for intervals with discontinuities; (4, intervals).
    interval_cubics: Array
    # Intervals with discontinuities: index of the interval of each segment, ascending; (segments,).
    segment_interval: NDArray[np.int64]
    # For each segment: start, end, mean and moment; length as a fraction of the interval; impulse at the end divided by
    # the sample interval; (segments, 6).
    segments: Array


class MotionInterpolator:
    """Interpolates the motion of points (rows of `Motion`), block after block; `rate`: samples per second."""

    def __init__(self, rows: Sequence[int], rate: float) -> None:
        self._rows = np.array(rows, dtype=np.int64)
        self._rate = rate
        # Acceleration, velocity and displacement: of each point at the last sample, and at both ends of a segment.
        self._last = np.zeros((len(rows), 3))
        self._segment_ends = np.zeros(3), np.zeros(3)

    def interpolate(self, motion: Motion) -> list[CubicInput]:
        """Return the cubics of the next block for each point.

        The points are at rest before sample 0. A velocity at sample 0 is therefore an impulse of acceleration there.
        """
        points, samples = self._rows.size, motion.displacement.shape[1]
        interval_cubics = np.empty((points, 4, samples))
        if not samples:
            return [CubicInput(cubics, *_NO_SEGMENTS) for cubics in interval_cubics]
        # An interval with n discontinuities has n + 1 segments. The impulse at sample 0 is the end of a segment of
        # length 0.
        max_segments = 2 * motion.discontinuity_sample.size + (motion.first == 0)
        segment_interval, segments = np.zeros(max_segments, np.int64), np.zeros((points, max_segments, 6))
        count = _describe_motion(
            self._rows,
            motion.first == 0,
            # Contiguous, so that the compiler vectorizes the loops over samples.
            (
                np.ascontiguousarray(motion.acceleration),
                np.ascontiguousarray(motion.velocity),
                np.ascontiguousarray(motion.displacement),
            ),
            motion.discontinuity_sample - motion.first,
            motion.discontinuity_offset,
            (motion.discontinuity_acceleration, motion.discontinuity_velocity, motion.discontinuity_displacement),
            self._last,
            self._rate,
            interval_cubics,
            segment_interval,
            segments,
            self._segment_ends,
        )
        return [
            CubicInput(interval_cubics[point], segment_interval[:count], segments[point, :count])
            for point in range(points)
        ]


def allocate_segments(count: int) -> tuple[NDArray[np.int64], Array]:
    """Return `CubicInput.segment_interval` and `CubicInput.segments` of `count` segments, filled with zeros."""
    return np.zeros(count, np.int64), np.zeros((count, 6))


# Segments of a block without discontinuities; nothing is written into them.
_NO_SEGMENTS = allocate_segments(0)


class ForceInterpolator:
    """Interpolates a force linearly between its samples, block after block."""

    def __init__(self) -> None:
        self._last = 0.0
        self._is_first_block = True

    def interpolate(self, force: Array) -> CubicInput:
        """Return the straight lines of the next block as cubics; the force is 0 before sample 0, where it may jump."""
        interval_cubics = np.empty((4, force.size))
        if force.size == 0:
            return CubicInput(interval_cubics, *_NO_SEGMENTS)
        interval_cubics[0, 0], interval_cubics[0, 1:], interval_cubics[1] = self._last, force[:-1], force
        interval_cubics[2] = 0.5 * (interval_cubics[0] + force)
        interval_cubics[3] = interval_cubics[0] / 3.0 + force / 6.0
        # A segment of length 0 and value 0 replaces interval 0, so that the force jumps at sample 0 and does not rise.
        segments = allocate_segments(1) if self._is_first_block else _NO_SEGMENTS
        self._last, self._is_first_block = float(force[-1]), False
        return CubicInput(interval_cubics, *segments)


class SpringForceInterpolator:
    """Interpolates the force of a spring, block after block, by cubics with its exact values and slopes at the nodes.

    `weights`: force per displacement of each point of the motion [N/m]; `rate`: samples per second.
    """

    def __init__(self, weights: Array, rate: float) -> None:
        self._weights = weights
        self._rate = rate
        self._last = np.zeros(2)  # force, and its slope over a sample interval, at the last sample

    def interpolate(self, motion: Motion) -> CubicInput:
        """Return the cubics of the next block; the force is 0 before sample 0, where it may jump."""
        h, weights = 1.0 / self._rate, self._weights
        nodes = np.stack([weights @ motion.displacement, weights @ motion.velocity * h])
        count = nodes.shape[1]
        if not count:
            return CubicInput(np.empty((4, 0)), *_NO_SEGMENTS)
        before = np.concatenate([self._last[:, None], nodes[:, :-1]], axis=1)
        interval_cubics = _hermite_cubics(before, nodes, np.ones(count))
        self._last = nodes[:, -1]
        # A segment of length 0 and value 0 replaces interval 0, so that the force jumps at sample 0 and does not rise.
        start = allocate_segments(int(motion.first == 0))
        intervals = motion.discontinuity_sample - motion.first
        if not intervals.size:
            return CubicInput(interval_cubics, *start)
        # Segments from the start of an interval over its discontinuities to its end; the slope jumps at a
        # discontinuity.
        forces = weights @ motion.discontinuity_displacement
        slopes = (weights @ motion.discontinuity_velocity) * h
        is_first = np.append(True, np.diff(intervals) > 0)
        is_last = np.append(is_first[1:], True)
        position = np.clip(motion.discontinuity_offset / h, 0.0, 1.0)
        segment_interval = np.repeat(intervals, 1 + is_last)
        # Index of the segment that ends at each discontinuity.
        ends_at = np.arange(intervals.size) + np.concatenate([[0], np.cumsum(is_last)[:-1]])
        begin, end = np.empty((2, segment_interval.size)), np.empty((2, segment_interval.size))
        begin_position, end_position = np.zeros(segment_interval.size), np.ones(segment_interval.size)
        end[:, ends_at], end_position[ends_at] = np.stack([forces, slopes[0]]), position
        begin[:, ends_at + 1], begin_position[ends_at + 1] = np.stack([forces, slopes[1]]), position
        begin[:, ends_at[is_first]], begin_position[ends_at[is_first]] = before[:, intervals[is_first]], 0.0
        end[:, ends_at[is_last] + 1] = nodes[:, intervals[is_last]]
        lengths = np.maximum(end_position - begin_position, 0.0)
        cubics = _hermite_cubics(begin, end, lengths)
        segments = np.column_stack([cubics.T, lengths, np.zeros(lengths.size)])
        return CubicInput(
            interval_cubics, np.concatenate([start[0], segment_interval]), np.concatenate([start[1], segments])
        )


def _hermite_cubics(begin: Array, end: Array, lengths: Array) -> Array:
    """Return start, end, mean and moment of the cubics with given values and slopes at both ends, (4, segments).

    `begin`, `end`: value, and slope over a sample interval, (2, segments); `lengths`: in sample intervals.
    """
    (start, start_slope), (stop, stop_slope) = begin, end
    mean = (start + stop) / 2.0 + lengths * (start_slope - stop_slope) / 12.0
    moment = (21.0 * start + 9.0 * stop + lengths * (3.0 * start_slope - 2.0 * stop_slope)) / 60.0
    return np.stack([start, stop, mean, moment])


def cubic_coefficients(start: Any, end: Any, mean: Any, moment: Any) -> tuple[Any, Any, Any]:
    """Return the coefficients of t, t^2 and t^3 of a cubic over a segment, t from 0 to 1.

    The constant term is `start`.
    """
    return (
        -9.0 * start + 3.0 * end - 24.0 * mean + 60.0 * moment,
        18.0 * start - 12.0 * end + 84.0 * mean - 180.0 * moment,
        -10.0 * start + 10.0 * end - 60.0 * mean + 120.0 * moment,
    )


def parabola_moment(start: Any, end: Any, mean: Any) -> Any:
    """Return the moment of the parabola with given ends and mean."""
    return (start - end) / 12.0 + 0.5 * mean


#: The same functions, compiled for use in other compiled functions.
cubic_coefficients_kernel = unfused_kernel(cubic_coefficients)
_parabola_moment = unfused_kernel(parabola_moment)


@unfused_kernel
def copy_into(values: Array, target: Array) -> None:
    """Copy the first `target.size` values into `target`; assignment to a slice would allocate memory."""
    for i in range(target.size):
        target[i] = values[i]


@unfused_kernel
def _describe_motion(
    rows: NDArray[np.int64],
    is_start: bool,
    at_samples: tuple[Array, Array, Array],  # acceleration, velocity and displacement, (points, samples)
    discontinuity_interval: NDArray[np.int64],
    discontinuity_offset: Array,
    at_discontinuities: tuple[Array, Array, Array],
    last: Array,
    rate: float,
    interval_cubics: Array,
    segment_interval: NDArray[np.int64],
    segments: Array,
    segment_ends: tuple[Array, Array],
) -> int:
    """Fill in the cubics of the points `rows`, and return the number of segments, which is the same for all points.

    `is_start`: whether the block begins with sample 0. The first dimension of `last`, `interval_cubics` and `segments`
    are the points; for the other arguments see `_describe_intervals` and `_describe_segments`.
    """
    acceleration, velocity, displacement = at_samples
    count = 0
    for p in range(rows.size):
        row = rows[p]
        if is_start:
            last[p, 2] = displacement[row, 0]
            segments[p, 0, IMPULSE] = velocity[row, 0] * rate
        of_point = acceleration[row], velocity[row], displacement[row]
        count = _describe_segments(
            discontinuity_interval, discontinuity_offset, at_discontinuities, row, of_point, last[p], 1.0 / rate,
            int(is_start), segment_interval, segments[p], segment_ends,
        )  # fmt: skip
        _describe_intervals(of_point, last[p], rate, interval_cubics[p])
    return count


@unfused_kernel
def _describe_intervals(
    at_samples: tuple[Array, Array, Array], last: Array, rate: float, interval_cubics: Array
) -> None:
    """Fill in `interval_cubics` as if no interval had discontinuities; then copy the block's last sample to `last`.

    `at_samples`: acceleration, velocity and displacement of the point; `last`: their values at the sample before the
    block.
    """
    acceleration, velocity, displacement = at_samples
    end = acceleration.size
    start, mean, moment = interval_cubics[0], interval_cubics[2], interval_cubics[3]
    copy_into(acceleration, interval_cubics[1])
    start[0] = last[0]
    mean[0] = (velocity[0] - last[1]) * rate
    moment[0] = ((displacement[0] - last[2]) * rate - last[1]) * rate
    # One quantity in each loop, so that the compiler vectorizes the loop.
    for i in range(1, end):
        start[i] = acceleration[i - 1]
    for i in range(1, end):
        mean[i] = (velocity[i] - velocity[i - 1]) * rate
    for i in range(1, end):
        moment[i] = ((displacement[i] - displacement[i - 1]) * rate - velocity[i - 1]) * rate
    last[0], last[1], last[2] = acceleration[end - 1], velocity[end - 1], displacement[end - 1]


@unfused_kernel
def _describe_segments(
    discontinuity_interval: NDArray[np.int64],
    discontinuity_offset: Array,  # s, from the start of the interval
    at_discontinuities: tuple[Array, Array, Array],  # acceleration and velocity (before/after, points, n); displacement
    row: int,
    at_samples: tuple[Array, Array, Array],  # acceleration, velocity and displacement of the point
    last: Array,  # acceleration, velocity and displacement of the point at the sample before the block
    h: float,  # sample interval [s]
    count: int,
    segment_interval: NDArray[np.int64],
    segments: Array,
    segment_ends: tuple[Array, Array],
) -> int:
    """Append the segments of intervals with discontinuities to the first `count` segments; return the new number.

    `segment_interval`, `segments`: as in `CubicInput`; `segment_ends`: working arrays.
    """
    begin_state, end_state = segment_ends
    acceleration, velocity, displacement = at_discontinuities
    elapsed = 0.0
    for b in range(discontinuity_interval.size):
        k = discontinuity_interval[b]
        if b == 0 or discontinuity_interval[b - 1] != k:
            if k == 0:
                copy_into(last, begin_state)
            else:
                _copy_sample(at_samples, k - 1, begin_state)
            elapsed = 0.0
        end_state[0], end_state[1], end_state[2] = acceleration[0, row, b], velocity[0, row, b], displacement[row, b]
        fraction_at_discontinuity = min(max(discontinuity_offset[b] / h, elapsed), 1.0)
        _describe_segment(begin_state, end_state, fraction_at_discontinuity - elapsed, h, segments[count])
        segment_interval[count] = k
        segments[count, IMPULSE] = (velocity[1, row, b] - velocity[0, row, b]) / h
        count += 1
        begin_state[0], begin_state[1], begin_state[2] = (
            acceleration[1, row, b],
            velocity[1, row, b],
            displacement[row, b],
        )
        elapsed = fraction_at_discontinuity
        if b + 1 == discontinuity_interval.size or discontinuity_interval[b + 1] != k:
            _copy_sample(at_samples, k, end_state)
            _describe_segment(begin_state, end_state, 1.0 - elapsed, h, segments[count])
            segment_interval[count] = k
            count += 1
    return count


@unfused_kernel
def _copy_sample(at_samples: tuple[Array, Array, Array], sample: int, out: Array) -> None:
    """Copy acceleration, velocity and displacement at a sample."""
    out[0], out[1], out[2] = at_samples[0][sample], at_samples[1][sample], at_samples[2][sample]


@unfused_kernel
def _describe_segment(begin_state: Array, end_state: Array, fraction: float, h: float, out: Array) -> None:
    """Fill in the segment between two nodes, without an impulse.

    `begin_state`, `end_state`: acceleration, velocity and displacement; `fraction`: length, in sample intervals `h`.
    """
    out[0], out[1], out[LENGTH], out[IMPULSE] = begin_state[0], end_state[0], fraction, 0.0
    if fraction == 0.0:
        out[2], out[3] = 0.0, 0.0
        return
    t = fraction * h
    out[2] = (end_state[1] - begin_state[1]) / t
    if fraction < MIN_CUBIC_FRACTION:
        out[3] = _parabola_moment(begin_state[0], end_state[0], out[2])
    else:
        out[3] = ((end_state[2] - begin_state[2]) / t - begin_state[1]) / t
