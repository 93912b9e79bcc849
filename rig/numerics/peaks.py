"""Peaks of a sampled curve, as in `scipy.signal.find_peaks`, whose import takes longer than most analyses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array


def local_maxima(values: Array) -> NDArray[np.int64]:
    """Return the indices of the local maxima, without the ends; of equal neighbors, the middle one.

    >>> local_maxima(np.array([0.0, 2.0, 1.0, 3.0, 3.0, 3.0, 1.0])).tolist()
    [1, 4]
    """
    starts = np.concatenate([[0], np.flatnonzero(np.diff(values)) + 1])
    stops = np.append(starts[1:], len(values))
    levels = values[starts]
    inner = np.flatnonzero((levels[1:-1] > levels[:-2]) & (levels[1:-1] > levels[2:])) + 1
    return np.asarray((starts[inner] + stops[inner] - 1) // 2)


def distant_maxima(values: Array, distance: int) -> NDArray[np.int64]:
    """Return the local maxima that are at least `distance` apart; the higher of two close maxima is kept.

    >>> distant_maxima(np.array([0.0, 2.0, 1.0, 3.0, 1.0, 2.0, 1.0, 2.0, 1.0]), 3).tolist()
    [3, 7]
    """
    maxima = local_maxima(values)
    accepted = np.ones(maxima.size, dtype=bool)
    first = np.searchsorted(maxima, maxima - distance, side="right")
    stop = np.searchsorted(maxima, maxima + distance)
    for k in np.argsort(values[maxima])[::-1]:
        if accepted[k]:
            accepted[first[k] : stop[k]] = False
            accepted[k] = True
    return maxima[accepted]


def prominent_maxima(values: Array, prominence: float, height: float = -np.inf) -> NDArray[np.int64]:
    """Return the local maxima of at least some height that exceed the minima on both sides by `prominence`.

    Each minimum is the smallest value up to the next higher value.

    >>> prominent_maxima(np.array([0.0, 2.0, 1.0, 3.0, 0.5, 1.0, 0.0]), 1.0).tolist()
    [1, 3]
    """
    prominent = []
    for peak in local_maxima(values):
        if values[peak] >= height:
            higher = np.flatnonzero(values > values[peak])
            place = int(np.searchsorted(higher, peak))
            first = higher[place - 1] if place else 0
            stop = higher[place] if place < higher.size else len(values)
            base = max(values[first : peak + 1].min(), values[peak:stop].min())
            if values[peak] - base >= prominence:
                prominent.append(peak)
    return np.array(prominent, dtype=np.int64)
