"""A signal that ends `daq run` also ends its script: no process remains, and the log is readable."""

import contextlib
import os
import signal
import subprocess
import sys

import pytest

import daq
from daq.server import signal_forwarding

pytestmark = pytest.mark.skipif(os.name != "posix", reason="Windows cannot send a signal to a single process")

SCRIPT = """
import os, signal, sys
import nidaqmx
from nidaqmx.constants import AcquisitionType, LoggingMode, LoggingOperation
BEFORE
with nidaqmx.Task() as task:
    task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:3", min_val=-500.0, max_val=500.0)
    task.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.CONTINUOUS)
    task.in_stream.configure_logging(
        sys.argv[1], LoggingMode.LOG_AND_READ, operation=LoggingOperation.CREATE_OR_REPLACE
    )
    task.start()
    task.read(5120)
    print(os.getpid(), flush=True)
    while True:
        task.read(512)
"""
IGNORE_SIGTERM = "signal.signal(signal.SIGTERM, signal.SIG_IGN)"
EXIT_ON_SIGTERM = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))"


@pytest.fixture
def start_run(tmp_path):
    """Return a function that starts `daq run` with an endless logging script; it returns process, script's pid, log."""
    processes = []

    def start(before=""):
        script, log = tmp_path / "script.py", tmp_path / "log.mcap"
        script.write_text(SCRIPT.replace("BEFORE", before))
        arguments = ["run", "--scene", "bare-structure", "--clock", "fast", str(script), str(log)]
        process = subprocess.Popen(
            [sys.executable, "-m", "daq", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        processes.append(process)
        return process, int(process.stdout.readline()), log

    yield start
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@pytest.mark.thorough
@pytest.mark.parametrize(
    # Statement of the script before its task; signal to the command or its process group; exit code of the command.
    ("before", "signal_number", "send", "code"),
    [
        ("", signal.SIGTERM, os.kill, 128 + signal.SIGTERM),
        ("", signal.SIGHUP, os.kill, 128 + signal.SIGHUP),
        ("", signal.SIGINT, os.kill, 128 + signal.SIGINT),
        ("", signal.SIGINT, os.killpg, 128 + signal.SIGINT),
        ("", signal.SIGTERM, os.killpg, 128 + signal.SIGTERM),
        (EXIT_ON_SIGTERM, signal.SIGTERM, os.kill, 7),
        (IGNORE_SIGTERM, signal.SIGTERM, os.kill, 128 + signal.SIGKILL),
    ],
    ids=["terminated", "hung up", "interrupted", "Ctrl-C", "group terminated", "script exits", "script ignores signal"],
)
def test_ended_command_ends_logging_script(start_run, before, signal_number, send, code):
    process, script_pid, log = start_run(before)
    send(process.pid, signal_number)
    assert process.wait(60) == code
    with pytest.raises(ProcessLookupError):
        os.kill(script_pid, 0)
    with daq.open(log) as recording:
        recording.check()
        assert recording.samples >= 5120


def test_probe_detects_group_ctrl_c(monkeypatch):
    monkeypatch.setattr(signal_forwarding, "_DELIVERY_S", 0.0)
    with contextlib.closing(signal_forwarding._GroupProbe()) as probe:
        assert not probe.received()
        monkeypatch.setattr(signal_forwarding, "_DELIVERY_S", 60.0)
        for _ in range(2):
            os.kill(probe._process.pid, signal.SIGINT)
            assert probe.received()
