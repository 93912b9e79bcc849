"""Settling time of the sensors at the beginning of a test; their drift would look like a force."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from analysis.recordings.slices import read_slices
from analysis.responses.clean_stretches import SETTLING, Flaw
from rig.arrays import Array

if TYPE_CHECKING:
    from daq.recording.recording import Recording


# Blocks of the second half that determine the scatter of means after settling, and the fewest blocks for a result.
_LATER, _FEWEST = 32, 16
# A block belongs to a drift if its mean deviates by more than this number of standard deviations of later blocks. The
# drift has ended after this number of successive blocks without such a deviation.
_OFF, _IN_A_ROW = 5.0, 3


def settling(rec: Recording, names: Sequence[str], first: int, stop: int, lowest: float) -> list[Flaw]:
    """Find the beginning of a test in which a channel's bias has not settled.

    The mean of the motion over a period of the lowest excited frequency is zero, so a mean that differs from later
    means is an error of the sensor. In a response channel the local fit includes it as a transient; in a reference
    channel it is an apparent force.

    `first`, `stop`: samples between which the test ran; `lowest`: Hz.
    """
    size = int(np.ceil(rec.rate / lowest))
    count = (stop - first) // size
    if count < _FEWEST:
        return []
    blocks = [(first + k * size, first + (k + 1) * size) for k in range(count)]
    chosen = np.unique(np.linspace(count // 2, count - 1, _LATER).astype(int))
    means = [_means(block) for block in read_slices(rec, names, [blocks[k] for k in chosen])]
    # A channel without any valid sample has no result; the masked array avoids numpy's warning.
    later = np.ma.masked_invalid(means)
    middle, scatter = later.mean(axis=0).filled(np.nan), later.std(axis=0).filled(np.nan)
    ends, calm = np.zeros(len(names), dtype=int), np.zeros(len(names), dtype=int)
    ended = np.zeros(len(names), dtype=bool)
    for number, block in enumerate(read_slices(rec, names, blocks[: count // 2]), 1):
        off = abs(_means(block) - middle) > _OFF * scatter
        ends = np.where(off & ~ended, number, ends)
        calm = np.where(off, 0, calm + 1)
        ended |= calm >= _IN_A_ROW
        if ended.all():
            break
    return [
        Flaw(first, first + int(end) * size, name, SETTLING)
        for name, end in zip(names, ends, strict=True)
        if end
    ]


def _means(block: Array) -> Array:
    return np.array([np.nanmean(row) if np.isfinite(row).any() else np.nan for row in block])
