"""Readers that fill arrays, under the names of `nidaqmx.stream_readers`.

The array is always filled from its beginning, also with what was read before an error; what is returned is
the number of samples per channel, whatever was asked for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.face.constants import READ_ALL_AVAILABLE
from daq.face.in_stream import InStream
from daq.instrument.errors import DaqError, DAQmxErrors

__all__ = ["AnalogMultiChannelReader", "AnalogSingleChannelReader", "AnalogUnscaledReader"]


class _Reader:
    """What the readers share: the stream, and a check of the arrays they are given."""

    def __init__(self, task_in_stream: InStream) -> None:
        self._stream = task_in_stream
        self.verify_array_shape = True

    def _count(self, samples: int) -> int:
        return self._stream.default_count() if samples == READ_ALL_AVAILABLE else samples

    def _rows(self, data: NDArray[Any], shape: tuple[int, ...], kind: Any) -> NDArray[Any]:
        """View an array as (channels, samples)."""
        if data.dtype != kind or not data.flags.c_contiguous:
            raise DaqError(
                f"expected a C-contiguous array of {np.dtype(kind).name}, got {data.dtype.name}"
                + ("" if data.flags.c_contiguous else ", not contiguous"),
                DAQmxErrors.UNKNOWN,
            )
        if self.verify_array_shape and data.shape != shape:
            raise DaqError(
                f"the array has shape {data.shape}, but {shape} is needed: one row per channel, one column "
                "per "
                "sample that is read (set verify_array_shape to False to read into the beginning of a "
                "larger one)",
                DAQmxErrors.UNKNOWN,
            )
        needed = int(np.prod(shape))
        if data.size < needed:
            raise DaqError(
                f"the array has room for {data.size} samples, {needed} are to be read: make it larger",
                DAQmxErrors.READ_BUFFER_TOO_SMALL,
            )
        channels = self._stream.num_chans
        return data.reshape(-1)[:needed].reshape(channels, needed // channels)


class AnalogSingleChannelReader(_Reader):
    """Reads one channel.

    Parameters
    ----------
    task_in_stream : InStream
        The task's `in_stream`.
    """

    def read_many_sample(
        self,
        data: NDArray[np.float64],
        number_of_samples_per_channel: int = READ_ALL_AVAILABLE,
        timeout: float = 10.0,
    ) -> int:
        """Read samples into an array of shape (samples,); returns how many."""
        count = self._count(number_of_samples_per_channel)
        return self._stream.fill(self._rows(data, (count,), np.float64), timeout)

    def read_one_sample(self, timeout: float = 10.0) -> float:
        """Read one sample."""
        out = np.zeros((1, 1))
        self._stream.fill(out, timeout)
        return float(out[0, 0])


class AnalogMultiChannelReader(_Reader):
    """Reads all channels of a task.

    Parameters
    ----------
    task_in_stream : InStream
        The task's `in_stream`.
    """

    def read_many_sample(
        self,
        data: NDArray[np.float64],
        number_of_samples_per_channel: int = READ_ALL_AVAILABLE,
        timeout: float = 10.0,
    ) -> int:
        """Read samples into an array of shape (channels, samples); returns how many per channel."""
        count = self._count(number_of_samples_per_channel)
        return self._stream.fill(self._rows(data, (self._stream.num_chans, count), np.float64), timeout)

    def read_one_sample(self, data: NDArray[np.float64], timeout: float = 10.0) -> None:
        """Read one sample of each channel into an array of shape (channels,)."""
        self._stream.fill(self._rows(data, (self._stream.num_chans,), np.float64), timeout)


class AnalogUnscaledReader(_Reader):
    """Reads the converter's counts of all channels of a task.

    Parameters
    ----------
    task_in_stream : InStream
        The task's `in_stream`.
    """

    def read_int32(
        self,
        data: NDArray[np.int32],
        number_of_samples_per_channel: int = READ_ALL_AVAILABLE,
        timeout: float = 10.0,
    ) -> int:
        """Read counts into an array of shape (channels, samples); returns how many per channel."""
        self._stream.check_counts()
        count = self._count(number_of_samples_per_channel)
        rows = self._rows(data, (self._stream.num_chans, count), np.int32)
        return self._stream.fill(rows, timeout, raw=True)
