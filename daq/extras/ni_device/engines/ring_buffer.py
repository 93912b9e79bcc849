"""A ring buffer for the latest samples of a stream."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from daq.extras.ni_device.errors import invalid_value

# Maximum size of a buffer [bytes]: a larger buffer could make the computer swap memory to disk.
MAX_BYTES = 2 << 30


def allocate(channels: int, samples: int, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return zeros, (channels, samples); `DaqError` -200077 for a negative number or without memory."""
    if samples < 0:
        raise invalid_value(
            f"{samples} samples per channel are impossible. Give 0 or more, or READ_ALL_AVAILABLE (-1)."
        )
    if channels * samples * np.dtype(dtype).itemsize <= MAX_BYTES:
        try:
            return np.zeros((channels, samples), dtype)
        except MemoryError:
            pass
    raise invalid_value(
        f"{samples} samples of {channels} channels exceed the memory of this instrument. Use fewer samples at a "
        "time; for a long acquisition, use AcquisitionType.CONTINUOUS."
    )


class RingBuffer:
    """The last `size` samples of a stream whose samples are numbered from 0.

    `size` is in samples per channel, `dtype` the type of a sample. `written` is the number of samples per channel
    written so far, which is the index of the next sample. Raises `DaqError` -200077 if there is not enough memory.

    >>> ring = RingBuffer(1, 4, float)
    >>> ring.write(np.arange(6.0)[None])
    >>> ring.oldest, ring.read(3, 3).tolist()
    (2, [[3.0, 4.0, 5.0]])
    """

    def __init__(self, channels: int, size: int, dtype: DTypeLike) -> None:
        self._data: NDArray[Any] = allocate(channels, size, dtype)
        self.written = 0

    @property
    def size(self) -> int:
        """Capacity, samples per channel."""
        return self._data.shape[1]

    @property
    def bytes(self) -> int:
        """Size of the buffer [bytes]."""
        return self._data.nbytes

    @property
    def oldest(self) -> int:
        """Index of the oldest stored sample."""
        return max(0, self.written - self.size)

    def write(self, samples: NDArray[Any]) -> None:
        """Append samples, shape (channels, n); they overwrite the oldest samples."""
        count = samples.shape[1]
        latest = samples[:, -self.size :]
        start = (self.written + count - latest.shape[1]) % self.size
        n_to_end = min(latest.shape[1], self.size - start)
        self._data[:, start : start + n_to_end] = latest[:, :n_to_end]
        self._data[:, : latest.shape[1] - n_to_end] = latest[:, n_to_end:]
        self.written += count

    def read(self, first: int, count: int) -> NDArray[Any]:
        """Return a copy of samples, (channels, count); `IndexError` for overwritten or unwritten samples."""
        if first < self.oldest or first + count > self.written:
            stored = f"the buffer contains samples {self.oldest} to {self.written - 1}"
            raise IndexError(f"samples {first} to {first + count - 1} are not stored; {stored}")
        start = first % self.size
        n_to_end = min(count, self.size - start)
        return np.concatenate([self._data[:, start : start + n_to_end], self._data[:, : count - n_to_end]], axis=1)
