"""Arrays for blocks of samples: a working array that all channels share, and an overlap with the previous block."""

import numpy as np

from rig.core.base.arrays import Array
from rig.core.numerics.simd import LANES, aligned_zeros


class SharedScratch:
    """A working array that all channels use one after another.

    Separate arrays would not stay in the processor's cache.
    """

    def __init__(self) -> None:
        self._rows = aligned_zeros(0, LANES)

    def rows(self, count: int) -> Array:
        """Return at least `count` rows of `LANES` numbers (the size of a SIMD register) with arbitrary content."""
        if len(self._rows) < count:
            self._rows = aligned_zeros(count, LANES)
        return self._rows


class Overlap:
    """Keeps the last `length` samples of the previous block for filtering the next block; initially they are zero.

    >>> overlap = Overlap(2)
    >>> for block in ([1.0, 2.0, 3.0], [4.0]):
    ...     overlap.reserve(len(block))[:] = block
    >>> overlap.samples[:3].tolist()
    [2.0, 3.0, 4.0]
    """

    def __init__(self, length: int) -> None:
        self._length, self._count = length, 0
        self.samples = np.zeros(length)

    def reserve(self, count: int) -> Array:
        """Return the part of `samples` into which the caller writes the next block, shape (count,)."""
        last_samples = self.samples[self._count : self._count + self._length]
        needed = self._length + count
        if self.samples.size < needed:
            self.samples = np.zeros(needed)
        self.samples[: self._length] = last_samples
        self._count = count
        return self.samples[self._length : needed]
