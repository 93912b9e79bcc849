"""Run `daq bench` and `daq serve` as a user does, and kill or interrupt them while they record."""

import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from urllib.parse import urlsplit

import grpc
import nidaqmx
import numpy as np
import yaml
from nidaqmx.constants import AcquisitionType
from websockets.sync.client import connect

import daq
from rig.core.base.ending_signals import TERMINATION_SIGNALS
from rig.core.base.errors import ShotrigError
from tests.soak.command import CommandResult, run_new_process

# Longest time in which a server starts, answers its user or ends on a busy machine.
PATIENCE_S = 60.0
# Latest time of a signal after the first samples.
_LATEST_SIGNAL_S = 3.0
# At rest and without noise before the test: recordings of one test are equal from its first force.
_SCENE = {
    "structure": {"masses": [1.0, 0.5], "springs": [4e4, 2e4], "damping": {"modal": "1 %"}},
    "shaker": {"kind": "force", "body": 1},
    "test": {"kind": "swept_sine", "from": "10 Hz", "to": "30 Hz", "duration": "20 s", "force": "1 N"},
    "channels": [
        {"name": "body1", "at": "body 1", "accelerometer": {"sensitivity": "100 mV/g"}},
        {"name": "force", "at": "shaker"},
    ],
    "converter": {"rate": "1024 Hz", "bits": 24, "range": "5 V"},
}


class Server:
    """A running `daq bench` or `daq serve`."""

    def __init__(self, words: list[str], folder: Path) -> None:
        self._words, self._start = words, time.monotonic()
        self.process = subprocess.Popen(
            [sys.executable, "-m", *words], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self._watchdog = threading.Timer(5.0 * PATIENCE_S, self.process.kill)
        self._watchdog.daemon = True
        self._watchdog.start()
        assert self.process.stdout is not None
        self.printed, match = "", None
        while match is None and (line := self.process.stdout.readline()):
            self.printed += line
            match = re.search(r"(?<!//)127\.0\.0\.1:\d+", line)
        self.page = "".join(re.findall(r"^http\S+", self.printed, re.MULTILINE))
        """Address of the page of a bench, with its token."""
        self.device = "" if match is None else match[0]
        """Address of the device; empty if the program has ended."""

    def peak_memory(self) -> int:
        """Return the largest resident memory until now, bytes; 0 if the program has ended."""
        match = re.search(r"VmHWM:\s*(\d+) kB", Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii"))
        return 0 if match is None else 1024 * int(match[1])

    def end(self, signal_number: signal.Signals = signal.SIGINT) -> tuple[CommandResult, list[str]]:
        """End the program by a signal."""
        memory, faults = self.peak_memory(), []
        self.process.send_signal(signal_number)
        try:
            output, _ = self.process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            output, _ = self.process.communicate()
            faults.append("does not end")
        self._watchdog.cancel()
        seconds = time.monotonic() - self._start
        words, code = tuple(self._words), self.process.returncode
        return CommandResult(words, code, self.printed + output, seconds, memory), faults


def interrupt_server(folder: Path, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Kill or interrupt a bench or a server while it records; all samples until then must be right."""
    name = rng.choice(list(_USERS))
    expected = _expected_samples(name)
    signal_number = rng.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGKILL, *TERMINATION_SIGNALS))
    result, faults = _session(name, folder, rng.uniform(0.0, _LATEST_SIGNAL_S), signal_number)
    if signal_number == signal.SIGKILL:
        result = replace(result, code=0)
    path = folder / "r.mcap"
    if not path.exists():
        is_expected = signal_number == signal.SIGKILL or "nothing was recorded" in result.output
        return result, faults + ([] if is_expected else ["file lost"])
    if signal_number == signal.SIGKILL:
        recovered = run_new_process(["daq", "recover", "r.mcap", "-o", "fixed.mcap"], folder)
        faults += recovered.faults
        if recovered.code and "nothing can be recovered" in recovered.output:
            return result, faults
        path = folder / "fixed.mcap"
    return result, faults + _sample_faults(path, expected)


def _session(name: str, folder: Path, seconds: float, signal_number: signal.Signals) -> tuple[CommandResult, list[str]]:
    """Use a bench or a server, which record in r.mcap, for a time; then send a signal."""
    options, use = _USERS[name]
    (folder / "s.yaml").write_text(yaml.safe_dump(_SCENE))
    server = Server(["daq", name, "s.yaml", "--port", "0", *options, "-o", "r.mcap"], folder)
    use(server, seconds)
    return server.end(signal_number)


def _use_page(bench: Server, seconds: float) -> None:
    """Record a test of the page for a time."""
    address = urlsplit(bench.page)
    with connect(f"ws://{address.netloc}/live?{address.query}", max_size=None, open_timeout=PATIENCE_S) as live:
        for command in ('["record", true]', '["start", null]'):
            live.send(command)
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            live.recv(timeout=PATIENCE_S)


def _use_device(server: Server, seconds: float) -> None:
    """Drive the shaker and read the inputs for a time, as a script with NI's client does."""
    drive = np.random.default_rng(1).uniform(-1.0, 1.0, 20_000)
    with grpc.insecure_channel(server.device) as channel:
        options = nidaqmx.GrpcSessionOptions(channel, "")
        with nidaqmx.Task(grpc_options=options) as inputs, nidaqmx.Task(grpc_options=options) as outputs:
            inputs.ai_channels.add_ai_voltage_chan("Dev1/ai0:1")
            outputs.ao_channels.add_ao_voltage_chan("Dev1/ao0")
            for task in (inputs, outputs):
                task.timing.cfg_samp_clk_timing(1024.0, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=2048)
            outputs.write(drive)
            outputs.start()
            inputs.start()
            deadline = time.monotonic() + seconds
            while time.monotonic() < deadline:
                inputs.read(256)


# Options of the programs, and their users.
_USERS: dict[str, tuple[list[str], Callable[[Server, float], None]]] = {
    "bench": (["--no-browser", "--device-port", "0"], _use_page),
    "serve": (["--clock", "fast"], _use_device),
}


def _forced_samples(path: Path) -> np.ndarray:
    """Return the samples of a recording from the first force, shape (channels, samples)."""
    with daq.open(path) as recording:
        recording.check()
        samples = np.stack([recording.read(name) for name in ("body1", "force")])
    return samples[:, np.argmax(samples[1] != 0.0) if samples[1].any() else samples.shape[1] :]


@cache
def _expected_samples(name: str) -> np.ndarray:
    """Return the samples of an undisturbed session."""
    with tempfile.TemporaryDirectory() as folder:
        _session(name, Path(folder), 2.0 * _LATEST_SIGNAL_S, signal.SIGINT)
        return _forced_samples(Path(folder) / "r.mcap")


def _sample_faults(path: Path, expected: np.ndarray) -> list[str]:
    try:
        samples = _forced_samples(path)
    except ShotrigError:
        return ["not readable"]
    n_samples = min(samples.shape[1], expected.shape[1])
    return [] if np.array_equal(samples[:, :n_samples], expected[:, :n_samples]) else ["wrong samples"]
