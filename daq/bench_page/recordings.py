"""Recordings of the bench: one file for each test, written by a separate thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.instrument.engines.log import MarkedRecording
from daq.recording.committed_file import make_folder
from daq.recording.recorded_test import TestKind
from rig.errors import ShotrigError

if TYPE_CHECKING:
    from daq.instrument.chassis import Chassis
    from rig.scene.scene import Scene


class BenchRecordings:
    """Records all channels while it is `enabled` and a test of the page or a client's task runs.

    The first recording is at `path`, which may replace a file if `overwrite` is set; the next are numbered.
    `problem` is the reason why recording has stopped.
    """

    def __init__(self, chassis: Chassis, path: Path, overwrite: bool) -> None:
        self._chassis, self._path, self._overwrite = chassis, path, overwrite
        self.enabled = False
        self.paths: list[Path] = []
        self.problem = ""
        self._test: tuple[Scene, TestKind] | None = None
        self._ending = False
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._recording: MarkedRecording | None = None
        self._first = 0
        self._channels: Any = None
        self._thread = threading.Thread(target=self._work, name="bench recorder", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether a file is being written."""
        return self._recording is not None

    def begin_test(self, scene: Scene, kind: TestKind) -> None:
        """Begin another recording, with the test of a scene."""
        self._jobs.put(self._complete)
        self._test, self._ending = (scene, kind), False

    def end_test(self) -> None:
        """End the recording after the next block, which holds the end of the test."""
        self._ending = True

    def mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        """Mark the samples from `first` to before `stop`, counted from power-on."""
        self._jobs.put(lambda: self._mark(kind, first, stop, **fields))

    def on_block(self, bench: Any, block: Any) -> None:
        """Queue a block of the bench; a listener of the chassis."""
        busy = self._test is not None or self._chassis.inputs or self._chassis.outputs
        if self.enabled and busy:
            test, channels = self._test, bench.channels
            time_ns = self._chassis.time_ns(round(block.first * bench.tick_rate / bench.rate))
            self._jobs.put(lambda: self._write(bench, channels, block, test, time_ns))
        elif self.running:
            self._jobs.put(self._complete)
        if self._ending:
            self._jobs.put(self._complete)
            self._test, self._ending = None, False

    def close(self) -> None:
        """Write the queued blocks and complete the recording."""
        self._jobs.put(self._complete)
        self._jobs.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except ShotrigError as error:
                self.problem, self.enabled = str(error), False
                self._recording = None

    def _write(self, bench: Any, channels: Any, block: Any, test: tuple[Scene, TestKind] | None, time_ns: int) -> None:
        if channels is not self._channels:
            self._complete()
            self._channels = channels
        if self._recording is None:
            scene, kind = test or (bench.scene, TestKind.NONE)
            path = self._next_path()
            make_folder(path)
            overwrite = self._overwrite and not self.paths
            self._recording = MarkedRecording(path, scene, channels, bench.rate, time_ns, overwrite, kind)
            self._first, self.problem = block.first, ""
            self.paths.append(path)
        self._recording.write(block.samples, block.overload)

    def _next_path(self) -> Path:
        """Choose the name of the next recording."""
        if not self.paths and (self._overwrite or not self._path.exists()):
            return self._path
        number = len(self.paths) + 1
        while (path := self._path.with_name(f"{self._path.stem}-{number}{self._path.suffix}")).exists():
            number += 1
        return path

    def _mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        # An event that began before the recording is not complete in it.
        if self._recording is not None and first >= self._first:
            self._recording.mark(kind, first - self._first, stop - self._first, **fields)

    def _complete(self) -> None:
        if self._recording is not None:
            recording, self._recording = self._recording, None
            recording.close()
