"""A served rig: live display, live recording, network addresses, and access by certificates."""

import contextlib
import gc
import socket
import subprocess
import sys
import weakref

import grpc
import nidaqmx
import pytest
from nidaqmx.system import System

import daq
import rig
from daq.core.recording.committed_file import RESERVE, CommittedFile
from daq.extras.ni_device.connecting import connect_scene
from daq.extras.ni_device.engines.log import MarkedRecording
from daq.extras.ni_server.client_defaults import open_channel
from daq.extras.ni_server.live import LiveRecording
from daq.extras.ni_server.serve import Certificates, _endpoint, _is_loopback, collect_garbage_often, parse_address
from daq.extras.ni_server.served_instrument import Limits, ServedInstrument
from daq.extras.ni_server.service import Server
from rig.core.base.errors import RunError, SceneError
from tests.daq.recording.recordings import file_size_limit


@pytest.fixture
def certificate(tmp_path):
    """Return a function that makes a self-signed certificate and its key, and returns their paths."""

    def make(name):
        key, path = tmp_path / f"{name}.key", tmp_path / f"{name}.pem"
        command = "openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=localhost"
        subprocess.run(
            [*command.split(), "-addext", "subjectAltName=DNS:localhost", "-keyout", key, "-out", path],
            check=True,
            capture_output=True,
        )
        return path, key

    return make


@pytest.mark.thorough
def test_certificates_admit_only_their_clients(certificate):
    server_pair, known_pair, unknown_pair = (certificate(name) for name in ("server", "known", "unknown"))
    chassis = connect_scene("bare-structure", "fast")
    server = Server(chassis, "localhost:0", Certificates(*server_pair, clients=known_pair[0]).credentials())

    def devices(*client_pair, expected_server=server_pair[0]):
        pem_contents = [path.read_bytes() for path in reversed(client_pair)] or [None, None]
        credentials = grpc.ssl_channel_credentials(expected_server.read_bytes(), *pem_contents)
        with grpc.secure_channel(f"localhost:{server.port}", credentials) as channel:
            return System.remote(nidaqmx.GrpcSessionOptions(channel, "")).devices.device_names

    with contextlib.closing(server):
        assert "cDAQ1Mod1" in devices(*known_pair)
        for rejected_pair in ((), unknown_pair):
            with pytest.raises(Exception, match=r"(?i)unavailable|handshake|connect"):
                devices(*rejected_pair)
        with pytest.raises(Exception, match=r"(?i)unavailable|certificate|connect"):
            devices(*known_pair, expected_server=unknown_pair[0])
        assert "cDAQ1Mod1" in devices(*known_pair)


@pytest.mark.parametrize("address", ["::1", "[::1]", "[::1]:0", "localhost:0"])
def test_server_listens_at_ipv6_and_names(address):
    host, port = parse_address(address, 0)
    try:
        socket.getaddrinfo(host, 0)
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
    except OSError:
        pytest.skip("this machine has no IPv6")
    assert _is_loopback(host)
    server = Server(connect_scene("bare-structure", "fast"), _endpoint(host, port))
    try:
        options = nidaqmx.GrpcSessionOptions(open_channel(_endpoint(host, server.port)), "")
        assert "cDAQ1Mod1" in System.remote(options).devices.device_names
    finally:
        server.close()


@pytest.mark.parametrize("address", ["", "[::1", "[::1]x:4", "localhost:port", "localhost:70000", "[::1]:-1"])
def test_invalid_address_is_rejected(address):
    with pytest.raises(SceneError, match="HOST:PORT"):
        parse_address(address, 0)


def test_used_port_is_one_message():
    with socket.create_server(("127.0.0.1", 0)) as used:
        command = [sys.executable, "-m", "daq", "serve", "fig9", "--port", str(used.getsockname()[1])]
        result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode and result.stderr.startswith("error: cannot listen at") and result.stderr.count("\n") == 1


def test_name_with_a_public_address_is_not_loopback(monkeypatch):
    for addresses, expected in ((["::1", "127.0.0.1"], True), (["::1", "192.0.2.1"], False)):
        answer = [(0, 0, 0, "", (address, 0)) for address in addresses]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, answer=answer: answer)
        assert _is_loopback("a.name") is expected


def test_live_recording_marks_overloads(tmp_path):
    scene = rig.load("bare-structure", {"converter.bits": 24, "converter.range": "1 mV"})
    with daq.connect(scene, clock="fast") as connection, nidaqmx.Task(grpc_options=connection) as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0", min_val=-1e-3, max_val=1e-3)
        task.timing.cfg_samp_clk_timing(5120.0, samps_per_chan=2000)
        with contextlib.closing(LiveRecording(connection.chassis, tmp_path / "run.mcap")):
            task.read(2000)
    with daq.open(tmp_path / "run.mcap") as recording:
        assert {mark.kind for mark in recording.markers} == {"overload"}


def test_failed_recording_does_not_stop_clients(tmp_path, capsys):
    path = tmp_path / "new" / "run.mcap"
    with daq.connect("bare-structure", clock="fast") as connection, nidaqmx.Task(grpc_options=connection) as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0", min_val=-500, max_val=500)
        task.timing.cfg_samp_clk_timing(5120.0, samps_per_chan=100)
        with contextlib.closing(LiveRecording(connection.chassis, path)):
            path.write_bytes(b"existing file")
            assert [len(task.read(100)) for _ in range(2)] == [100, 100]
    assert capsys.readouterr().err.count("run.mcap") == 1
    assert path.read_bytes() == b"existing file"


@pytest.fixture
def recorded_bench(tmp_path):
    """A bench on the manual clock that records, and its recording."""
    chassis = connect_scene("bare-structure", "manual")
    chassis.clock.start(chassis)
    return chassis, LiveRecording(chassis, tmp_path / "run.mcap")


def test_full_disk_completes_the_live_recording(recorded_bench, monkeypatch):
    chassis, recording = recorded_bench
    chassis.clock.advance(1.2)
    monkeypatch.setattr(CommittedFile, "free", lambda _: RESERVE)
    chassis.clock.advance(1.0)
    recording.close()
    with daq.open(recording.paths[0]) as opened:
        assert (opened.status, opened.samples / opened.rate) == ("failed", 1.0)
    with pytest.raises(RunError, match=r"the recording has ended.*disk is full.*first 1\.00 s"):
        chassis.raise_problems()


def test_failing_disk_names_the_recovery(recorded_bench):
    chassis, recording = recorded_bench
    chassis.clock.advance(0.6)
    with file_size_limit(recording.paths[0].stat().st_size):
        chassis.clock.advance(1.0)
    recording.close()
    assert "daq recover" in chassis.problems[0] and len(chassis.problems) == 1


def test_moved_live_recording_is_complete(recorded_bench, tmp_path):
    chassis, recording = recorded_bench
    chassis.clock.advance(0.2)
    recording.paths[0].rename(tmp_path / "moved.mcap")
    chassis.clock.advance(2.0)
    recording.close()
    with daq.open(tmp_path / "moved.mcap") as opened:
        assert opened.samples / opened.rate == pytest.approx(2.2)
    assert "was moved" in chassis.problems[0]


def test_unexpected_error_of_recording_is_reported(recorded_bench, monkeypatch):
    chassis, recording = recorded_bench
    monkeypatch.setattr(MarkedRecording, "write", lambda *_: 1 // 0)
    chassis.clock.advance(1.0)
    recording.close()
    assert "ZeroDivisionError" in chassis.problems[0] and chassis.position


def test_recording_without_samples_is_reported(tmp_path, capsys):
    LiveRecording(connect_scene("bare-structure", "fast"), tmp_path / "run.mcap").close()
    assert "run.mcap: nothing was recorded" in capsys.readouterr().err


def test_closed_tasks_do_not_accumulate():
    sessions = ServedInstrument(connect_scene("bare-structure", "fast"), Limits()).sessions
    tasks = weakref.WeakSet()
    previous = gc.get_threshold()
    # The threshold of the command line.
    gc.set_threshold(500_000)
    try:
        collect_garbage_often()
        for _ in range(3000):
            name, _ = sessions.open("", 0, "peer")
            tasks.add(sessions.find(name, "peer"))
            sessions.close(name, "peer")
        assert len(tasks) < 1000
    finally:
        gc.set_threshold(*previous)
        gc.unfreeze()
