"""Several clients at once: `python -m tests.benchmarks.clients [--clients 10] [--seconds 60] [--separate]`.

Each client is a process that reads four channels at 51.2 kS/s ten times a second from one served rig, and checks that
no sample is lost. The program prints the latency of the reads relative to the wall-clock time of their last sample, and
the memory and processor load of the server. `--separate`: forty channels, four for each client.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

RATE = 51200.0  # samples per second
READS_PER_SECOND = 10
SCENE = """
structure: {masses: [1 kg, 1 kg], springs: [40 kN/m, 40 kN/m], damping: {modal: 1 %}}
shaker: {kind: electrodynamic, body: 1, spring: 6.6 kN/m}
channels:
CHANNELS
converter: {preset: NI 9234, rate: 51.2 kHz}
"""
CLIENT = """
import json, sys, time
import grpc, nidaqmx, numpy as np
from nidaqmx.constants import AcquisitionType
from nidaqmx.stream_readers import AnalogMultiChannelReader

address, terminals, seconds, size = sys.argv[1], sys.argv[2], float(sys.argv[3]), int(sys.argv[4])
channel = grpc.insecure_channel(address, [("grpc.max_receive_message_length", -1)])
with nidaqmx.Task(grpc_options=nidaqmx.GrpcSessionOptions(channel, "")) as task:
    task.ai_channels.add_ai_voltage_chan(terminals, min_val=-5, max_val=5)
    task.timing.cfg_samp_clk_timing(51200.0, sample_mode=AcquisitionType.CONTINUOUS)
    task.timing.first_samp_timestamp_enable = True
    reader, data, late = AnalogMultiChannelReader(task.in_stream), np.zeros((4, size)), []
    print("ready", flush=True)
    sys.stdin.readline()
    task.start()
    began = task.timing.first_samp_timestamp_val.timestamp()
    for turn in range(1, round(seconds * 51200 / size) + 1):
        assert reader.read_many_sample(data, size) == size
        late.append(time.time() - began - turn * size / 51200)
    total = task.in_stream.total_samp_per_chan_acquired
    assert task.in_stream.curr_read_pos == turn * size
print(json.dumps(late))
"""


def main() -> None:
    """Start the server and the clients, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--separate", action="store_true")
    options = parser.parse_args()
    count = 4 * options.clients if options.separate else 4
    channel = "  - {name: cN, at: body 1, accelerometer: {preset: PCB 352C33}}"
    text = SCENE.replace("CHANNELS", "\n".join(channel.replace("cN", f"c{n}") for n in range(count)))
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder, "scene.yaml")
        scene.write_text(text)
        command = [sys.executable, "-m", "daq", "serve", str(scene), "--port", "0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            port = server.stdout.readline().split()[4]
            try:
                _measure(options, server.pid, f"127.0.0.1:{port}")
            finally:
                server.terminate()


def _measure(options: argparse.Namespace, server: int, address: str) -> None:
    process, size = psutil.Process(server), round(RATE / READS_PER_SECOND)
    names = [f"cDAQ1Mod{n}" if options.separate else f"Dev{n}" for n in range(1, options.clients + 1)]
    clients = [
        subprocess.Popen(
            [sys.executable, "-c", CLIENT, address, f"{name}/ai0:3", str(options.seconds), str(size)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for name in names
    ]
    for client in clients:
        assert client.stdout is not None
        client.stdout.readline()
    for client in clients:
        assert client.stdin is not None
        client.stdin.write("\n")
        client.stdin.flush()
    time.sleep(min(15.0, options.seconds / 2))
    initial_memory, cpu_time, start = (process.memory_info().rss, sum(process.cpu_times()[:2]), time.monotonic())
    time.sleep(max(0.0, options.seconds / 2 - 5.0))
    elapsed, cpu_time = time.monotonic() - start, sum(process.cpu_times()[:2]) - cpu_time
    final_memory, outputs = process.memory_info().rss, [client.communicate()[0] for client in clients]
    delays = 1e3 * np.array([json.loads(line) for line in outputs if line])
    print(
        f"load {os.getloadavg()[0]:.1f}; server {100 * cpu_time / elapsed:.0f} % of a core, {final_memory >> 20} MB",
        end="",
    )
    print(
        f" ({(final_memory - initial_memory) / 1e6:+.1f} MB); {len(delays)} of {options.clients} clients lost nothing"
    )
    median, high, worst = np.percentile(delays, [50, 99, 100])
    late_times = np.flatnonzero((delays > 25.0).any(axis=0)) / READS_PER_SECOND
    times = ", ".join(f"{late_time:.1f}" for late_time in late_times[:30])
    print(f"reads later than 25 ms: {(delays > 25.0).sum()}, at {times} s")
    print(f"latency of {delays.size} reads: median {median:.1f} ms, 99 % below {high:.1f} ms, longest {worst:.1f} ms")


if __name__ == "__main__":
    main()
