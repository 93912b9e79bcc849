"""Starting the rerun viewer: in a window, in the browser, or without either for a picture.

The viewer binary itself is started, not the `rerun` script around it: ending the script would leave its
viewer behind. It listens on 127.0.0.1 only.
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
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, TypeVar

import numpy as np

from rig.errors import RunError, ShotrigError

if TYPE_CHECKING:
    from rerun.experimental import View, ViewerClient, ViewerState

T = TypeVar("T")

LOOPBACK = "127.0.0.1"
# Maximum time for the start of the viewer, s.
_MAX_START_S = 30.0
# Maximum time for loading and drawing, s.
_MAX_LOAD_S = 300.0
# Interval of the checks, s.
_POLL_S = 0.1
# A picture is complete if it has not changed for this time, s, and for this multiple of its drawing time.
_MIN_STILL_S = 2.0
_STILL_DRAWING_TIMES = 5
# Size of the compared pictures, points.
_COMPARED_POINTS = 800
# Maximum time between the last drawn instant and the last sample, s.
_FRAME_S = 0.02
_SHORTER = "show a part of it with --from and --to"


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

    def ready(self) -> None:
        """Return once the viewer accepts connections; raise `RunError` if it does not start."""
        deadline = time.monotonic() + _MAX_START_S
        while time.monotonic() < deadline:
            if self.process.poll() is not None:
                raise RunError(_reason_of_end(self.output()))
            with socket.socket() as probe:
                if probe.connect_ex((LOOPBACK, self.port)) == 0:
                    return
            time.sleep(_POLL_S)
        raise RunError(
            f"the rerun viewer did not answer within {_MAX_START_S:g} s; its output:\n{_tail(self.output())}"
        )

    @contextmanager
    def connected_client(self) -> Iterator[ViewerClient]:
        """Yield a connection that drives the viewer; raise `RunError` if the viewer ends or stops answering."""
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
                raise RunError(f"the rerun viewer stopped answering: {error}") from error
            raise RunError(_reason_of_end(self.output())) from error


@contextmanager
def viewer(*options: str) -> Iterator[Viewer]:
    """Start a viewer on a free loopback port and end it on leaving; raise `RunError` if it cannot start."""
    port = free_port()
    command = [str(binary()), "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen", *options]
    # The viewer sends usage data to its makers unless it runs under CI.
    environment = {**os.environ, "CI": "true", "NO_COLOR": "1"}
    with (
        _sigterm_exits(),
        tempfile.TemporaryDirectory(prefix="shotrig-viewer-") as folder,
        (Path(folder) / "log").open("w", encoding="utf-8") as log,
    ):
        process = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=environment)
        running = Viewer(process, port, log)
        try:
            running.ready()
            yield running
        finally:
            process.terminate()
            try:
                process.wait(timeout=5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def _sigterm_exits() -> Iterator[None]:
    """Let SIGTERM exit this process regularly, so that the viewer is ended as well."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before or signal.SIG_DFL)


def binary() -> Path:
    """Return the path of the viewer binary of rerun-sdk; raise `RunError` if the installed one has none."""
    import rerun_cli

    folder = Path(rerun_cli.__file__).parent
    for name in ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun"):
        if (folder / name).is_file():
            return folder / name
    raise RunError(f"no rerun viewer in {folder}; install rerun-sdk again, or write a file with --save")


def free_port() -> int:
    """Return a free port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def can_open_windows() -> bool:
    """Return whether a window can be opened."""
    return not sys.platform.startswith("linux") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def need_display(instead: str) -> None:
    """Raise `RunError` with the remedy `instead` where no window can be opened."""
    if not can_open_windows():
        raise RunError(f"no display to open the viewer on (neither DISPLAY nor WAYLAND_DISPLAY is set); {instead}")


def picture(
    file: Path,
    after_s: float | None,
    size: tuple[int, int] = (1600, 1000),
    duration_s: float = 0.0,
    last: str | None = None,
) -> tuple[bytes, list[View]]:
    """Draw an .rrd or .mcap file without a window; return the rerun views with what each could not draw.

    The time cursor is `after_s` after the first datum; the content is at least `duration_s` long, and the viewer waits
    for the entity `last`. `size` is in points. Raises `RunError` if the file does not load or not all of it is shown.
    """
    window = ("--headless", "--window-size", f"{size[0]}x{size[1]}")
    with viewer(*window, str(file.resolve())) as running, running.connected_client() as client:
        recording = _await_loading(client, duration_s, last).recordings[0]
        line = next((each for each in recording.timelines if each.name == recording.current_timeline), None)
        if after_s is not None and line is not None and line.start is not None:
            instant = line.start + round(after_s * 1e9)
            if line.time_type == "timestamp":
                client.set_time(line.name, timestamp=np.datetime64(instant, "ns"), play_state="paused")
            else:
                client.set_time(line.name, duration=np.timedelta64(instant, "ns"), play_state="paused")
        _await_still_picture(client)
        png = _retry(client.take_screenshot)
        # A viewer that is short of memory drops the oldest data.
        state = _retry(client.get_state)
        if not _has_duration(state, duration_s):
            raise RunError(f"the viewer ran out of memory for {duration_s:.0f} s; {_SHORTER}")
        return png, state.views


def _await_loading(client: ViewerClient, duration_s: float, last: str | None) -> ViewerState:
    """Wait until the viewer has the whole recording: its first and last instants, and its last entity."""
    deadline = time.monotonic() + _MAX_LOAD_S
    while time.monotonic() < deadline:
        state = _retry(client.get_state)
        if not state.loading and _has_duration(state, duration_s):
            if last is None:
                return state
            schema = _retry(lambda: client.get_recording_schema(entity_path=f"/{last}"))
            if any(entity.entity_path.strip("/") == last for entity in schema.entities):
                return state
        time.sleep(_POLL_S)
    raise RunError(f"the viewer did not load the recording within {_MAX_LOAD_S:g} s; {_SHORTER}")


def _retry(ask: Callable[[], T]) -> T:
    """Repeat a request that timed out: drawing without a graphics card is slow."""
    deadline = time.monotonic() + _MAX_LOAD_S
    while True:
        try:
            return ask()
        except Exception as error:
            if "deadline" not in str(error).lower() or time.monotonic() > deadline:
                raise


def _has_duration(state: ViewerState, duration_s: float) -> bool:
    """Return whether the times of the recording have the expected range."""
    return bool(state.recordings) and any(
        line.start is not None and line.end and line.end - line.start >= (duration_s - _FRAME_S) * 1e9
        for line in state.recordings[0].timelines
    )


def _await_still_picture(client: ViewerClient) -> None:
    """Wait until the picture does not change any more: fonts, plots and images appear over several frames.

    On a busy machine a long trace arrives in pieces, with pictures in between that look complete.
    """
    before, since = b"", time.monotonic()
    deadline = time.monotonic() + _MAX_LOAD_S
    while time.monotonic() < deadline:
        began = time.monotonic()
        now = _retry(lambda: client.take_screenshot(max_size=_COMPARED_POINTS))
        if now != before:
            before, since = now, began
        # A viewer that draws slowly also needs longer for the next part of the picture.
        elif began - since >= max(_MIN_STILL_S, _STILL_DRAWING_TIMES * (time.monotonic() - began)):
            return
        time.sleep(_POLL_S)
    raise RunError(f"the viewer's picture did not come to rest within {_MAX_LOAD_S:g} s; {_SHORTER}")


def _reason_of_end(output: str) -> str:
    if "graphics adapter" in output or "render context" in output:
        return (
            "the viewer found no graphics device (Vulkan); on Debian and Ubuntu "
            "`apt-get install mesa-vulkan-drivers libvulkan1` installs one that needs no graphics card"
        )
    return f"the rerun viewer ended at once; its output:\n{_tail(output)}"


def _tail(text: str, lines: int = 12) -> str:
    return "\n".join(text.strip().splitlines()[-lines:])
