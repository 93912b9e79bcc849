"""A signal's latest past in front of its next block."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.lanes import zeros

Array = NDArray[np.float64]


class History:
    """Keeps the last samples of the block before in front of those of the next.

    Before the first block everything was zero.

    Parameters
    ----------
    kept : int
        Samples to keep.
    beyond : int
        Room behind a block; what is put there is forgotten.
    width : int
        Numbers of a sample; 1: samples are single numbers.

    Attributes
    ----------
    samples : ndarray, shape (at least kept + samples of the block + beyond,) or the same by width
        What was kept, then the block. The memory is used again for the next block.

    Examples
    --------
    >>> history = History(2)
    >>> for block in ([1.0, 2.0, 3.0], [4.0]):
    ...     history.room(len(block))[:] = block
    >>> history.samples[:3].tolist()
    [2.0, 3.0, 4.0]
    """

    def __init__(self, kept: int, beyond: int = 0, width: int = 1) -> None:
        self._kept, self._beyond = kept, beyond
        self._width = () if width == 1 else (width,)
        self._count = 0
        self.samples = zeros(kept + beyond, *self._width)

    def room(self, count: int) -> Array:
        """Give the place for the next block, shape (count + beyond,) or the same by width."""
        kept = self.samples[self._count : self._count + self._kept]
        needed = self._kept + count + self._beyond
        if len(self.samples) < needed:
            self.samples = zeros(needed, *self._width)
        self.samples[: self._kept] = kept
        self._count = count
        return self.samples[self._kept : needed]
