"""Runs: intervals of consecutive samples whose flag is set."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array


def runs_of(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the intervals [first, stop) in which flags are set.

    >>> runs_of(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def merge_spans(spans: Iterable[tuple[int, int]], pause: int = 0) -> list[tuple[int, int]]:
    """Merge intervals [first, stop) that overlap, or whose distance is at most `pause`; return them in ascending order.

    >>> merge_spans([(5, 7), (0, 2), (2, 3)])
    [(0, 3), (5, 7)]
    """
    merged: list[tuple[int, int]] = []
    for first, stop in sorted(spans):
        if merged and first <= merged[-1][1] + pause:
            merged[-1] = merged[-1][0], max(merged[-1][1], stop)
        else:
            merged.append((first, stop))
    return merged


def ranges_of(values: Array, flags: NDArray[np.bool_], per_gap: int = 0) -> list[tuple[float, float]]:
    """Return the ranges of ascending values whose flag is set; a range ends halfway to the next value.

    `per_gap`: ranges are joined if at most 1 / `per_gap` of all values lies between them; 0: never.

    >>> ranges_of(np.arange(5.0), np.array([False, True, True, False, True]))
    [(0.5, 2.5), (3.5, 4.0)]
    """
    middles = np.concatenate([values[:1], (values[1:] + values[:-1]) / 2.0, values[-1:]]).tolist()
    runs = merge_spans(runs_of(flags), values.size // per_gap if per_gap else 0)
    return [(middles[start], middles[stop]) for start, stop in runs]
