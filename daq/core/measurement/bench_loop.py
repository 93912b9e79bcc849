"""The loop that passes drive from the excitation of a test to the bench, and readings back.

The drive is the signal at the inputs of the simulated rig. The excitation is a generator: it yields the drive in
windows, and receives the readings of each window. The loop applies each window to the bench and ends the test when a
reading exceeds a limit.
"""

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.excitation.station import AbortedTest, Excitation, Station
from daq.core.measurement.limits import ControlLoss, Limits
from daq.core.virtual_bench.bench import Bench, Block
from rig.core.base.arrays import Array
from rig.core.scene.scene import Scene

# Duration of the drive's ramp to zero after an early end of a test [s].
RAMP_S = 0.05


def ramp_down(last: Array, samples: int) -> Array:
    """Return a ramp of the drive to zero, shape (inputs, samples); value and slope are continuous at its start.

    `last` are the last two samples of the drive before the ramp, shape (inputs, 2).
    """
    index = np.arange(1, samples + 1)
    # A straight line that continues the last slope, times half a period of a raised cosine.
    return (last[:, -1:] + (last[:, -1:] - last[:, :1]) * index) * (1 + np.cos(np.pi * index / samples)) / 2


class LimitReached(AbortedTest):
    """A channel exceeded its abort limit, or the controlled force could no longer be measured."""


class BenchLoop(ABC):
    """A test on the bench of its scene; subclasses process its blocks, windows and markers.

    A window of drive is applied in blocks; `block` is the maximum number of samples per block. A marker names an
    interval of samples, for example the duration of an overload. `bench`: an existing bench of the scene, at rest; by
    default, a new bench.
    """

    def __init__(self, scene: Scene, block: int | None = None, bench: Bench | None = None) -> None:
        self.bench = bench = Bench(scene) if bench is None else bench
        self.warnings: list[str] = []
        self.station = Station(
            scene, bench.channels, bench.inputs, bench.rate, self.mark, self.report, self.warnings.append, bench.latency
        )
        self.limit_sample: int | None = None  # sample at which a limit ended the test
        self._block = block
        self._limits = Limits(scene, bench.channels, self.mark)
        self._control = ControlLoss(scene, bench.channels)
        self._control_lost: str | None = None  # message if the force can no longer be controlled
        self._last_drive = np.zeros((len(bench.inputs), 2))  # last two samples of the drive

    @abstractmethod
    def mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        """Process a marker of a kind, such as "overload", for the samples `first` to `stop` - 1."""

    @abstractmethod
    def report(self, fraction: float, message: str) -> None:
        """Process the progress of the test: its completed fraction, 0 to 1, and a message."""

    @abstractmethod
    def on_block(self, block: Block, readings: Array) -> None:
        """Process a block, and its readings in the unit of each channel."""

    @abstractmethod
    def on_window(self, first: int, drive: Array, overload: NDArray[np.bool_]) -> None:
        """Process drive (inputs, samples) and overload flags (channels, samples) of a window from sample `first` on."""

    @property
    def last_sample(self) -> int:
        """Index of the last sample of the converter."""
        return max(0, self.station.now - self.bench.latency - 1)

    def run_test(self, test: Excitation, drive: Array, max_duration: float = math.inf) -> bool:
        """Run a test; return whether the test ran to completion within `max_duration` [s].

        `drive`: drive of the first window. An error from `ending_error`, or the `RunError` of a test that aborts, is
        raised after the drive has been ramped to zero.
        """
        check_samples = self.station.samples(self._limits.interval)
        while self.station.now < max_duration * self.bench.rate:
            readings = []
            for start in range(0, drive.shape[1], check_samples):
                readings.append(self.acquire(drive[:, start : start + check_samples]))
                error = self.ending_error(readings[-1])
                if error is not None:
                    # The test is closed before the ramp, so its open markers end before the ramp.
                    test.close()
                    self.acquire(ramp_down(self._last_drive, self.station.samples(RAMP_S)))
                    raise error
            try:
                drive = test.send(readings[0] if len(readings) == 1 else np.concatenate(readings, axis=1))
            except StopIteration:
                if self.bench.latency:
                    # The last samples of the test are still delayed in the converter's filter.
                    self.acquire(np.repeat(self._last_drive[:, -1:], self.bench.latency, axis=1))
                return True
            except AbortedTest as reason:
                message = self._control.describe(str(reason), self.station.now)
                self.acquire(ramp_down(self._last_drive, self.station.samples(RAMP_S)))
                raise AbortedTest(message) from reason
        return False

    def ending_error(self, readings: Array) -> BaseException | None:
        """Return the error that ends the test after these readings, shape (channels, samples); None if it continues."""
        first = self.station.now - self.bench.latency - readings.shape[1]
        exceedance = self._limits.watch(first, readings)
        if exceedance is None and self._control_lost is None:
            return None
        self.limit_sample = self.last_sample if exceedance is None else exceedance.sample
        return LimitReached(self._control_lost if exceedance is None else str(exceedance))

    def acquire(self, drive: Array) -> Array:
        """Apply a window of drive (inputs, samples) in blocks; return the readings, shape (channels, samples)."""
        first, n_samples = self.station.now, drive.shape[1]
        block_size = n_samples if self._block is None else self._block
        blocks = [
            self._acquire_block(drive[:, start : start + block_size]) for start in range(0, n_samples, block_size)
        ]
        readings, overload = blocks[0]
        if len(blocks) > 1:
            readings = np.concatenate([block[0] for block in blocks], axis=1)
            overload = np.concatenate([block[1] for block in blocks], axis=1)
        self.station.now = first + n_samples
        self._last_drive = np.concatenate([self._last_drive, drive[:, -2:]], axis=1)[:, -2:]
        self._control_lost = self._control.watch(first, overload)
        self.on_window(first, drive, overload)
        return readings

    def _acquire_block(self, drive: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Apply a block of drive (inputs, samples); return readings and overload flags, shape (channels, samples)."""
        block = self.bench.acquire(drive)
        readings, overload = self.bench.to_units(block.samples), block.overload
        self.on_block(block, readings)
        missing = drive.shape[1] - readings.shape[1]
        if missing:
            # If the filter delay is removed, the first blocks have fewer samples than the drive.
            padding = (0, 0), (missing, 0)
            readings, overload = np.pad(readings, padding), np.pad(overload, padding)
        return readings, overload
