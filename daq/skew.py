"""Sampling instants that are not the clock's: channels sampled one after another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daq.pieces import Pieces, no_parts, put
from rig.errors import SceneError
from rig.fused import fused
from rig.jit import unfused

Array = NDArray[np.float64]


def delays(skew: float | tuple[float, ...] | None, channels: int, rate: float) -> tuple[float, ...]:
    """Turn lateness of sampling into delay of what is sampled.

    A sample bears the time of the clock tick at which its last channel is sampled; all other channels read
    what was there earlier.

    Parameters
    ----------
    skew : float, tuple of float or None
        Lateness of each channel relative to the one before, or of every channel, s.
    channels : int
        Number of channels.
    rate : float
        Sample rate, Hz.

    Returns
    -------
    tuple of float
        Delay of each channel, s.

    Raises
    ------
    SceneError
        If not all channels are sampled within one sample interval.

    Examples
    --------
    >>> delays(1e-6, 3, 5120.0)
    (2e-06, 1e-06, 0.0)
    """
    if skew is None:
        return (0.0,) * channels
    late = skew if isinstance(skew, tuple) else tuple(k * skew for k in range(channels))
    if len(late) != channels:
        raise SceneError(f"converter.skew: got {len(late)} values; expected {channels}, one for each channel")
    latest = max(late)
    if latest - min(late) >= 1.0 / rate:
        raise SceneError(
            f"converter.skew: the channels are sampled over {latest - min(late):g} s; expected less than one "
            f"sample interval, {1.0 / rate:g} s"
        )
    return tuple(latest - each for each in late)


class Delay:
    """Shifts the input of a channel by part of a sample interval, block after block.

    Each interval of the result is the end of one interval and the beginning of the next, described by the
    same four numbers as any; integrated twice it is exact at the new nodes.

    Parameters
    ----------
    share : float
        Delay as a share of the sample interval, in (0, 1).
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self._joined = _joined(share)
        # The last interval as a whole, and its end in parts if it was broken: number of parts, then length,
        # part and jump of each.
        self._last = np.zeros(4)
        self._tail = 0
        self._tail_length, self._tail_part, self._tail_jump = np.zeros(0), np.zeros((0, 4)), np.zeros(0)

    def shift(self, pieces: Pieces) -> Pieces:
        """Give the delayed input over the same number of intervals."""
        intervals, parts = pieces.start.size, pieces.broken.size
        if intervals == 0:
            return pieces
        smooth = np.empty((4, intervals))
        # A broken interval makes two: each of its parts is in one of them or cut in two, and each has a part
        # more.
        room = self._tail + 4 * parts + 4
        broken, length, part, jump = no_parts(room)
        _, tail_length, tail_part, tail_jump = no_parts(room)
        tail_length[: self._tail] = self._tail_length
        tail_part[: self._tail], tail_jump[: self._tail] = self._tail_part, self._tail_jump
        count, tail = _shift(
            pieces, self._share, self._joined, self._last, self._tail, smooth,
            broken, length, part, jump, tail_length, tail_part, tail_jump, np.empty(4),
        )  # fmt: skip
        self._tail = tail
        self._tail_length, self._tail_jump = tail_length[:tail].copy(), tail_jump[:tail].copy()
        self._tail_part = tail_part[:tail].copy()
        return Pieces(
            smooth[0],
            smooth[1],
            smooth[2],
            smooth[3],
            broken[:count],
            length[:count],
            part[:count],
            jump[:count],
        )


def _joined(share: float) -> Array:
    """Matrix from two intervals, as start, end, mean and moment, to the one that lies across both."""
    matrix = np.zeros((4, 8))
    head = 1.0 - share
    for column in range(4):
        unit, end, begin = np.eye(4)[column], np.empty(4), np.empty(4)
        _between(unit, head, 1.0, end)
        _between(unit, 0.0, head, begin)
        matrix[:, column] = (
            end[0], 0.0, share * end[2], share * (share * end[3] + head * end[2]),
        )  # fmt: skip
        matrix[:, 4 + column] = 0.0, begin[1], head * begin[2], head * head * begin[3]
    return matrix


@unfused
def _shift(
    pieces: Pieces,
    share: float,
    joined: Array,
    last: Array,
    tail: int,
    smooth: Array,
    broken: NDArray[np.int64],
    length: Array,
    part: Array,
    jump: Array,
    tail_length: Array,
    tail_part: Array,
    tail_jump: Array,
    whole: Array,
) -> tuple[int, int]:
    """Fill in the delayed intervals; give the number of their parts and of those left over.

    `last` is the interval before, and is kept up to date; if it was broken, its end is in the `tail` first
    parts.
    """
    for r in range(4):
        _join(pieces, joined[r], last, smooth[r])
    count, at, i = 0, 0, 0
    head = 1.0 - share
    while i < pieces.start.size:
        if tail == 0:
            # Whole intervals after whole ones are joined already.
            broken_next = pieces.broken[at] if at < pieces.broken.size else pieces.start.size
            if broken_next > i:
                i = broken_next
                _take(pieces, i - 1, last)
                continue
        whole_now = at == pieces.broken.size or pieces.broken[at] != i
        # The end of the interval before.
        if tail == 0:
            broken[count], length[count], jump[count] = i, share, 0.0
            _between(last, head, 1.0, part[count])
            count += 1
        for k in range(tail):
            broken[count], length[count], jump[count] = i, tail_length[k], tail_jump[k]
            put(tail_part[k], part[count])
            count += 1
        tail = 0
        # The beginning of this one; if it is broken, its end in parts for the next.
        _take(pieces, i, last)
        if whole_now:
            broken[count], length[count], jump[count] = i, head, 0.0
            _between(last, 0.0, head, part[count])
            count += 1
            i += 1
            continue
        done = 0.0
        while at < pieces.broken.size and pieces.broken[at] == i:
            size = pieces.length[at]
            put(pieces.part[at], whole)
            if done + size <= head and size > 0.0:
                broken[count], length[count], jump[count] = i, size, pieces.jump[at]
                put(whole, part[count])
                count += 1
            else:
                before = max(head - done, 0.0) if size > 0.0 else 0.0
                if before > 0.0:
                    broken[count], length[count], jump[count] = i, before, 0.0
                    _between(whole, 0.0, before / size, part[count])
                    count += 1
                tail_length[tail], tail_jump[tail] = size - before, pieces.jump[at]
                if size > 0.0:
                    _between(whole, before / size, 1.0, tail_part[tail])
                else:
                    put(whole, tail_part[tail])
                tail += 1
            done += size
            at += 1
        if done == 0.0:
            # The instant at which a run begins: before it there is rest, for as long as the delay.
            tail_length[0] = share
            tail_part[0][:] = 0.0
            broken[count], length[count], jump[count] = i, 0.0, 0.0
            part[count][:] = 0.0
            count += 1
        i += 1
    return count, tail


@unfused
def _take(pieces: Pieces, interval: int, out: Array) -> None:
    """Take the four numbers of an interval."""
    out[0], out[1] = pieces.start[interval], pieces.end[interval]
    out[2], out[3] = pieces.mean[interval], pieces.moment[interval]


@unfused
def _join(pieces: Pieces, weights: Array, last: Array, out: Array) -> None:
    """Join every interval with the one before as if both were whole; one number of the result."""
    start, end, mean, moment = pieces.start, pieces.end, pieces.mean, pieces.moment
    out[0] = _joined_up(
        weights, last[0], last[1], last[2], last[3], start[0], end[0], mean[0], moment[0],
    )  # fmt: skip
    for i in range(1, out.size):
        out[i] = _joined_up(
            weights, start[i - 1], end[i - 1], mean[i - 1], moment[i - 1], start[i], end[i], mean[i], moment[i],
        )  # fmt: skip


@unfused
def _joined_up(
    weights: Array,
    a: float, b: float, c: float, d: float, e: float, f: float, g: float, h: float,
) -> float:  # fmt: skip
    """Weigh the four numbers of two intervals."""
    before = fused(weights[0], a, fused(weights[1], b, fused(weights[2], c, weights[3] * d)))
    return fused(weights[4], e, fused(weights[5], f, fused(weights[6], g, fused(weights[7], h, before))))


@unfused
def _between(whole: Array, begin: float, end: float, out: Array) -> None:
    """Describe the part of a cubic between two shares of its length."""
    a, b, mean, moment = whole[0], whole[1], whole[2], whole[3]
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
