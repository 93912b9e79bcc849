"""Skew of a multiplexed converter, which samples its channels one after another: delay of each channel's input.

A discontinuity is an instant between samples at which an impact changes the velocity abruptly.
"""

import numpy as np
from numpy.typing import NDArray

from daq.core.dsp.interpolation import (
    IMPULSE,
    LENGTH,
    CubicInput,
    allocate_segments,
    copy_into,
    cubic_coefficients_kernel,
)
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.numerics.fma import fused
from rig.core.numerics.jit import unfused_kernel


def delays(skew: float | tuple[float, ...] | None, channels: int, rate: float) -> tuple[float, ...]:
    """Return the delay of each channel, s, relative to the clock tick at which the last channel is sampled.

    `skew`: time from the sampling of a channel to the sampling of the next [s]; or the sampling time of each channel
    [s]. Sampling a channel earlier by a time equals delaying its input by this time and sampling it with the last
    channel.

    >>> delays(1e-6, 3, 5120.0)
    (2e-06, 1e-06, 0.0)
    """
    if skew is None:
        return (0.0,) * channels
    lateness = skew if isinstance(skew, tuple) else tuple(k * skew for k in range(channels))
    if len(lateness) != channels:
        raise SceneError(f"converter.skew: got {len(lateness)} values; expected {channels}, one for each channel.")
    latest = max(lateness)
    if latest - min(lateness) >= 1.0 / rate:
        raise SceneError(
            f"converter.skew: the channels are sampled up to {latest - min(lateness):g} s apart; expected less than "
            f"the sample interval, {1.0 / rate:g} s. Give a smaller skew."
        )
    return tuple(latest - channel_lateness for channel_lateness in lateness)


class Delay:
    """Delays the input of a channel by a fraction (`tail_length`) of a sample interval, block after block.

    Delayed interval i consists of the tail of input interval i - 1 and the head of input interval i. It is described by
    one cubic (see `CubicInput`), whose second integral is exact at the delayed sampling instants. If one of the two
    input intervals has discontinuities, segments describe the delayed interval.
    """

    def __init__(self, tail_length: float) -> None:
        self._tail_length = tail_length
        self._matrix = _delay_matrix(tail_length)
        # The cubic of the previous input interval, and the segments of its tail if the interval has discontinuities.
        self._previous_cubic = np.zeros(4)
        self._tail = np.zeros((0, 6))

    def shift(self, cubics: CubicInput) -> CubicInput:
        """Return the delayed input over the same number of intervals."""
        if cubics.interval_cubics.size == 0:
            return cubics
        delayed_cubics = np.empty(cubics.interval_cubics.shape)
        # An input interval with discontinuities affects two delayed intervals. The delay shifts each of its segments
        # into one of the two, or splits it between them. Each also contains a segment of an adjacent input interval.
        tail_size = len(self._tail)
        max_segments = tail_size + 4 * cubics.segment_interval.size + 4
        segment_interval, segments = allocate_segments(max_segments)
        tail = np.zeros((max_segments, 6))
        tail[:tail_size] = self._tail
        count, tail_size = _shift(
            cubics,
            self._tail_length,
            self._matrix,
            self._previous_cubic,
            tail,
            tail_size,
            delayed_cubics,
            segment_interval,
            segments,
            np.empty(4),
        )
        self._tail = tail[:tail_size]
        return CubicInput(delayed_cubics, segment_interval[:count], segments[:count])


def _delay_matrix(tail_length: float) -> Array:
    """Return the matrix from the cubics of two successive intervals to the cubic of the delayed interval; (4, 8).

    A cubic is described by four numbers: start, end, mean and moment (`CubicInput`).
    """
    matrix = np.zeros((4, 8))
    head_length = 1.0 - tail_length
    for column in range(4):
        unit, tail, head = np.eye(4)[column], np.empty(6), np.empty(6)
        _split(unit, head_length, 1.0, tail_length, 0.0, tail)
        _split(unit, 0.0, head_length, head_length, 0.0, head)
        matrix[:, column] = (
            tail[0], 0.0, tail_length * tail[2], tail_length * (tail_length * tail[3] + head_length * tail[2]),
        )  # fmt: skip
        matrix[:, 4 + column] = 0.0, head[1], head_length * head[2], head_length * head_length * head[3]
    return matrix


@unfused_kernel
def _shift(
    cubics: CubicInput,
    tail_length: float,
    matrix: Array,
    previous: Array,
    tail: Array,
    tail_size: int,
    delayed_cubics: Array,
    segment_interval: NDArray[np.int64],
    segments: Array,
    cubic: Array,
) -> tuple[int, int]:
    """Fill in the delayed intervals; return the number of their segments, and of segments in the last tail.

    `previous`: cubic of the previous input interval, updated; `tail`: if that interval has discontinuities, the first
    `tail_size` rows are the segments of its tail, updated; `cubic`: working array.
    """
    for r in range(4):
        _combine(cubics.interval_cubics, matrix[r], previous, delayed_cubics[r])
    count, segment, i, intervals = 0, 0, 0, delayed_cubics.shape[1]
    head_length = 1.0 - tail_length
    while i < intervals:
        if tail_size == 0:
            # Two successive intervals without discontinuities were combined above.
            next_with_discontinuities = (
                cubics.segment_interval[segment] if segment < cubics.segment_interval.size else intervals
            )
            if next_with_discontinuities > i:
                i = next_with_discontinuities
                copy_into(cubics.interval_cubics[:, i - 1], previous)
                continue
        has_discontinuities = segment < cubics.segment_interval.size and cubics.segment_interval[segment] == i
        # Tail of the previous input interval.
        if tail_size == 0:
            segment_interval[count] = i
            _split(previous, head_length, 1.0, tail_length, 0.0, segments[count])
            count += 1
        for k in range(tail_size):
            segment_interval[count] = i
            copy_into(tail[k], segments[count])
            count += 1
        tail_size = 0
        # Head of this input interval. If it has discontinuities, the segments of its tail are stored for the next.
        copy_into(cubics.interval_cubics[:, i], previous)
        if not has_discontinuities:
            segment_interval[count] = i
            _split(previous, 0.0, head_length, head_length, 0.0, segments[count])
            count += 1
            i += 1
            continue
        elapsed = 0.0
        while segment < cubics.segment_interval.size and cubics.segment_interval[segment] == i:
            row = cubics.segments[segment]
            length = row[LENGTH]
            if elapsed + length <= head_length and length > 0.0:
                segment_interval[count] = i
                copy_into(row, segments[count])
                count += 1
            else:
                copy_into(row, cubic)
                # Length of the part in the head.
                in_head = max(head_length - elapsed, 0.0) if length > 0.0 else 0.0
                if in_head > 0.0:
                    segment_interval[count] = i
                    _split(cubic, 0.0, in_head / length, in_head, 0.0, segments[count])
                    count += 1
                if length > 0.0:
                    _split(cubic, in_head / length, 1.0, length - in_head, row[IMPULSE], tail[tail_size])
                else:
                    copy_into(row, tail[tail_size])
                tail_size += 1
            elapsed += length
            segment += 1
        if elapsed == 0.0:
            # A segment of length 0 identifies sample 0, at which a run begins; before it, the input is zero.
            tail[0, :LENGTH] = 0.0
            tail[0, LENGTH] = tail_length
            segment_interval[count] = i
            segments[count][:] = 0.0
            count += 1
        i += 1
    return count, tail_size


@unfused_kernel
def _combine(cubics: Array, weights: Array, previous: Array, out: Array) -> None:
    """Fill in start, end, mean or moment of each delayed interval, as if no interval had discontinuities.

    `weights`: a row of the matrix, (8,); `previous`: cubic of the interval before the block, (4,).
    """
    start, end, mean, moment = cubics[0], cubics[1], cubics[2], cubics[3]
    out[0] = _weighted_sum(
        weights, previous[0], previous[1], previous[2], previous[3], start[0], end[0], mean[0], moment[0],
    )  # fmt: skip
    for i in range(1, out.size):
        out[i] = _weighted_sum(
            weights, start[i - 1], end[i - 1], mean[i - 1], moment[i - 1], start[i], end[i], mean[i], moment[i],
        )  # fmt: skip


@unfused_kernel
def _weighted_sum(
    weights: Array,
    start0: float, end0: float, mean0: float, moment0: float,
    start1: float, end1: float, mean1: float, moment1: float,
) -> float:  # fmt: skip
    """Return the weighted sum of start, end, mean and moment of two intervals."""
    total = fused(weights[0], start0, fused(weights[1], end0, fused(weights[2], mean0, weights[3] * moment0)))
    total = fused(weights[6], mean1, fused(weights[7], moment1, total))
    return fused(weights[4], start1, fused(weights[5], end1, total))


@unfused_kernel
def _split(cubic: Array, begin: float, end: float, length: float, impulse: float, out: Array) -> None:
    """Fill in a segment: the part of a cubic from `begin` to `end`, as fractions of its length.

    `length`: length of the segment, as a fraction of the sample interval; `impulse`: at its end.
    """
    out[LENGTH], out[IMPULSE] = length, impulse
    a, b, mean, moment = cubic[0], cubic[1], cubic[2], cubic[3]
    c1, c2, c3 = cubic_coefficients_kernel(a, b, mean, moment)
    out[0] = a + begin * (c1 + begin * (c2 + begin * c3))
    out[1] = a + end * (c1 + end * (c2 + end * c3))
    # Coefficients of the powers of the segment's own time, from 0 to 1.
    part = end - begin
    d1 = part * (c1 + begin * (2.0 * c2 + begin * 3.0 * c3))
    d2 = part * part * (c2 + begin * 3.0 * c3)
    d3 = part * part * part * c3
    out[2] = out[0] + d1 / 2.0 + d2 / 3.0 + d3 / 4.0
    out[3] = out[0] / 2.0 + d1 / 6.0 + d2 / 12.0 + d3 / 20.0
