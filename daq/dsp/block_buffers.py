"""Memory for blocks: a signal's latest past in front of its next block, and room that channels share."""

from __future__ import annotations

import numpy as np

from rig.arrays import Array
from rig.numerics.simd import LANES, aligned_zeros


class BlockBuffers:
    """Memory that channels share, one after another: separate memory would not stay in a processor's cache."""

    def __init__(self) -> None:
        self._rows = aligned_zeros(0, LANES)

    def rows(self, count: int) -> Array:
        """Return rows of the width of a register, at least `count` of them, with arbitrary content."""
        if len(self._rows) < count:
            self._rows = aligned_zeros(count, LANES)
        return self._rows


class History:
    """Stores the last samples of the previous block, at first zeros, in front of those of the next.

    >>> history = History(2)
    >>> for block in ([1.0, 2.0, 3.0], [4.0]):
    ...     history.place(len(block))[:] = block
    >>> history.samples[:3].tolist()
    [2.0, 3.0, 4.0]
    """

    def __init__(self, length: int) -> None:
        self._length, self._count = length, 0
        self.samples = np.zeros(length)

    def place(self, count: int) -> Array:
        """Return the place for the next block, shape (count,)."""
        past = self.samples[self._count : self._count + self._length]
        needed = self._length + count
        if self.samples.size < needed:
            self.samples = np.zeros(needed)
        self.samples[: self._length] = past
        self._count = count
        return self.samples[self._length : needed]
