"""Several simultaneous clients of a server: `python -m tests.benchmarks.clients [--clients 10] [--seconds 60]`.

Each client is a process that reads four channels at 51.2 kS/s ten times a second from one `daq serve`, and checks that
no sample is lost. It prints the latencies of the reads after the time of their last sample, and the memory and
processor load of the server. All clients read the same four channels; with `--separate` each has its own four.
"""

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
# Smallest latency of a late read.
LATE_MS = 25.0
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
    reader, data, latencies = AnalogMultiChannelReader(task.in_stream), np.zeros((4, size)), []
    print("ready", flush=True)
    sys.stdin.readline()
    task.start()
    start_time = task.timing.first_samp_timestamp_val.timestamp()
    for reads in range(1, round(seconds * 51200 / size) + 1):
        assert reader.read_many_sample(data, size) == size
        latencies.append(time.time() - start_time - reads * size / 51200)
    assert task.in_stream.curr_read_pos == reads * size
print(json.dumps(latencies))
"""


def main() -> None:
    """Start the server and the clients, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--separate", action="store_true")
    options = parser.parse_args()
    channel_count = 4 * options.clients if options.separate else 4
    channel = "  - {name: cN, at: body 1, accelerometer: {preset: PCB 352C33}}"
    text = SCENE.replace("CHANNELS", "\n".join(channel.replace("cN", f"c{n}") for n in range(channel_count)))
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder, "scene.yaml")
        scene.write_text(text)
        command = [sys.executable, "-m", "daq", "serve", str(scene), "--port", "0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            port = server.stdout.readline().split()[4]
            try:
                measure(options, server.pid, f"127.0.0.1:{port}")
            finally:
                server.terminate()


def measure(options: argparse.Namespace, server_id: int, address: str) -> None:
    """Run the clients on a server with a process id, and print the results."""
    server, read_samples = psutil.Process(server_id), round(RATE / READS_PER_SECOND)
    devices = [f"cDAQ1Mod{n}" if options.separate else f"Dev{n}" for n in range(1, options.clients + 1)]
    clients = [
        subprocess.Popen(
            [sys.executable, "-c", CLIENT, address, f"{device}/ai0:3", str(options.seconds), str(read_samples)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for device in devices
    ]
    # All clients start when the last one is ready.
    for client in clients:
        assert client.stdout is not None
        client.stdout.readline()
    for client in clients:
        assert client.stdin is not None
        client.stdin.write("\n")
        client.stdin.flush()
    time.sleep(min(15.0, options.seconds / 2))
    initial_memory, initial_cpu_time, start = server.memory_info().rss, sum(server.cpu_times()[:2]), time.monotonic()
    time.sleep(max(0.0, options.seconds / 2 - 5.0))
    load = (sum(server.cpu_times()[:2]) - initial_cpu_time) / (time.monotonic() - start)
    memory, memory_change = server.memory_info().rss / 1e6, (server.memory_info().rss - initial_memory) / 1e6
    outputs = [client.communicate()[0] for client in clients]
    latencies_ms = 1e3 * np.array([json.loads(line) for line in outputs if line])
    print(
        f"load {os.getloadavg()[0]:.1f}; server {load:.0%} of a core, {memory:.0f} MB ({memory_change:+.1f} MB); "
        f"{len(latencies_ms)} of {options.clients} clients lost no sample"
    )
    is_late = latencies_ms > LATE_MS
    late_times = np.flatnonzero(is_late.any(axis=0)) / READS_PER_SECOND
    print(f"reads later than {LATE_MS:g} ms: {is_late.sum()}, at {', '.join(f'{t:.1f}' for t in late_times[:30])} s")
    median, percentile_99, longest = np.percentile(latencies_ms, [50, 99, 100])
    print(
        f"latency of {latencies_ms.size} reads: median {median:.1f} ms, 99 % below {percentile_99:.1f} ms, "
        f"longest {longest:.1f} ms"
    )


if __name__ == "__main__":
    main()
