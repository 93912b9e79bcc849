"""Records the bench while clients of a server use it, and ends the thread of a live display."""

import queue
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.engines.log import MarkedRecording
from rig.core.base.errors import RecordingError
from rig.core.base.output_files import create_folder

#: Longest wait [s] for a display that does not respond; the server must end anyway.
MAX_CLOSING_S = 10.0


def end_display(blocks: queue.Queue[Any], thread: threading.Thread) -> None:
    """Wait until a thread has shown the waiting blocks; the thread ends when it receives None.

    A display that does not respond is abandoned, and the number of blocks that it has not shown is reported on stderr.
    """
    try:
        blocks.put(None, timeout=MAX_CLOSING_S)
    except queue.Full:
        # The block that the thread is showing now is no longer in the queue.
        n_blocks = blocks.qsize() + 1
    else:
        thread.join(MAX_CLOSING_S)
        if not thread.is_alive():
            return
        # The queue contains None instead of the block that the thread is showing.
        n_blocks = blocks.qsize()
    _report(
        f"warning: the display did not respond within {MAX_CLOSING_S:g} s. The last {n_blocks} blocks of samples were "
        "not shown; recordings contain them."
    )


def _report(message: str) -> None:
    # The terminal may be closed already.
    with suppress(OSError):
        print(message, file=sys.stderr, flush=True)


class LiveRecording:
    """Records all channels of a bench while clients use it, and marks overloads in the recording.

    A change of a coupling or sensor supply starts another file, with a number appended to its name. If writing fails,
    the recording ends with a report (`Chassis.report_problem`); clients continue. Raises `RecordingError` if the folder
    of `path` cannot be created.
    """

    def __init__(self, chassis: Chassis, path: Path, overwrite: bool = False) -> None:
        create_folder(path.parent, RecordingError)
        self._chassis, self._path, self._overwrite = chassis, path, overwrite
        self._recorded_channels: Any = None  # descriptions of the channels in the current file
        self._recording: MarkedRecording | None = None
        self._has_failed = False
        self.paths: list[Path] = []
        chassis.listeners.append(self._on_block)

    def _on_block(self, bench: Any, block: Any) -> None:
        if self._has_failed:
            return
        try:
            self._record(bench, block)
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Complete the recording as far as possible after an error, and report the error."""
        recording, self._recording, self._has_failed = self._recording, None, True
        self._chassis.report_problem("the recording", error if recording is None else recording.end_with(error))

    def _record(self, bench: Any, block: Any) -> None:
        """Write a block; start a file if there is none, or if a coupling or supply has changed."""
        if bench.channels is not self._recorded_channels:
            self._complete()
            number = f"-{len(self.paths) + 1}" if self.paths else ""
            self.paths.append(self._path.with_name(f"{self._path.stem}{number}{self._path.suffix}"))
            start_ns = self._chassis.time_ns(round(block.first * bench.tick_rate / bench.rate))
            self._recorded_channels = bench.channels
            self._recording = MarkedRecording(
                self.paths[-1], bench.scene, bench.channels, bench.rate, start_ns, self._overwrite
            )
        assert self._recording is not None
        self._recording.write(block.samples, block.overload)

    def _complete(self) -> None:
        if self._recording is not None:
            self._recording.close()
            self._recording = None

    def close(self) -> None:
        """Complete the recording; report on stderr if nothing was recorded."""
        with self._chassis.changed:
            self._chassis.listeners.remove(self._on_block)
            try:
                self._complete()
            except Exception as error:
                self._fail(error)
        if not self.paths:
            _report(
                f"note: {self._path}: nothing was recorded, because no client ran a task. Start a task before the "
                "server ends."
            )
