"""Real-time capability of a live device: `python -m tests.benchmarks.realtime [--minutes 10]`.

The scene has three dampers, an electrodynamic shaker, all sensor effects, 24 bits and four channels at 51.2 kS/s. The
device logs into a recording with display channels, and a client reads ten times a second.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType, LoggingMode, LoggingOperation
from nidaqmx.stream_readers import AnalogMultiChannelReader

import daq
from tests.benchmarks.chain import RATE, full_scene

READS_PER_SECOND = 10


def process_memory() -> float:
    """Return the current memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(folder: Path, minutes: float) -> Iterator[str]:
    """Yield a line for each minute, and the final results."""
    path, read_samples = folder / "live.mcap", round(RATE / READS_PER_SECOND)
    # Five seconds are a whole number of periods, so that the repeated output is continuous.
    drive = 3.0 * np.sin(2 * np.pi * 34.8 / RATE * np.arange(round(5 * RATE)))
    errors, samples_read, memories = 0, 0, []
    with (
        daq.connect(full_scene(), clock="real") as rig,
        nidaqmx.Task(grpc_options=rig) as inputs,
        nidaqmx.Task(grpc_options=rig) as output,
    ):
        inputs.ai_channels.add_ai_voltage_chan("Dev1/ai0:3")
        inputs.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        operation = LoggingOperation.CREATE_OR_REPLACE
        inputs.in_stream.configure_logging(path, LoggingMode.LOG_AND_READ, operation=operation)
        output.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        output.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=drive.size)
        output.write(drive)
        output.start()
        inputs.start()
        reader = AnalogMultiChannelReader(inputs.in_stream)
        data = np.zeros((4, read_samples))
        start, cpu_start = time.monotonic(), time.process_time()
        for number in range(round(60 * minutes * READS_PER_SECOND)):
            try:
                samples_read += reader.read_many_sample(data, read_samples)
            except nidaqmx.DaqError as error:
                errors += 1
                yield f"after {number / READS_PER_SECOND:.1f} s: {error}"
            if number % (60 * READS_PER_SECOND) == 60 * READS_PER_SECOND - 1:
                memories.append(process_memory())
                elapsed, cpu_time = time.monotonic() - start, time.process_time() - cpu_start
                yield (
                    f"{len(memories):3d} min: {errors} errors, {samples_read} samples per channel read in "
                    f"{elapsed:.1f} s, {100 * cpu_time / elapsed:.1f} % of a core, {memories[-1]:.0f} MB in memory"
                )
    with daq.open(path) as recording:
        lost_samples = sum(gap.samples for gap in recording.gaps)
        size_mb = path.stat().st_size / 1e6
        yield f"recording: {recording.samples} samples per channel, {lost_samples} lost, {size_mb:.0f} MB"
    if memories:
        yield f"change of memory from the first minute to the last: {memories[-1] - memories[0]:+.1f} MB"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    with tempfile.TemporaryDirectory() as directory:
        for line in measure(Path(directory), parser.parse_args().minutes):
            print(line, flush=True)
