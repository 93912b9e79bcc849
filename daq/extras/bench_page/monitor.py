"""The data that the page shows: time histories, spectra, overloads, drive and motion.

A block contains the samples of one short acquisition. A separate thread processes the blocks. The listener only queues
the blocks, so acquisition never waits for the page. If the queue is full, blocks are not shown; recordings have
their own queue.
"""

import queue
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.drawing.rig_view import RigMotion
from daq.extras.bench_page.impacts import ImpactDetector
from daq.extras.bench_page.live_frf import LiveFrf
from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_server.live import end_display
from rig.core.base.arrays import Array

# Maximum number of blocks in the queue of the page; more are not shown, because acquisition never waits for the page.
_MAX_WAITING_BLOCKS = 256
# Duration of the stored time histories [s].
_HISTORY_S = 10.0
# The displayed level of a channel is its peak in the last seconds of this duration [s].
_LEVEL_S = 0.25
# Rate of the stored motion of the rig [1/s].
_MOTION_RATE = 400.0
# Duration of the stored motion of the rig [s].
MOTION_S = 0.2
# Duration of the samples for a spectrum [s].
_SPECTRUM_S = 2.0
# Duration of the samples for the peak and the frequency of a drive [s].
_DRIVE_S = 0.5


class History:
    """The last `length` samples of several signals; `stop` is the index of the next sample."""

    def __init__(self, rows: int, length: int) -> None:
        self._values = np.zeros((rows, length))
        self.stop = 0

    def add(self, first: int, values: Array) -> None:
        """Add samples, the first with the number `first`; missing samples before them become zeros."""
        length = self._values.shape[1]
        missing = min(first - self.stop, length)
        if missing > 0:
            self._values[:, np.arange(first - missing, first) % length] = 0.0
        stop, values = first + values.shape[1], values[:, -length:]
        self._values[:, np.arange(stop - values.shape[1], stop) % length] = values
        # `stop` is set last, because another thread reads the samples before `stop`.
        self.stop = stop

    def last(self, samples: int) -> Array:
        """Return the last samples, shape (rows, samples)."""
        length, stop = self._values.shape[1], self.stop
        return self._values[:, np.arange(stop - min(samples, length), stop) % length]


class Monitor:
    """Processes the blocks of a bench for the page.

    `frf` estimates the frequency response, and `detector` detects the impacts, of the current or the last test.
    `is_estimating` is true while a test without impacts runs. `overloads` contains the times (s since power-on) of
    the first and the last overload of a row of the readings since the operator cleared it, and the largest reading.
    `lost_samples` is the number of samples missing between blocks. `skipped_blocks` is the number of blocks that are
    not shown.
    """

    def __init__(self, chassis: Chassis) -> None:
        bench: Any = chassis.bench
        self._chassis = chassis
        self._scene = bench.scene
        self.rate = bench.rate
        self.channels = tuple(bench.channels)
        self.history = History(len(self.channels), round(_HISTORY_S * self.rate))
        self.drive_history = History(len(bench.drive), round(_DRIVE_S * self.rate))
        self.frf: LiveFrf | None = None
        self.detector: ImpactDetector | None = None
        self.is_estimating = False
        self.skipped_blocks = self.lost_samples = 0
        self._next_sample: int | None = None
        self.overloads: dict[int, tuple[float, float, float]] = {}
        # End of the last block with an overload of a row, sample.
        self._last_overloads: dict[int, int] = {}
        self._excited_band: Callable[[], tuple[float, float] | None] = lambda: None
        # Displacements of bodies and tables, and gaps of the dampers, at each stored instant.
        self._motions: deque[tuple[Array, Array | None]] = deque(maxlen=round(MOTION_S * _MOTION_RATE))
        self._motion_step = max(1, round(self.rate / _MOTION_RATE))
        self._lock = threading.Lock()
        self._blocks: queue.Queue[Any] = queue.Queue(_MAX_WAITING_BLOCKS)
        self._thread = threading.Thread(target=self._process_queue, name="bench page", daemon=True)
        self._thread.start()

    def on_block(self, bench: Any, block: Any) -> None:
        """Queue a block of the bench; a listener of the chassis."""
        if self._next_sample is not None:
            self.lost_samples += max(0, block.first - self._next_sample)
        self._next_sample = block.first + block.samples.shape[1]
        if self._blocks.full():
            self.skipped_blocks += 1
        else:
            self._blocks.put_nowait((block, bench.drive.copy(), bench.to_units))

    def catch_up(self) -> None:
        """Wait until all queued blocks have been processed."""
        self._blocks.join()

    def close(self) -> None:
        """Process the waiting blocks, and end the thread; see `end_display`."""
        end_display(self._blocks, self._thread)

    def start_estimate(
        self,
        frf: LiveFrf | None,
        detector: ImpactDetector | None,
        excited_band: Callable[[], tuple[float, float] | None],
    ) -> None:
        """Start the estimate of a test; `detector` is None for a continuous test.

        `excited_band` returns the band that the test excites now; see `LiveFrf.add`.
        """
        with self._lock:
            self.frf, self.detector, self.is_estimating = frf, detector, detector is None
            self._excited_band = excited_band

    def end_estimate(self) -> None:
        """End the estimate of a continuous test."""
        with self._lock:
            self.is_estimating = False

    def levels(self) -> list[float]:
        """Return the peak magnitude of each channel in the last `_LEVEL_S` seconds."""
        levels: list[float] = np.abs(self.history.last(round(_LEVEL_S * self.rate))).max(axis=1).tolist()
        return levels

    def overloaded_rows(self) -> list[int]:
        """Return the rows of the readings with an overload in the last `_LEVEL_S` seconds."""
        since = self.history.stop - round(_LEVEL_S * self.rate)
        return [row for row, stop in self._last_overloads.copy().items() if stop > since]

    def spectra(self) -> tuple[NDArray[Any], Array]:
        """Return frequencies [Hz] and amplitude spectra (Hann window, shape (channels, lines)) of all channels."""
        samples = self.history.last(round(_SPECTRUM_S * self.rate))
        window = np.hanning(samples.shape[1])
        samples = (samples - samples.mean(axis=1, keepdims=True)) * window
        spectra = 2.0 * np.abs(np.fft.rfft(samples, axis=1)) / window.sum()
        return np.asarray(np.fft.rfftfreq(samples.shape[1], 1.0 / self.rate)), spectra

    def drive_levels(self) -> list[tuple[float, float]]:
        """Return peak (in the unit of the drive) and frequency [Hz] of the drive at each input of the rig.

        The frequency is that of the newest period between upward zero crossings; 0 with fewer than two crossings.
        """
        peaks_and_frequencies = []
        for drive in self.drive_history.last(round(_DRIVE_S * self.rate)):
            peak = float(np.abs(drive).max(initial=0.0))
            centered = drive - drive.mean()
            zero_crossings = np.flatnonzero((centered[:-1] < 0) & (centered[1:] >= 0))
            # Crossings lie between samples.
            times = (zero_crossings - centered[zero_crossings] / np.diff(centered)[zero_crossings]) / self.rate
            peaks_and_frequencies.append((peak, float(1.0 / (times[-1] - times[-2])) if times.size > 1 else 0.0))
        return peaks_and_frequencies

    def motion(self) -> RigMotion | None:
        """Return the motion of the rig in the last `MOTION_S` seconds; None before the first block."""
        with self._lock:
            instants = list(self._motions)
        if not instants:
            return None
        motions = np.column_stack([motion for motion, _ in instants])
        gaps = [gap for _, gap in instants if gap is not None]
        bodies = self._scene.structure.bodies
        tables = motions[bodies : bodies + len(self._scene.tables)]
        return RigMotion(motions[:bodies], tables, np.column_stack(gaps) if gaps else None)

    def _process_queue(self) -> None:
        has_failed = False
        while (item := self._blocks.get()) is not None:
            try:
                if not has_failed:
                    self._process(*item)
            except Exception as error:
                has_failed = True
                self._chassis.report_problem("the display of the page", error)
            finally:
                self._blocks.task_done()

    def _process(self, block: Any, drive: Array, to_physical: Any) -> None:
        if block.samples.size:
            readings = to_physical(block.samples)
            self.history.add(block.first, readings)
            self.drive_history.add(self.drive_history.stop, drive)
            for row in np.flatnonzero(block.overload.any(axis=1)).tolist():
                peak = float(np.abs(readings[row, block.overload[row]]).max())
                time = block.first / self.rate
                first, _, largest = self.overloads.get(row, (time, time, peak))
                self.overloads[row] = first, time, max(largest, peak)
                self._last_overloads[row] = self.history.stop
            motion = block.motion
            indices = range(-motion.first % self._motion_step, motion.displacement.shape[1], self._motion_step)
            with self._lock:
                for index in indices:
                    gap = motion.gap[:, index] if self._scene.dampers else None
                    self._motions.append((motion.displacement[:, index], gap))
                if self.frf is not None and self.is_estimating:
                    self.frf.add(readings, block.overload, self._excited_band())
                if self.detector is not None:
                    for impact in self.detector.add(block.first, readings, block.overload):
                        if self.frf is not None:
                            self.frf.add_impact(impact)
