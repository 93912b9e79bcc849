"""A signal that ends `daq run` also ends its script: no process remains, and the log is readable."""

import contextlib
import os
import signal
import subprocess
import sys

import pytest

import daq
from daq.extras.ni_server import signal_forwarding

pytestmark = pytest.mark.skipif(os.name != "posix", reason="Windows cannot send a signal to a single process")

# Runs the code of its argument in a separate process, to which it forwards signals, and ends with its exit status.
# Like a command, it has handlers of these signals.
FORWARDER = """
import signal, subprocess, sys
from daq.extras.ni_server.signal_forwarding import forward_signals
from rig.core.base.ending_signals import TERMINATION_SIGNALS
for number in TERMINATION_SIGNALS:
    signal.signal(number, signal.default_int_handler)
process = subprocess.Popen([sys.executable, "-I", "-S", "-c", sys.argv[1]], stdout=subprocess.PIPE, text=True)
with forward_signals(process):
    print(process.stdout.readline(), flush=True)
    code = process.wait()
sys.exit(code % 256)
"""
WAITING_SCRIPT = """
import os, signal, sys, time
BEFORE
print(os.getpid(), flush=True)
while True:
    time.sleep(1.0)
"""
LOGGING_SCRIPT = """
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
    task.read(512)
    print(os.getpid(), flush=True)
    while True:
        task.read(512)
"""
IGNORE_SIGTERM = "signal.signal(signal.SIGTERM, signal.SIG_IGN)"
EXIT_ON_SIGTERM = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))"


@pytest.fixture
def start():
    """Return a function that starts Python with arguments; it returns the process, and the script's pid."""
    processes = []

    def start(*arguments):
        process = subprocess.Popen(
            [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
        )
        processes.append(process)
        return process, int(process.stdout.readline())

    yield start
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def assert_ended(process, script_pid, code):
    assert process.wait(60) == code
    with pytest.raises(ProcessLookupError):
        os.kill(script_pid, 0)


@pytest.mark.parametrize(
    # Statement of the script; signal to the command or its process group; exit status of the script (negative: signal).
    ("before", "signal_number", "send", "code"),
    [
        ("", signal.SIGTERM, os.kill, -signal.SIGTERM),
        ("", signal.SIGHUP, os.kill, -signal.SIGHUP),
        ("", signal.SIGINT, os.kill, -signal.SIGINT),
        ("", signal.SIGTERM, os.killpg, -signal.SIGTERM),
        (EXIT_ON_SIGTERM, signal.SIGTERM, os.kill, 7),
    ],
    ids=["terminated", "hung up", "interrupted", "group terminated", "script exits"],
)
def test_signal_ends_the_script(start, before, signal_number, send, code):
    process, script_pid = start("-c", FORWARDER, WAITING_SCRIPT.replace("BEFORE", before))
    send(process.pid, signal_number)
    assert_ended(process, script_pid, code % 256)


@pytest.mark.thorough
@pytest.mark.parametrize(
    # Statement of the script before its task; signal to the command or its process group; exit status of the command.
    ("before", "signal_number", "send", "code"),
    [
        ("", signal.SIGINT, os.killpg, 128 + signal.SIGINT),
        (IGNORE_SIGTERM, signal.SIGTERM, os.kill, 128 + signal.SIGKILL),
    ],
    ids=["Ctrl-C", "script ignores signal"],
)
def test_ended_command_ends_logging_script(start, tmp_path, before, signal_number, send, code):
    script, log = tmp_path / "script.py", tmp_path / "log.mcap"
    script.write_text(LOGGING_SCRIPT.replace("BEFORE", before))
    run = ["-m", "daq", "run", "--scene", "bare-structure", "--clock", "real", str(script), str(log)]
    process, script_pid = start(*run)
    send(process.pid, signal_number)
    assert_ended(process, script_pid, code)
    with daq.open(log) as recording:
        recording.check()
        assert recording.samples >= 512


def test_probe_detects_group_ctrl_c(monkeypatch):
    monkeypatch.setattr(signal_forwarding, "_DELIVERY_S", 0.0)
    with contextlib.closing(signal_forwarding._GroupProbe()) as probe:
        assert not probe.received()
        monkeypatch.setattr(signal_forwarding, "_DELIVERY_S", 60.0)
        for _ in range(2):
            os.kill(probe._process.pid, signal.SIGINT)
            assert probe.received()
