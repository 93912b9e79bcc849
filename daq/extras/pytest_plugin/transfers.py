"""Samples that tasks have read and written on a bench."""

from dataclasses import dataclass, field

import numpy as np

from daq.extras.ni_device.errors import DaqError
from daq.extras.ni_device.task import Task
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError

# Maximum size of the stored samples [bytes]. For comparison: an hour of four channels at 51.2 kS/s has 5.9 GB.
_MAX_BYTES = 512 << 20


@dataclass(frozen=True)
class Transfer:
    """A read or write of a task, with the physical channels and the samples, shape (channels, samples)."""

    direction: str  # "read" or "written"
    task: str  # name
    channels: tuple[str, ...]  # physical channels, such as cDAQ1Mod1/ai0
    samples: Array  # samples in the units of the task
    rate: float | None  # S/s; None without a sample clock
    error_code: int  # code of the error that ended the call; 0 without an error


@dataclass
class Transfers:
    """The latest reads and writes, in order of time; the oldest are discarded if all samples exceed 512 MB."""

    latest: list[Transfer] = field(default_factory=list)
    n_discarded: int = 0
    _bytes: int = 0

    def add(self, task: Task, samples: Array, error: DaqError | None) -> None:
        """Add the samples of a read or write, and the error that ended it, if any."""
        settings = task.settings
        is_input = settings.direction == "ai"
        indices = settings.indices_to_read() if is_input else range(len(settings.channels))
        names = tuple(settings.channels[index].port.name for index in indices)
        rate = settings.rate if settings.has_sample_clock else None
        code = 0 if error is None else error.code
        self.latest.append(Transfer("read" if is_input else "written", task.name, names, np.array(samples), rate, code))
        self._bytes += samples.nbytes
        while self._bytes > _MAX_BYTES:
            self._bytes -= self.latest.pop(0).samples.nbytes
            self.n_discarded += 1

    def samples(self, direction: str, channel: str) -> Array:
        """Return all samples of a channel that were "read" or "written"; `RecordingError` if some were discarded."""
        if self.n_discarded:
            raise RecordingError(
                f"{channel}: the samples of {self.n_discarded} reads and writes were discarded, because the bench "
                f"stores at most {_MAX_BYTES >> 20} MB. Evaluate bench.transfers.latest, or test a shorter run."
            )
        rows = [
            row
            for transfer in self.latest
            if transfer.direction == direction
            for name, row in zip(transfer.channels, transfer.samples, strict=True)
            if name.lower() == channel.lower()
        ]
        return np.concatenate(rows) if rows else np.zeros(0)
