"""Outputs of a replay: a window, a browser, a picture, or a file."""

import os
import shutil
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from io import BytesIO
from pathlib import Path
from urllib.parse import quote
from uuid import uuid4

import rerun as rr
from PIL import Image

from daq.extras.viewer.replay import Replay
from daq.extras.viewer.rerun_viewer import (
    LOOPBACK,
    Viewer,
    can_open_windows,
    free_port,
    headless_picture,
    require_display,
    viewer,
)
from rig.core.base.ending_signals import delayed_interrupt
from rig.core.base.errors import RunError, SceneError
from rig.core.base.output_files import atomic_write, prepare_outputs, temporary_folder
from rig.core.base.progress import FractionProgress

APPLICATION = "shotrig"
NO_DISPLAY_REMEDY = "Use `web` for a browser, `screenshot` FILE.png for a picture, or `save` FILE.rrd for a file."
# Memory of the viewer per sample [bytes]: its value (4), time and index (8 each).
_BYTES_PER_SAMPLE = 20
# Name of the rerun entity that is logged last: a viewer that has received it has received all data before it.
_LAST_ENTITY = "complete"
# A note is printed if the viewer will need more memory than this value, GB.
_NOTE_ABOVE_GB = 2.0
# Height of the menu of the viewer, pixels. Pictures omit it: it shows warnings on a machine without a graphics card.
_MENU_PIXELS = 38
# Longest wait [s] for a viewer or a file to accept a block of samples; a closed viewer must not stop the command.
_MAX_SINK_WAIT_S = 60.0


def save(replay: Replay, file: Path, progress: FractionProgress | None = None) -> None:
    """Write a replay with its layout to an .rrd file; `rerun FILE.rrd` opens it.

    Raises `SceneError` for any other suffix, `RunError` if the file cannot be written.
    """
    _check_suffix(file, ".rrd", "save")

    with atomic_write(file) as part, _stream_into(part) as (stream, raise_failure):

        def wait_until_received() -> None:
            stream.flush(timeout_sec=_MAX_SINK_WAIT_S)
            raise_failure()

        _send(replay, stream, wait_until_received, progress)


@contextmanager
def _stream_into(file: Path) -> Iterator[tuple[rr.RecordingStream, Callable[[], None]]]:
    """Yield a stream into a file, and a function that raises `OSError` if writing has failed."""
    # Rerun writes into a pipe, which a thread copies to the file: on a full disk rerun's writer would wait for ever.
    if sys.platform == "win32":
        # On Windows a pipe has no path.
        with recording_stream() as stream:
            stream.save(file)
            yield stream, lambda: None
        return
    pipe_out, pipe_in = os.pipe()
    failures: list[OSError] = []

    def copy_pipe_to_file() -> None:
        with open(pipe_out, "rb", buffering=0) as source_file:  # noqa: PTH123
            try:
                with file.open("wb") as target_file:
                    shutil.copyfileobj(source_file, target_file)
            except OSError as error:
                failures.append(error)
                while source_file.read(1 << 20):
                    pass

    def raise_failure() -> None:
        if failures:
            raise failures[0]

    thread = threading.Thread(target=copy_pipe_to_file, name="rrd")
    thread.start()
    try:
        with recording_stream() as stream:
            try:
                stream.save(f"/dev/fd/{pipe_in}")
            finally:
                os.close(pipe_in)
            yield stream, raise_failure
    finally:
        thread.join()
    raise_failure()


def draw_picture(
    replay: Replay,
    file: Path,
    at_s: float | None = None,
    progress: FractionProgress | None = None,
    size: tuple[int, int] = (1600, 1000),
) -> float:
    """Draw a replay into a PNG file without a window; return the drawn time [s].

    `at_s` counts from the start of the recording; None takes `largest_motion_s`. `size` is in pixels.

    Raises `SceneError` for any other suffix or a time outside the replay, `RunError` if the picture cannot be made.
    """
    _check_suffix(file, ".png", "screenshot")
    rate = replay.recording.rate
    time_s = replay.largest_motion_s if at_s is None else at_s
    if not replay.start / rate <= time_s <= replay.stop / rate:
        raise SceneError(
            f"`at` {time_s:g} s is outside the replay. Give a time from {replay.start / rate:g} s to "
            f"{replay.stop / rate:g} s."
        )
    prepare_outputs(file)
    with temporary_folder() as folder:
        rrd_path = folder / "replay.rrd"
        save(replay, rrd_path, progress)
        window_size = size[0], size[1] + _MENU_PIXELS
        png, views = headless_picture(
            rrd_path, time_s - replay.start / rate, window_size, (replay.stop - 1 - replay.start) / rate, _LAST_ENTITY
        )
    with atomic_write(file) as part, Image.open(BytesIO(png)) as drawn:
        drawn.crop((0, _MENU_PIXELS, *drawn.size)).save(part, "PNG")
    problems = [f"{view.name}: {report.summary}" for view in views for report in view.reports]
    if problems:
        raise RunError(f"{file}: parts of the picture could not be drawn ({'; '.join(problems)}). Draw it again.")
    return time_s


def window(remedy: str) -> AbstractContextManager[Viewer]:
    """Open a viewer in a window; raise `RunError`, which ends with the sentence `remedy`, if there is no display."""
    require_display(remedy)
    return viewer("--expect-data-soon")


def show(
    replay: Replay, viewer_context: AbstractContextManager[Viewer], progress: FractionProgress | None = None
) -> None:
    """Show a replay in a `window` or on a `server` until the viewer ends; raise `RunError` if it does not start."""
    with viewer_context as running:
        # The viewer keeps all samples in memory; if the memory is full, it drops the oldest samples.
        gigabytes = replay.n_values * _BYTES_PER_SAMPLE / 1e9
        if gigabytes > _NOTE_ABOVE_GB:
            print(
                f"note: the viewer will take about {gigabytes:.0f} GB of memory. To use less, show a part of the "
                "recording with `from_s` and `to_s`.",
                file=sys.stderr,
            )
        with recording_stream() as stream:
            stream.connect_grpc(running.url)
            try:
                _send(replay, stream, lambda: stream.flush(timeout_sec=_MAX_SINK_WAIT_S), progress)
            except RuntimeError as error:
                if running.process.poll() is None:
                    raise RunError(
                        f"the rerun viewer stopped receiving data ({error}). Show the recording again, or a part of it "
                        "with `from_s` and `to_s`."
                    ) from error
        running.process.wait()


@contextmanager
def server(announce: Callable[[str], None]) -> Iterator[Viewer]:
    """Serve the viewer to browsers on this machine; `announce` is called with the address."""
    page_port = free_port()
    # The server stores everything for later browsers.
    with viewer("--serve-web", "--web-viewer-port", str(page_port), "--server-memory-limit", "75%") as running:
        address = f"http://{LOOPBACK}:{page_port}/?url={quote(running.url, safe='')}"
        announce(address)
        if can_open_windows():
            webbrowser.open(address)
        yield running


@contextmanager
def recording_stream() -> Iterator[rr.RecordingStream]:
    """Yield a new stream, which is flushed to its viewer or file at the end."""
    # Python prints an exception if a stream is deleted that an interrupt left incomplete.
    with delayed_interrupt():
        stream = rr.RecordingStream(APPLICATION, recording_id=uuid4())
    try:
        yield stream
    finally:
        stream.disconnect()


def _send(
    replay: Replay,
    stream: rr.RecordingStream,
    wait_until_received: Callable[[], object],
    progress: FractionProgress | None,
) -> None:
    wait_until_received()
    # The layout is sent as active: a remembered layout of the application overrides a default layout.
    stream.send_blueprint(replay.blueprint(), make_active=True, make_default=True)
    replay.send(stream, wait_until_received, progress)
    # A viewer that has received this text has received all data before it.
    stream.log(_LAST_ENTITY, rr.TextDocument("all of the replay was sent"), static=True)
    wait_until_received()


def _check_suffix(file: Path, suffix: str, parameter: str) -> None:
    if file.suffix.lower() != suffix:
        raise SceneError(f"`{parameter}` {file}: expected a file name that ends in {suffix}")
