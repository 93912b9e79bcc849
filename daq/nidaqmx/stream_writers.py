"""Writers that take arrays, under the names of `nidaqmx.stream_writers`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.face.out_stream import OutStream
from daq.face.task import AUTO_START_UNSET
from daq.instrument.errors import DaqError, DAQmxErrors

__all__ = ["AnalogMultiChannelWriter", "AnalogSingleChannelWriter"]


class _Writer:
    """What the writers share: the stream, and whether writing starts the task."""

    def __init__(self, task_out_stream: OutStream, auto_start: Any = AUTO_START_UNSET) -> None:
        self._stream = task_out_stream
        self.auto_start = auto_start
        self.verify_array_shape = True

    def _put(self, rows: NDArray[np.float64], dimensions: int, given: int, timeout: float, one: bool) -> int:
        if self.verify_array_shape and given != dimensions:
            raise DaqError(
                f"the array has {given} dimension(s), {dimensions} expected: channels first, then samples",
                DAQmxErrors.UNKNOWN,
            )
        start = one if self.auto_start is AUTO_START_UNSET else bool(self.auto_start)
        return self._stream.put(rows, start, timeout)


class AnalogSingleChannelWriter(_Writer):
    """Writes to one channel.

    Parameters
    ----------
    task_out_stream : OutStream
        The task's `out_stream`.
    auto_start : bool, optional
        Whether writing starts the task; by default only the writing of a single sample does.
    """

    def write_many_sample(self, data: NDArray[np.float64], timeout: float = 10.0) -> int:
        """Write an array of shape (samples,); returns how many."""
        data = np.asarray(data, dtype=np.float64)
        return self._put(data.reshape(1, -1), 1, data.ndim, timeout, one=False)

    def write_one_sample(self, data: float, timeout: float = 10.0) -> int:
        """Write one sample."""
        return self._put(np.array([[float(data)]]), 0, 0, timeout, one=True)


class AnalogMultiChannelWriter(_Writer):
    """Writes to all channels of a task.

    Parameters
    ----------
    task_out_stream : OutStream
        The task's `out_stream`.
    auto_start : bool, optional
        Whether writing starts the task; by default only the writing of a single sample does.
    """

    def write_many_sample(self, data: NDArray[np.float64], timeout: float = 10.0) -> int:
        """Write an array of shape (channels, samples); returns how many per channel."""
        data = np.asarray(data, dtype=np.float64)
        return self._put(np.atleast_2d(data), 2, data.ndim, timeout, one=False)

    def write_one_sample(self, data: NDArray[np.float64], timeout: float = 10.0) -> int:
        """Write one sample to each channel, from an array of shape (channels,)."""
        data = np.asarray(data, dtype=np.float64)
        return self._put(data.reshape(-1, 1), 1, data.ndim, timeout, one=True)
