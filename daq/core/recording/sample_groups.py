"""Groups of samples on a fixed grid of sample indices, collected from arrays of any length.

A cell of the grid contains the sample indices from one multiple of the group length to the next. The bytes of a
recording depend on the grid only, not on the lengths of the arrays.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Group:
    """The samples of one cell of the grid."""

    first: int  # sample index of the first column of `samples`
    samples: NDArray[Any]  # samples, valid only within `spans`; shape (rows, group length)
    spans: list[tuple[int, int]]  # ranges of sample indices [start, stop) that were acquired, in order

    def acquired(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Yield each range of acquired samples: index of its first sample, and its samples."""
        for start, stop in self.spans:
            yield start, self.samples[:, start - self.first : stop - self.first]

    def blocks(self, length: int) -> Iterator[tuple[int, NDArray[Any]]]:
        """Yield the acquired samples in blocks; a block ends at a multiple of `length`, or with the acquired range.

        Each item has the index of its first sample, and successive blocks of equal size, shape (rows, blocks, samples).
        """
        for start, samples in self.acquired():
            stop = start + samples.shape[1]
            block_end = min(start + -start % length, stop)
            last_end = max(block_end, stop - stop % length)
            for begin, end, size in (
                (start, block_end, block_end - start),
                (block_end, last_end, length),
                (last_end, stop, stop - last_end),
            ):
                if begin < end:
                    part = samples[:, begin - start : end - start]
                    yield begin, part.reshape(len(part), (end - begin) // size, size)


class Grouping:
    """Collects samples of a number of rows into groups of `length` samples on a fixed grid.

    `complete` contains the groups of completed cells by cell number, without empty groups. `position` is the number of
    the next sample, `group_bytes` the size of a group.
    """

    def __init__(self, rows: int, length: int, dtype: np.dtype[Any]) -> None:
        self.position = 0
        self.complete: dict[int, Group] = {}
        self.group_bytes = rows * length * dtype.itemsize
        self._rows, self._length, self._dtype = rows, length, dtype
        self._current = self._new_group(0)

    def _new_group(self, number: int) -> Group:
        return Group(number * self._length, np.empty((self._rows, self._length), self._dtype), [])

    def add(self, samples: NDArray[Any]) -> None:
        """Copy the next samples, shape (rows, any number)."""
        copied = 0
        while copied < samples.shape[1]:
            start, group = self.position, self._current
            part = samples[:, copied : copied + group.first + self._length - start]
            stop = start + part.shape[1]
            group.samples[:, start - group.first : stop - group.first] = part
            if group.spans and group.spans[-1][1] == start:
                start = group.spans.pop()[0]
            group.spans.append((start, stop))
            copied += part.shape[1]
            self._move_to(stop)

    def skip(self, count: int) -> None:
        """Skip samples that were not acquired."""
        self._move_to(self.position + count)

    def _move_to(self, position: int) -> None:
        self.position = position
        if position >= self._current.first + self._length:
            self.complete_group()

    def complete_group(self) -> None:
        """Complete the current group, even if samples are missing at its end."""
        if self._current.spans:
            self.complete[self._current.first // self._length] = self._current
        self._current = self._new_group(self.position // self._length)
