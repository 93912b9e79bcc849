"""The server with several releases of NI's client `nidaqmx`, each in a separate environment.

    python -m tests.clients [VERSION ...]

The default releases are: the oldest with the gRPC protocol, the last that needs an older protobuf than this project,
the oldest that can be installed with this project, an intermediate release and the newest. A user's client may be older
than the `nidaqmx` of this project, whose message classes the server uses.
"""

import subprocess
import sys
import tempfile
import venv
from pathlib import Path

import daq

RELEASES = ("0.8.0", "1.0.2", "1.1.0", "1.3.0", "1.7.0")
# Calls that every client makes: settings, reads, writes, triggers, events, errors, devices.
SCRIPT = """
import sys, threading
import grpc, numpy as np, nidaqmx
from nidaqmx.constants import AcquisitionType, READ_ALL_AVAILABLE
from nidaqmx.stream_readers import AnalogMultiChannelReader
from nidaqmx.stream_writers import AnalogSingleChannelWriter
from nidaqmx.system import System

channel = grpc.insecure_channel(sys.argv[1])
options = nidaqmx.GrpcSessionOptions(channel, "")
assert "cDAQ1Mod1" in System.remote(options).devices.device_names
with nidaqmx.Task(grpc_options=options) as task, nidaqmx.Task(grpc_options=options) as output:
    task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:3", min_val=-500.0, max_val=500.0)
    task.timing.cfg_samp_clk_timing(5000.0, sample_mode=AcquisitionType.FINITE, samps_per_chan=1000)
    assert abs(task.timing.samp_clk_rate - 5120.0) < 1e-9, task.timing.samp_clk_rate
    output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
    output.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.FINITE, samps_per_chan=1000)
    output.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
    AnalogSingleChannelWriter(output.out_stream).write_many_sample(np.sin(np.arange(1000) / 20.0))
    done = threading.Event()
    task.register_done_event(lambda *arguments: done.set() or 0)
    output.start()
    task.start()
    samples = np.zeros((4, 1000))
    assert AnalogMultiChannelReader(task.in_stream).read_many_sample(samples, READ_ALL_AVAILABLE) == 1000
    assert np.ptp(samples, axis=1).min() > 0.0
    assert done.wait(60.0)
    output.wait_until_done()
    task.stop()
    try:
        task.ai_channels.add_ai_voltage_chan("nowhere/ai0")
    except nidaqmx.errors.DaqError as error:
        assert int(error.error_code) == -200220, error.error_code
    else:
        raise AssertionError("a device that does not exist was accepted")
print("passed")
"""


def main() -> int:
    """Run the script with each release and print whether it passes; exit code 1 if one fails."""
    failed = []
    with tempfile.TemporaryDirectory() as folder, daq.connect("bare-structure", clock="fast") as rig:
        script = Path(folder, "script.py")
        script.write_text(SCRIPT)
        for release in sys.argv[1:] or RELEASES:
            environment = Path(folder, release)
            venv.create(environment, with_pip=True)
            python = environment / ("Scripts/python" if sys.platform == "win32" else "bin/python")
            requirement = f"nidaqmx[grpc]=={release}"
            command = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", requirement]
            installed = subprocess.run(command, check=False).returncode == 0
            passed = installed and subprocess.run([str(python), script, rig.address], check=False).returncode == 0
            print(f"nidaqmx {release}: {'passes' if passed else 'FAILS'}", flush=True)
            failed += [] if passed else [release]
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
