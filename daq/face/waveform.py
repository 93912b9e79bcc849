"""Samples that know their time, their unit and their name."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from daq.face.task import Task


@dataclass(frozen=True)
class WaveformTiming:
    """When the samples of a waveform were taken.

    Attributes
    ----------
    start_ns : int
        Time of the first sample, ns: since 1970 on the real clock, since the bench's power-on on the others.
    sample_rate : float
        Samples per second.
    """

    start_ns: int
    sample_rate: float

    @property
    def start_time(self) -> datetime:
        """Time of the first sample, to the microsecond."""
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=self.start_ns / 1000)

    @property
    def sample_interval(self) -> timedelta:
        """Time from sample to sample, to the microsecond; `sample_rate` is exact."""
        return timedelta(seconds=1 / self.sample_rate)


@dataclass(frozen=True)
class AnalogWaveform:
    """Samples of one channel with their time.

    Attributes
    ----------
    scaled_data : ndarray, shape (samples,)
        Readings.
    channel_name, units : str
        Name and unit.
    timing : WaveformTiming
        When.
    first_sample : int
        Number of the first sample since the task's start: a gap in what was read shows here.
    """

    scaled_data: NDArray[np.float64]
    channel_name: str
    units: str
    timing: WaveformTiming
    first_sample: int

    @property
    def raw_data(self) -> NDArray[np.float64]:
        """The same as `scaled_data`."""
        return self.scaled_data

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        return len(self.scaled_data)


def waveforms(samples: NDArray[np.float64], task: Task) -> list[AnalogWaveform]:
    """Give the samples a task has just read their times and names; samples of shape (channels, n)."""
    first, start_ns = task.run.last_read(samples.shape[1])
    timing = WaveformTiming(start_ns, task.chassis.rate)
    return [
        AnalogWaveform(row, terminal.name, terminal.unit, timing, first)
        for row, terminal in zip(samples, task.in_stream.channels_to_read.terminals, strict=True)
    ]
