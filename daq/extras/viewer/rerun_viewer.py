"""The viewer of rerun-sdk, which draws replays: in a window, in a browser, or without a display for a picture.

The viewer receives data and commands on a port of 127.0.0.1. Its parent is a guard, a process that ends the viewer when
the pipe from this process is closed, even if this process is killed. The guard starts the viewer's binary, not the
script `rerun`, because ending the script would leave the viewer running.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, TypeVar

import numpy as np

from rig.core.base.errors import RunError, ShotrigError

if TYPE_CHECKING:
    from rerun.experimental import View, ViewerClient, ViewerState

T = TypeVar("T")

LOOPBACK = "127.0.0.1"
# Longest wait [s] for the start of the viewer, even on a loaded computer.
_MAX_START_S = 30.0
# The viewer is killed if it has not ended after this time [s].
_MAX_END_S = 5.0
# Script of the guard. Its arguments are the folder of the viewer's files and the command of the viewer. At a regular
# end, this process sends a byte. If it was killed, the guard removes the folder.
_GUARD = f"""
import shutil, signal, subprocess, sys, threading
folder, *command = sys.argv[1:]
viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL)
signal.signal(signal.SIGINT, signal.SIG_IGN)
is_ending = threading.Event()
def end():
    was_killed = not sys.stdin.buffer.read()
    is_ending.set()
    viewer.terminate()
    try:
        viewer.wait({_MAX_END_S})
    except subprocess.TimeoutExpired:
        viewer.kill()
    if was_killed:
        shutil.rmtree(folder, ignore_errors=True)
end_thread = threading.Thread(target=end, daemon=True)
end_thread.start()
code = viewer.wait()
if is_ending.is_set():
    end_thread.join()
sys.exit(code)
"""
# Longest wait [s] for loading and drawing with a software driver.
_MAX_LOAD_S = 300.0
# Interval between checks of the viewer's state [s].
_POLL_S = 0.1
# A picture is complete when it has been unchanged for two times. The first time [s]:
_MIN_UNCHANGED_S = 2.0
# The second time, as a multiple of the time in which the picture is drawn.
_MIN_UNCHANGED_DRAWINGS = 5
# Size of the pictures that are compared for changes [points]; small pictures are drawn quickly.
_COMPARED_POINTS = 800
# Largest difference of the viewer's duration from that of a completely loaded recording [s].
_END_TOLERANCE_S = 0.02
_SHOW_PART = "Show a part of it with `from_s` and `to_s`."


class Viewer:
    """A running viewer, which listens at `port` for data and commands."""

    def __init__(self, process: subprocess.Popen[bytes], port: int, log: TextIO) -> None:
        self.process = process
        self.port = port
        self._log = log

    @property
    def url(self) -> str:
        """Address for `RecordingStream.connect_grpc` and for `ViewerClient`."""
        return f"rerun+http://{LOOPBACK}:{self.port}/proxy"

    def output(self) -> str:
        """Return the output of the viewer so far."""
        return Path(self._log.name).read_text(encoding="utf-8", errors="replace")

    def wait_until_ready(self) -> None:
        """Return once the viewer accepts connections; raise `RunError` if it does not start."""
        deadline = time.monotonic() + _MAX_START_S
        while time.monotonic() < deadline:
            if self.process.poll() is not None:
                raise RunError(_end_reason(self.output()))
            with socket.socket() as probe:
                if probe.connect_ex((LOOPBACK, self.port)) == 0:
                    return
            time.sleep(_POLL_S)
        raise RunError(
            f"the rerun viewer did not start within {_MAX_START_S:g} s. Close other programs, and try again. Output of "
            f"the viewer:\n{_last_lines(self.output())}"
        )

    @contextmanager
    def connected_client(self) -> Iterator[ViewerClient]:
        """Yield a client that sends commands to the viewer; raise `RunError` if the viewer ends or stops answering."""
        from rerun.experimental import ViewerClient

        deadline = time.monotonic() + _MAX_START_S
        try:
            while True:
                try:
                    client = ViewerClient.connect(self.url)
                    client.get_state()
                    break
                except Exception:
                    # The exception depends on the progress of the viewer's start.
                    if self.process.poll() is not None or time.monotonic() > deadline:
                        raise
                    time.sleep(_POLL_S)
            yield client
        except ShotrigError:
            raise
        except Exception as error:
            try:
                # A viewer without a graphics device closes its connections before it ends.
                self.process.wait(timeout=2.0)
            except subprocess.TimeoutExpired:
                raise RunError(f"the rerun viewer stopped answering ({error}). Start it again.") from error
            raise RunError(_end_reason(self.output())) from error


@contextmanager
def viewer(*options: str) -> Iterator[Viewer]:
    """Start a viewer on a free loopback port and end it on leaving; raise `RunError` if it cannot start."""
    port = free_port()
    viewer_command = [str(binary()), "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen", *options]
    # The viewer sends usage data to its makers unless it runs under CI.
    environment = {**os.environ, "CI": "true", "NO_COLOR": "1"}
    with (
        _sigterm_exits(),
        tempfile.TemporaryDirectory(prefix="shotrig-viewer-") as folder,
        (Path(folder) / "log").open("w", encoding="utf-8") as log,
    ):
        # The viewer leaves temporary files behind.
        environment |= dict.fromkeys(("TMPDIR", "TEMP", "TMP"), folder)
        command = [sys.executable, "-I", "-S", "-c", _GUARD, folder, *viewer_command]
        process = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.PIPE, env=environment)
        running = Viewer(process, port, log)
        try:
            running.wait_until_ready()
            yield running
        finally:
            # Writing fails if the viewer has ended.
            with suppress(OSError, subprocess.TimeoutExpired):
                process.communicate(b"end", timeout=2.0 * _MAX_END_S)


@contextmanager
def _sigterm_exits() -> Iterator[None]:
    """Convert SIGTERM to `SystemExit` so that the viewer is ended with this process."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous or signal.SIG_DFL)


def binary() -> Path:
    """Return the path of the viewer binary of rerun-sdk; raise `RunError` if the installed package has none."""
    import rerun_cli

    folder = Path(rerun_cli.__file__).parent
    for name in ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun"):
        if (folder / name).is_file():
            return folder / name
    raise RunError(f"there is no rerun viewer in {folder}. Install rerun-sdk again, or write a file with `save`.")


def free_port() -> int:
    """Return a free port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def can_open_windows() -> bool:
    """Return whether a window can be opened."""
    return not sys.platform.startswith("linux") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def require_display(remedy: str) -> None:
    """Raise `RunError` with a remedy (a sentence) if no window can be opened."""
    if not can_open_windows():
        raise RunError(f"no display for the viewer (neither DISPLAY nor WAYLAND_DISPLAY is set). {remedy}")


def headless_picture(
    file: Path, after_s: float | None, size: tuple[int, int], duration_s: float = 0.0, last_entity: str | None = None
) -> tuple[bytes, list[View]]:
    """Draw an .rrd or .mcap file without a window; return the PNG, and the views with reports of drawing problems.

    The time cursor is placed `after_s` after the first datum. The picture is taken when the viewer has loaded at least
    `duration_s` of data and the entity `last_entity`. `size` is in points. Raises `RunError` if loading fails.
    """
    window = ("--headless", "--window-size", f"{size[0]}x{size[1]}")
    with viewer(*window, str(file.resolve())) as running, running.connected_client() as client:
        recording = _await_loading(client, duration_s, last_entity).recordings[0]
        timeline = next(
            (candidate for candidate in recording.timelines if candidate.name == recording.current_timeline), None
        )
        if after_s is not None and timeline is not None and timeline.start is not None:
            instant = timeline.start + round(after_s * 1e9)
            if timeline.time_type == "timestamp":
                client.set_time(timeline.name, timestamp=np.datetime64(instant, "ns"), play_state="paused")
            else:
                client.set_time(timeline.name, duration=np.timedelta64(instant, "ns"), play_state="paused")
        _await_unchanged_picture(client)
        png = _retry_timeouts(client.take_screenshot)
        # A viewer that is short of memory drops the oldest data.
        state = _retry_timeouts(client.get_state)
        if not _has_duration(state, duration_s):
            raise RunError(f"the viewer's memory is too small for this recording of {duration_s:.0f} s. {_SHOW_PART}")
        return png, state.views


def _await_loading(client: ViewerClient, duration_s: float, last_entity: str | None) -> ViewerState:
    """Wait until the viewer has loaded the whole recording: its duration, and the entity that is sent last."""
    deadline = time.monotonic() + _MAX_LOAD_S
    while time.monotonic() < deadline:
        state = _retry_timeouts(client.get_state)
        if not state.loading and _has_duration(state, duration_s):
            if last_entity is None:
                return state
            schema = _retry_timeouts(lambda: client.get_recording_schema(entity_path=f"/{last_entity}"))
            if any(entity.entity_path.strip("/") == last_entity for entity in schema.entities):
                return state
        time.sleep(_POLL_S)
    raise RunError(f"the viewer did not load the recording within {_MAX_LOAD_S:g} s. {_SHOW_PART}")


def _retry_timeouts(request: Callable[[], T]) -> T:
    """Return the answer to a request, which is repeated after a timeout: drawing without a graphics card is slow."""
    deadline = time.monotonic() + _MAX_LOAD_S
    while True:
        try:
            return request()
        except Exception as error:
            if "deadline" not in str(error).lower() or time.monotonic() > deadline:
                raise


def _has_duration(state: ViewerState, duration_s: float) -> bool:
    """Return whether a timeline of the recording covers the expected duration."""
    return bool(state.recordings) and any(
        timeline.start is not None
        and timeline.end
        and timeline.end - timeline.start >= (duration_s - _END_TOLERANCE_S) * 1e9
        for timeline in state.recordings[0].timelines
    )


def _await_unchanged_picture(client: ViewerClient) -> None:
    """Wait until the picture no longer changes: fonts, plots and images appear over several frames."""
    # On a busy machine a long trace arrives in pieces, and a picture between two pieces looks complete.
    previous, unchanged_since = b"", time.monotonic()
    deadline = time.monotonic() + _MAX_LOAD_S
    while time.monotonic() < deadline:
        request_start = time.monotonic()
        current = _retry_timeouts(lambda: client.take_screenshot(max_size=_COMPARED_POINTS))
        if current != previous:
            previous, unchanged_since = current, request_start
        # A viewer that draws slowly also needs longer for the next part of the picture.
        elif request_start - unchanged_since >= max(
            _MIN_UNCHANGED_S, _MIN_UNCHANGED_DRAWINGS * (time.monotonic() - request_start)
        ):
            return
        time.sleep(_POLL_S)
    raise RunError(f"the viewer did not finish its picture within {_MAX_LOAD_S:g} s. {_SHOW_PART}")


def _end_reason(output: str) -> str:
    if "graphics adapter" in output or "render context" in output:
        return (
            "the viewer found no graphics device (Vulkan). Install a software driver; a graphics card is not needed: "
            "on Debian and Ubuntu, `apt-get install mesa-vulkan-drivers libvulkan1`"
        )
    return f"the rerun viewer ended unexpectedly. Its output:\n{_last_lines(output)}"


def _last_lines(text: str) -> str:
    return "\n".join(text.strip().splitlines()[-12:])
