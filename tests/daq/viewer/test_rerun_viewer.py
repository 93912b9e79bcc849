"""The rerun viewer itself: pictures with a graphics device, a clear message without; sessions in the browser."""

import ctypes.util
import os
import signal
import socket
import struct
import subprocess
import sys
import urllib.request
from pathlib import Path

import psutil
import pytest

import daq
import rig
from daq.commands.cli import main
from daq.extras.viewer.outputs import draw_picture
from daq.extras.viewer.replay import Replay
from daq.extras.viewer.rerun_viewer import LOOPBACK, free_port, headless_picture, viewer
from rig.core.base.errors import RunError, SceneError

DRIVER_FOLDERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
PACKAGES = "mesa-vulkan-drivers libvulkan1"


def has_vulkan():
    drivers = [driver for folder in DRIVER_FOLDERS for driver in Path(folder).glob("*.json")]
    return ctypes.util.find_library("vulkan") is not None and bool(drivers)


@pytest.fixture(scope="module")
def recording_path(tmp_path_factory):
    scene = rig.load("fig9").replace(
        test={"kind": "sine", "frequency": "49.7 Hz", "drive": "3 V", "duration": "0.5 s"},
        recording={"truth": True, "display": True},
    )
    return daq.record(scene, tmp_path_factory.mktemp("viewer") / "fig9.mcap")


@pytest.fixture
def run_daq(monkeypatch, capsys):
    """Return a function that runs `daq` in this process, without a display; it returns exit status and stderr."""

    def run(*arguments):
        for name in DISPLAYS:
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr(sys, "argv", ["daq", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        return end.value.code, capsys.readouterr().err

    return run


def without_display(environment):
    """Return the environment with these variables, but without a display, so that no test opens a window."""
    return {key: value for key, value in os.environ.items() if key not in DISPLAYS} | environment


def png_size(png):
    assert png.startswith(b"\x89PNG")
    return struct.unpack(">II", png[16:24])


@pytest.mark.thorough
def test_picture_draws_every_view(recording_path, tmp_path):
    file = tmp_path / "replay.png"
    with daq.open(recording_path) as recording:
        replay = Replay(recording)
        if not has_vulkan():
            with pytest.raises(RunError, match=PACKAGES):
                draw_picture(replay, file, size=(1200, 800))
            return
        draw_picture(replay, file, size=(1200, 800))
    assert png_size(file.read_bytes()) == (1200, 800)


@pytest.mark.thorough
def test_rerun_shows_plots_and_rig_of_recording(recording_path):
    if not has_vulkan():
        with pytest.raises(RunError, match=PACKAGES):
            headless_picture(recording_path, 0.3, (1000, 700))
        return
    png, views = headless_picture(recording_path, 0.3, (1000, 700))
    assert png_size(png) == (1000, 700)
    assert [report for view in views for report in view.reports] == []
    kinds = [view.view_class for view in views]
    assert kinds.count("3D") == 1
    assert kinds.count("TimeSeries") >= 4


def test_missing_graphics_device_names_the_packages(recording_path, tmp_path, monkeypatch):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, str(tmp_path / "none.json"))
    with pytest.raises(RunError, match=PACKAGES):
        headless_picture(recording_path, None, (400, 300))


def test_viewer_listens_on_loopback_and_ends():
    page_port = free_port()
    with viewer("--serve-web", "--web-viewer-port", str(page_port)) as session:
        for port in (session.port, page_port):
            with socket.socket() as client:
                # A viewer that listens on all interfaces would answer at this address of the machine.
                assert client.connect_ex(("127.0.0.2", port)) != 0
        with urllib.request.urlopen(f"http://{LOOPBACK}:{page_port}/", timeout=10) as answer:
            assert b"<html" in answer.read().lower()
    assert session.process.returncode is not None
    with socket.socket() as client:
        assert client.connect_ex((LOOPBACK, session.port)) != 0


def test_viewer_error_is_reported():
    with pytest.raises(RunError, match="--no-such-option"), viewer("--no-such-option"):
        pass


def test_browser_session_ends_quietly_on_interrupt(recording_path):
    command = [
        sys.executable,
        "-c",
        "from daq.commands.cli import main; main()",
        "replay",
        str(recording_path),
        "--web",
    ]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=without_display({"PYTHONUNBUFFERED": "1"}),
    ) as session:
        assert session.stdout is not None and session.stderr is not None
        address = session.stdout.readline().strip()
        assert address.startswith(f"http://{LOOPBACK}:")
        with urllib.request.urlopen(address, timeout=10) as answer:
            assert answer.status == 200
        session.send_signal(signal.SIGINT)
        assert session.wait(timeout=30) == 0
        assert "Traceback" not in session.stderr.read()


@pytest.mark.parametrize(
    ("content", "message"), [(None, "cannot be opened"), (b"", "is empty"), (bytes(range(256)) * 8, "MCAP")]
)
def test_missing_recording_ends_with_one_line(run_daq, tmp_path, content, message):
    file = tmp_path / "what.mcap"
    if content is not None:
        file.write_bytes(content)
    code, stderr = run_daq("replay", file, "--save", tmp_path / "x.rrd")
    assert code == 2
    assert "error:" in stderr and message in stderr
    assert "Traceback" not in stderr
    assert not (tmp_path / "x.rrd").exists()


def test_missing_display_names_other_outputs(run_daq, recording_path):
    code, stderr = run_daq("replay", recording_path)
    assert code == 1
    for option in ("--web", "--screenshot", "--save"):
        assert option in stderr


def test_two_outputs_at_once_are_rejected(run_daq, recording_path, tmp_path):
    code, stderr = run_daq("replay", recording_path, "--web", "--save", tmp_path / "x.rrd")
    assert code == 2
    assert "choose one" in stderr


def test_instant_outside_the_recording_is_rejected(recording_path, tmp_path):
    with daq.open(recording_path) as recording, pytest.raises(SceneError, match=r"outside the replay.*0\.5 s"):
        draw_picture(Replay(recording), tmp_path / "x.png", at_s=9.0)


def test_viewer_ends_with_a_killed_command(tmp_path):
    code = (
        "from daq.extras.viewer.rerun_viewer import viewer\n"
        "with viewer('--serve-web', '--web-viewer-port', '0') as session:\n"
        "    print(session.port, flush=True); input()"
    )
    environment = without_display({"TMPDIR": str(tmp_path)})
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as process:
        port = int(process.stdout.readline())
        (guard,) = psutil.Process(process.pid).children()
        (shown,) = guard.children()
        process.kill()
    psutil.wait_procs([guard, shown], timeout=60.0)
    assert not guard.is_running() and not shown.is_running() and not list(tmp_path.iterdir())
    with socket.socket() as client:
        assert client.connect_ex((LOOPBACK, port)) != 0
