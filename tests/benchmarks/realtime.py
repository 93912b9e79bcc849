"""Whether a live bench keeps up with the wall clock: `python -m tests.benchmarks.realtime [--minutes 10]`.

Three dampers, electrodynamic shaker, every sensor effect, 24 bits, four channels at 51.2 kS/s, logged into a recording
with display channels; a reader takes what has come ten times a second.
"""

from __future__ import annotations

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


def memory() -> float:
    """Give the memory this process holds now, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(folder: Path, minutes: float) -> Iterator[str]:
    """Yield a line for each minute, and what came of it all."""
    path, samples = folder / "live.mcap", round(RATE / READS_PER_SECOND)
    # Five seconds are a whole number of periods.
    drive = 3.0 * np.sin(2 * np.pi * 34.8 / RATE * np.arange(round(5 * RATE)))
    overruns, read, held = 0, 0, []
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
        output.timing.cfg_samp_clk_timing(
            RATE, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=drive.size
        )
        output.write(drive)
        output.start()
        inputs.start()
        reader = AnalogMultiChannelReader(inputs.in_stream)
        data = np.zeros((4, samples))
        wall, busy = time.monotonic(), time.process_time()
        for turn in range(round(60 * minutes * READS_PER_SECOND)):
            try:
                read += reader.read_many_sample(data, samples)
            except nidaqmx.DaqError as error:
                overruns += 1
                yield f"after {turn / READS_PER_SECOND:.1f} s: {error}"
            if turn % (60 * READS_PER_SECOND) == 60 * READS_PER_SECOND - 1:
                held.append(memory())
                took, share = time.monotonic() - wall, time.process_time() - busy
                yield (
                    f"{len(held):3d} min: {overruns} errors, {read} samples per channel read in {took:.1f} s, "
                    f"{100 * share / took:.1f} % of a core, {held[-1]:.0f} MB in memory"
                )
    with daq.open(path) as recording:
        lost = sum(gap.samples for gap in recording.gaps)
        yield f"recording: {recording.samples} samples per channel, {lost} lost, {path.stat().st_size / 1e6:.0f} MB"
    if held:
        yield f"memory from the first minute to the last: {held[-1] - held[0]:+.1f} MB"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    with tempfile.TemporaryDirectory() as directory:
        for line in measure(Path(directory), parser.parse_args().minutes):
            print(line, flush=True)
