"""Data of the channels for the page: time histories, spectra, overloads, outputs and motion.

A separate thread collects the data. The listener only queues blocks, so that acquisition never waits for the page. A
late thread skips blocks of the view; recordings have their own queue.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.drawing.rig_view import RigPose
from rig.arrays import Array

if TYPE_CHECKING:
    from daq.bench_page.hits import HitDetector
    from daq.bench_page.live_frf import LiveFrf
    from daq.instrument.chassis import Chassis


# Maximum number of blocks in the queue of the view.
_MAX_WAITING_BLOCKS = 256
# Length of the time histories, s.
_HISTORY_S = 10.0
# Time for which a lamp is lit after an overload, s.
_LAMP_S = 2.0
# Stored positions of the rig: rate, Hz, and duration, s.
_POSES_PER_S = 400.0
POSES_S = 0.2
# Length of the spectra and of the view of the outputs, s.
_SPECTRUM_S = 2.0
_OUTPUT_S = 0.5


class History:
    """The last samples of several signals; sample numbers count from power-on."""

    def __init__(self, rows: int, size: int) -> None:
        self._values = np.zeros((rows, size))
        self.stop = 0

    def add(self, first: int, values: Array) -> None:
        """Write samples; missing samples before them become zeros."""
        size = self._values.shape[1]
        missing = min(first - self.stop, size)
        if missing > 0:
            self._values[:, np.arange(first - missing, first) % size] = 0.0
        self.stop = first + values.shape[1]
        values = values[:, -size:]
        self._values[:, np.arange(self.stop - values.shape[1], self.stop) % size] = values

    def last(self, samples: int) -> Array:
        """Return the last samples, shape (rows, samples)."""
        size = self._values.shape[1]
        return self._values[:, np.arange(self.stop - min(samples, size), self.stop) % size]


class Monitor:
    """Follows the blocks of a bench; `frf` and `detector` are those of the test that runs or ran last.

    `lost_samples` counts the samples missing between the bench's blocks; `skipped_blocks`, the blocks missing in the
    view.
    """

    def __init__(self, chassis: Chassis) -> None:
        bench: Any = chassis.bench
        self._scene = bench.scene
        self.rate = bench.rate
        self.channels = tuple(bench.channels)
        self.history = History(len(self.channels), round(_HISTORY_S * self.rate))
        self.outputs = History(len(bench.drive), round(_OUTPUT_S * self.rate))
        self.frf: LiveFrf | None = None
        self.detector: HitDetector | None = None
        self.continuous = False
        self.skipped_blocks = self.lost_samples = 0
        self._next: int | None = None
        self._overloaded = np.full(len(self.channels), -1)
        self._poses: deque[tuple[Array, Array | None]] = deque(maxlen=round(POSES_S * _POSES_PER_S))
        self._step = max(1, round(self.rate / _POSES_PER_S))
        self._lock = threading.Lock()
        self._blocks: queue.Queue[Any] = queue.Queue(_MAX_WAITING_BLOCKS)
        self._thread = threading.Thread(target=self._follow, name="bench page", daemon=True)
        self._thread.start()

    def on_block(self, bench: Any, block: Any) -> None:
        """Queue a block of the bench; a listener of the chassis."""
        if self._next is not None:
            self.lost_samples += max(0, block.first - self._next)
        self._next = block.first + block.samples.shape[1]
        if self._blocks.full():
            self.skipped_blocks += 1
        else:
            self._blocks.put_nowait((block, bench.drive.copy(), bench.physical))

    def catch_up(self) -> None:
        """Wait until all queued blocks have been processed."""
        self._blocks.join()

    def close(self) -> None:
        """End the thread."""
        self._blocks.put(None)
        self._thread.join()

    def watch(self, frf: LiveFrf | None, detector: HitDetector | None) -> None:
        """Start an estimate; `detector` detects hits."""
        with self._lock:
            self.frf, self.detector, self.continuous = frf, detector, detector is None

    def stop_watching(self) -> None:
        """End the estimate of a continuous test."""
        with self._lock:
            self.continuous = False

    def overloads(self) -> list[bool]:
        """Return which channels were overloaded in the last seconds."""
        first = self.history.stop - _LAMP_S * self.rate
        return [bool(last >= 0 and last > first) for last in self._overloaded]

    def spectra(self) -> tuple[NDArray[Any], Array]:
        """Return frequencies and amplitude spectra of all channels, Hann window, shape (channels, lines)."""
        samples = self.history.last(round(_SPECTRUM_S * self.rate))
        window = np.hanning(samples.shape[1])
        samples = (samples - samples.mean(axis=1, keepdims=True)) * window
        spectra = 2.0 * np.abs(np.fft.rfft(samples, axis=1)) / window.sum()
        return np.asarray(np.fft.rfftfreq(samples.shape[1], 1.0 / self.rate)), spectra

    def output(self) -> list[tuple[float, float]]:
        """Return peak and frequency (Hz) of the drive at each input; the frequency is that of upward zero crossings."""
        tones = []
        for wave in self.outputs.last(round(_OUTPUT_S * self.rate)):
            peak = float(np.abs(wave).max(initial=0.0))
            centered = wave - wave.mean()
            rising = np.flatnonzero((centered[:-1] < 0) & (centered[1:] >= 0))
            periods = len(rising) - 1
            span = float(rising[-1] - rising[0]) / self.rate if periods > 0 else 0.0
            tones.append((peak, periods / span if peak and periods > 0 else 0.0))
        return tones

    def poses(self) -> RigPose | None:
        """Return the latest motion of the rig; None before the first block."""
        with self._lock:
            latest = list(self._poses)
        if not latest:
            return None
        motions = np.column_stack([motion for motion, _ in latest])
        gaps = [gap for _, gap in latest if gap is not None]
        bodies = self._scene.structure.bodies
        tables = motions[bodies : bodies + len(self._scene.tables)]
        return RigPose(motions[:bodies], tables, np.column_stack(gaps) if gaps else None)

    def _follow(self) -> None:
        while (item := self._blocks.get()) is not None:
            self._take(*item)
            self._blocks.task_done()

    def _take(self, block: Any, drive: Array, physical: Any) -> None:
        if block.samples.size:
            readings = physical(block.samples)
            self.history.add(block.first, readings)
            self.outputs.add(self.outputs.stop, drive)
            flagged = block.overload.any(axis=1)
            self._overloaded[flagged] = block.first + block.samples.shape[1]
            motion = block.motion
            indices = range(-motion.first % self._step, motion.displacement.shape[1], self._step)
            with self._lock:
                for index in indices:
                    gap = motion.gap[:, index] if self._scene.dampers else None
                    self._poses.append((motion.displacement[:, index], gap))
                if self.frf is not None and self.continuous:
                    self.frf.add(readings)
                if self.detector is not None:
                    for hit in self.detector.add(block.first, readings, block.overload):
                        if self.frf is not None:
                            self.frf.add_hit(hit)
