"""Skew: channels that are sampled one after another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daq.dsp.interpolation import JUMP, LENGTH, CubicInput, copy_into, empty_parts
from rig.arrays import Array
from rig.errors import SceneError
from rig.numerics.fma import fused
from rig.numerics.jit import unfused_kernel


def delays(skew: float | tuple[float, ...] | None, channels: int, rate: float) -> tuple[float, ...]:
    """Return the delay of each channel, s, relative to the clock tick at which the last channel is sampled.

    `skew` is the lateness in s of each channel relative to the previous one, or of every channel.

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
            f"converter.skew: the channels are sampled over {latest - min(lateness):g} s, a sample interval "
            f"({1.0 / rate:g} s) or more. Give a smaller skew."
        )
    return tuple(latest - each for each in lateness)


class Delay:
    """Shifts the input of a channel by part of a sample interval, block after block.

    Each interval of the result is the end of one interval and the beginning of the next, described by the same
    four numbers as any; integrated twice it is exact at the new nodes.
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self._joined = _joined(share)
        # The last interval as a whole, and its end in parts if it was broken.
        self._last = np.zeros(4)
        self._tail = np.zeros((0, 6))

    def shift(self, cubics: CubicInput) -> CubicInput:
        """Return the delayed input over the same number of intervals."""
        if cubics.smooth.size == 0:
            return cubics
        smooth = np.empty(cubics.smooth.shape)
        # A broken interval makes two: each of its parts is in one of them or cut in two, and each has a part
        # more.
        waiting = len(self._tail)
        room = waiting + 4 * cubics.broken.size + 4
        broken, parts = empty_parts(room)
        tail = np.zeros((room, 6))
        tail[:waiting] = self._tail
        count, waiting = _shift(
            cubics, self._share, self._joined, self._last, waiting, smooth, broken, parts, tail, np.empty(4)
        )
        self._tail = tail[:waiting]
        return CubicInput(smooth, broken[:count], parts[:count])


def _joined(share: float) -> Array:
    """Matrix from two intervals, as start, end, mean and moment, to the one that lies across both."""
    matrix = np.zeros((4, 8))
    head = 1.0 - share
    for column in range(4):
        unit, end, begin = np.eye(4)[column], np.empty(6), np.empty(6)
        _between(unit, head, 1.0, share, 0.0, end)
        _between(unit, 0.0, head, head, 0.0, begin)
        matrix[:, column] = (
            end[0], 0.0, share * end[2], share * (share * end[3] + head * end[2]),
        )  # fmt: skip
        matrix[:, 4 + column] = 0.0, begin[1], head * begin[2], head * head * begin[3]
    return matrix


@unfused_kernel
def _shift(
    cubics: CubicInput,
    share: float,
    joined: Array,
    last: Array,
    tail: int,
    smooth: Array,
    broken: NDArray[np.int64],
    parts: Array,
    ends: Array,
    full_cubic: Array,
) -> tuple[int, int]:
    """Fill in the delayed intervals; return the number of their parts and of those left over.

    `last` is the interval before, updated; if it was broken, its end is in the `tail` first parts of `ends`.
    """
    for r in range(4):
        _join(cubics.smooth, joined[r], last, smooth[r])
    count, at, i, intervals = 0, 0, 0, smooth.shape[1]
    head = 1.0 - share
    while i < intervals:
        if tail == 0:
            # Whole intervals after whole ones are joined already.
            broken_next = cubics.broken[at] if at < cubics.broken.size else intervals
            if broken_next > i:
                i = broken_next
                copy_into(cubics.smooth[:, i - 1], last)
                continue
        whole_now = at == cubics.broken.size or cubics.broken[at] != i
        # The end of the interval before.
        if tail == 0:
            broken[count] = i
            _between(last, head, 1.0, share, 0.0, parts[count])
            count += 1
        for k in range(tail):
            broken[count] = i
            copy_into(ends[k], parts[count])
            count += 1
        tail = 0
        # The beginning of this one; if it is broken, its end in parts for the next.
        copy_into(cubics.smooth[:, i], last)
        if whole_now:
            broken[count] = i
            _between(last, 0.0, head, head, 0.0, parts[count])
            count += 1
            i += 1
            continue
        elapsed = 0.0
        while at < cubics.broken.size and cubics.broken[at] == i:
            part = cubics.parts[at]
            size = part[LENGTH]
            if elapsed + size <= head and size > 0.0:
                broken[count] = i
                copy_into(part, parts[count])
                count += 1
            else:
                copy_into(part, full_cubic)
                before = max(head - elapsed, 0.0) if size > 0.0 else 0.0
                if before > 0.0:
                    broken[count] = i
                    _between(full_cubic, 0.0, before / size, before, 0.0, parts[count])
                    count += 1
                if size > 0.0:
                    _between(full_cubic, before / size, 1.0, size - before, part[JUMP], ends[tail])
                else:
                    copy_into(part, ends[tail])
                tail += 1
            elapsed += size
            at += 1
        if elapsed == 0.0:
            # The instant at which a run begins: before it there is rest, for as long as the delay.
            ends[0, :LENGTH] = 0.0
            ends[0, LENGTH] = share
            broken[count] = i
            parts[count][:] = 0.0
            count += 1
        i += 1
    return count, tail


@unfused_kernel
def _join(cubics: Array, weights: Array, last: Array, out: Array) -> None:
    """Join every interval with the previous interval as if both were whole; one quantity of the result."""
    start, end, mean, moment = cubics[0], cubics[1], cubics[2], cubics[3]
    out[0] = _weighted_sum(
        weights, last[0], last[1], last[2], last[3], start[0], end[0], mean[0], moment[0],
    )  # fmt: skip
    for i in range(1, out.size):
        out[i] = _weighted_sum(
            weights, start[i - 1], end[i - 1], mean[i - 1], moment[i - 1], start[i], end[i], mean[i], moment[i],
        )  # fmt: skip


@unfused_kernel
def _weighted_sum(
    weights: Array,
    a: float, b: float, c: float, d: float, e: float, f: float, g: float, h: float,
) -> float:  # fmt: skip
    """Weigh the four numbers of two intervals."""
    before = fused(weights[0], a, fused(weights[1], b, fused(weights[2], c, weights[3] * d)))
    return fused(weights[4], e, fused(weights[5], f, fused(weights[6], g, fused(weights[7], h, before))))


@unfused_kernel
def _between(full_cubic: Array, begin: float, end: float, length: float, jump: float, out: Array) -> None:
    """Describe the part of a cubic between two shares of its length, with a length and an impulse."""
    out[LENGTH], out[JUMP] = length, jump
    a, b, mean, moment = full_cubic[0], full_cubic[1], full_cubic[2], full_cubic[3]
    c1 = -9.0 * a + 3.0 * b - 24.0 * mean + 60.0 * moment
    c2 = 18.0 * a - 12.0 * b + 84.0 * mean - 180.0 * moment
    c3 = -10.0 * a + 10.0 * b - 60.0 * mean + 120.0 * moment
    out[0] = a + begin * (c1 + begin * (c2 + begin * c3))
    out[1] = a + end * (c1 + end * (c2 + end * c3))
    # Coefficients of the part in its own time, from 0 to 1.
    size = end - begin
    d1 = size * (c1 + begin * (2.0 * c2 + begin * 3.0 * c3))
    d2 = size * size * (c2 + begin * 3.0 * c3)
    d3 = size * size * size * c3
    out[2] = out[0] + d1 / 2.0 + d2 / 3.0 + d3 / 4.0
    out[3] = out[0] / 2.0 + d1 / 6.0 + d2 / 12.0 + d3 / 20.0
