"""Recordings of `daq bench`: one file for each test, written by a separate thread."""

import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daq.core.recording.recorded_test import TestKind
from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.engines.log import MarkedRecording
from rig.core.base.errors import RunError
from rig.core.scene.scene import Scene

# Maximum number of queued blocks, at least 16 s of samples. If the disk falls further behind, the recording ends.
_MAX_WAITING_JOBS = 4096


class BenchRecordings:
    """While `enabled`, records all channels during tests of the page and tasks of NI clients.

    The first recording is at `path`, and may replace an existing file if `overwrite` is set; further recordings are
    numbered. `problem` is the error that stopped the recording. A recording also stops when too many blocks wait for
    the disk.
    """

    def __init__(self, chassis: Chassis, path: Path, overwrite: bool) -> None:
        self._chassis, self._path, self._overwrite = chassis, path, overwrite
        self.enabled = False
        self.paths: list[Path] = []
        self.problem = ""
        self._n_failures = 0
        self._test: tuple[Scene, TestKind] | None = None
        self._test_has_ended = False
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._recording: MarkedRecording | None = None
        self._first_sample = 0
        self._channels: Any = None
        self._thread = threading.Thread(target=self._run_jobs, name="bench recorder", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether a file is being written."""
        return self._recording is not None

    def begin_test(self, scene: Scene, kind: TestKind) -> None:
        """Begin a new recording for a test; `scene` contains its settings."""
        self._jobs.put(self._close_recording)
        self._test, self._test_has_ended = (scene, kind), False

    def end_test(self) -> None:
        """End the recording after the next block, which contains the end of the test."""
        self._test_has_ended = True

    def mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        """Mark the samples [first, stop), numbered from power-on."""
        self._jobs.put(lambda: self._write_marker(kind, first, stop, **fields))

    def on_block(self, bench: Any, block: Any) -> None:
        """Queue a block for writing. The chassis calls this method with every block."""
        is_active = self._test is not None or self._chassis.inputs or self._chassis.outputs
        if self.enabled and is_active:
            test, channels = self._test, bench.channels
            start_ns = self._chassis.time_ns(round(block.first * bench.tick_rate / bench.rate))
            n_failures = self._n_failures
            self._jobs.put(lambda: self._write_block(bench, channels, block, test, start_ns, n_failures))
            if self._jobs.qsize() > _MAX_WAITING_JOBS:
                error = RunError(
                    "the disk is too slow. Record on another disk, record fewer channels, or lower the sample rate."
                )
                self.enabled, self.problem = False, self._chassis.report_problem("the recording", error)
        elif self.running:
            self._jobs.put(self._close_recording)
        if self._test_has_ended:
            self._jobs.put(self._close_recording)
            self._test, self._test_has_ended = None, False

    def close(self) -> None:
        """Write the queued blocks, and complete the recording."""
        self._jobs.put(self._close_recording)
        self._jobs.put(None)
        self._thread.join()

    def _run_jobs(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception as error:
                self._n_failures += 1
                recording, self._recording, self.enabled = self._recording, None, False
                final_error = error if recording is None else recording.end_with(error)
                self.problem = self._chassis.report_problem("the recording", final_error)

    def _write_block(
        self, bench: Any, channels: Any, block: Any, test: tuple[Scene, TestKind] | None, start_ns: int, n_failures: int
    ) -> None:
        if n_failures != self._n_failures:
            # No block is written after a failure of the recording.
            return
        if channels is not self._channels:
            self._close_recording()
            self._channels = channels
        if self._recording is None:
            scene, kind = test or (bench.scene, TestKind.NONE)
            path = self._next_path()
            overwrite = self._overwrite and not self.paths
            self._recording = MarkedRecording(path, scene, channels, bench.rate, start_ns, overwrite, kind)
            self._first_sample = block.first
            self.problem = "" if self.enabled else self.problem
            self.paths.append(path)
        self._recording.write(block.samples, block.overload)

    def _next_path(self) -> Path:
        """Return the file name of the next recording."""
        if not self.paths and (self._overwrite or not self._path.exists()):
            return self._path
        number = len(self.paths) + 1
        while (path := self._path.with_name(f"{self._path.stem}-{number}{self._path.suffix}")).exists():
            number += 1
        return path

    def _write_marker(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        # An interval that began before the recording is not marked, because its start is not in the recording.
        if self._recording is not None and first >= self._first_sample:
            self._recording.mark(kind, first - self._first_sample, stop - self._first_sample, **fields)

    def _close_recording(self) -> None:
        if self._recording is not None:
            recording, self._recording = self._recording, None
            recording.close()
