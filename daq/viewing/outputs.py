"""Outputs of a replay: a window, a browser, a picture, or a file."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from urllib.parse import quote
from uuid import uuid4

import rerun as rr

from daq.viewing.replay import Replay
from daq.viewing.rerun_viewer import LOOPBACK, Viewer, can_open_windows, free_port, need_display, picture, viewer
from rig.console import pause_reports
from rig.errors import RunError, SceneError
from rig.output_files import atomic_write
from rig.progress import FractionProgress
from rig.provenance import may_overwrite, output_source, reject_foreign_files, relative_paths

APPLICATION = "shotrig"
WITHOUT_DISPLAY = "use --web to look with a browser, --screenshot FILE.png for a picture, or --save FILE.rrd"
# Memory of the viewer per value: value, time and index, bytes.
_BYTES_PER_VALUE = 20
# Entity that is sent last.
_LAST_ENTITY = "complete"
# Memory of the viewer above which a note is printed, GB.
_MAX_LIGHT_GB = 2.0
# Maximum wait for a viewer or a file to accept a block, s.
_MAX_SINK_WAIT_S = 60.0


def save(replay: Replay, file: Path, progress: FractionProgress | None = None) -> None:
    """Write a replay with its layout to an .rrd file; `rerun FILE.rrd` opens it.

    Raises `SceneError` for another suffix, `RunError` if the file cannot be written.
    """
    _check_suffix(file, ".rrd", "--save")

    with atomic_write(file, may_overwrite()) as part, _stream_into(part) as (stream, check):

        def drain() -> None:
            stream.flush(timeout_sec=_MAX_SINK_WAIT_S)
            check()

        _fill(replay, stream, drain, progress)


@contextmanager
def _stream_into(file: Path) -> Iterator[tuple[rr.RecordingStream, Callable[[], None]]]:
    """Yield a stream into a file, and a function that raises `OSError` after a failure of writing.

    Rerun's writer would wait for ever on a full disk; therefore it writes into a pipe.
    """
    if sys.platform == "win32":
        # On Windows a pipe has no path.
        with recording_stream() as stream:
            stream.save(file)
            yield stream, lambda: None
        return
    reading, writing = os.pipe()
    failures: list[OSError] = []

    def copy() -> None:
        with open(reading, "rb", buffering=0) as sent:  # noqa: PTH123
            try:
                with file.open("wb") as written:
                    shutil.copyfileobj(sent, written)
            except OSError as error:
                failures.append(error)
                while sent.read(1 << 20):
                    pass

    def check() -> None:
        if failures:
            raise failures[0]

    thread = threading.Thread(target=copy, name="rrd")
    thread.start()
    try:
        with recording_stream() as stream:
            try:
                stream.save(f"/dev/fd/{writing}")
            finally:
                os.close(writing)
            yield stream, check
    finally:
        thread.join()
    check()


def draw_picture(
    replay: Replay,
    file: Path,
    at_s: float | None = None,
    progress: FractionProgress | None = None,
    size: tuple[int, int] = (1600, 1000),
) -> float:
    """Draw a replay into a PNG file without a window; return the instant that was drawn, s.

    `at_s` counts from the start of the recording; None takes `most_motion_s`. `size` is in pixels. Raises `SceneError`
    for another suffix or an instant outside the replay, `RunError` if no picture can be drawn or written.
    """
    _check_suffix(file, ".png", "--screenshot")
    rate = replay.recording.rate
    at = replay.most_motion_s if at_s is None else at_s
    if not replay.start / rate <= at <= replay.stop / rate:
        raise SceneError(
            f"--at {at:g} s is outside the replay. Give {replay.start / rate:g} s to {replay.stop / rate:g} s."
        )
    source = ("replay", *relative_paths([replay.recording.path], file.parent))
    with output_source(*source):
        reject_foreign_files(file)
    with tempfile.TemporaryDirectory(prefix="shotrig-") as folder:
        rrd_path = Path(folder) / "replay.rrd"
        save(replay, rrd_path, progress)
        png, views = picture(
            rrd_path, at - replay.start / rate, size, (replay.stop - 1 - replay.start) / rate, _LAST_ENTITY
        )
    with output_source(*source), atomic_write(file) as part:
        part.write_bytes(png)
    problems = [f"{view.name}: {report.summary}" for view in views for report in view.reports]
    if problems:
        raise RunError(f"{file} is written, but incomplete: {'; '.join(problems)}")
    return at


def window(instead: str) -> AbstractContextManager[Viewer]:
    """Open a viewer in a window; raise `RunError`, with the remedy `instead`, if there is no display."""
    need_display(instead)
    return viewer("--expect-data-soon")


def show(replay: Replay, viewing: AbstractContextManager[Viewer], progress: FractionProgress | None = None) -> None:
    """Show a replay in a `window` or on a `server` until the viewer ends; raise `RunError` if it does not start."""
    with viewing as running:
        # The viewer holds every value or drops the oldest.
        gigabytes = replay.values * _BYTES_PER_VALUE / 1e9
        if gigabytes > _MAX_LIGHT_GB:
            print(
                f"note: the viewer will take about {gigabytes:.0f} GB of memory. Show a part with --from and --to.",
                file=sys.stderr,
            )
        with recording_stream() as stream:
            stream.connect_grpc(running.url)
            try:
                _fill(replay, stream, lambda: stream.flush(timeout_sec=_MAX_SINK_WAIT_S), progress)
            except RuntimeError as error:
                if running.process.poll() is None:
                    raise RunError(f"the rerun viewer stopped taking data: {error}") from error
        with pause_reports():
            running.process.wait()


@contextmanager
def server(announce: Callable[[str], None]) -> Iterator[Viewer]:
    """Serve the viewer to browsers on this machine; `announce` is called with the address."""
    page = free_port()
    # The server stores everything for later browsers.
    with viewer("--serve-web", "--web-viewer-port", str(page), "--server-memory-limit", "75%") as running:
        address = f"http://{LOOPBACK}:{page}/?url={quote(running.url, safe='')}"
        announce(address)
        if can_open_windows():
            webbrowser.open(address)
        yield running


@contextmanager
def recording_stream() -> Iterator[rr.RecordingStream]:
    """Make a separate stream, which is flushed to its sink at the end."""
    stream = rr.RecordingStream(APPLICATION, recording_id=uuid4())
    try:
        yield stream
    finally:
        stream.disconnect()


def _fill(
    replay: Replay, stream: rr.RecordingStream, drain: Callable[[], object], progress: FractionProgress | None
) -> None:
    drain()
    # As the active layout: a viewer remembers the layout of an application and would ignore a default.
    stream.send_blueprint(replay.blueprint(), make_active=True, make_default=True)
    replay.send(stream, drain, progress)
    # A viewer that has received this text has received everything.
    stream.log(_LAST_ENTITY, rr.TextDocument("all of the replay was sent"), static=True)
    drain()


def _check_suffix(file: Path, suffix: str, option: str) -> None:
    if file.suffix.lower() != suffix:
        raise SceneError(f"{option} {file}: expected a file name that ends in {suffix}")
    if not file.parent.is_dir():
        raise RunError(f"{option} {file}: there is no folder {file.parent}. Create it first.")
