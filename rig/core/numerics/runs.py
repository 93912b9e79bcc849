"""Runs: intervals of consecutive samples whose flag is set."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray


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
