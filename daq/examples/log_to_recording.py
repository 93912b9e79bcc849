"""Logging: write the samples of a task to a recording, in the format of `daq record`, while the script reads them."""

import tempfile
from pathlib import Path

import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType, LoggingMode, LoggingOperation

import daq


def main(folder: str | None = None) -> None:
    """Log half a second, read the recording, and compare it with the samples that the script has read."""
    with daq.connect("fig8-three-dampers", clock="fast") as bench, tempfile.TemporaryDirectory() as scratch:
        path = Path(folder or scratch) / "logged.mcap"
        with nidaqmx.Task(grpc_options=bench) as task:
            task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:3")
            task.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.CONTINUOUS)
            task.in_stream.configure_logging(
                path, LoggingMode.LOG_AND_READ, operation=LoggingOperation.CREATE_OR_REPLACE
            )
            task.start()
            blocks = [np.array(task.read(512)) for _ in range(5)]
            task.stop()
        read_samples = np.concatenate(blocks, axis=1)
        with daq.open(path) as recording:
            for row, (name, channel) in enumerate(recording.channels.items()):
                logged = recording.read(name)
                # The recording returns readings in the unit of the channel; the task returns volts.
                is_equal = np.allclose(logged * channel.sensitivity, read_samples[row], rtol=1e-12, atol=0.0)
                comparison = "equal to" if is_equal else "DIFFERENT from"
                print(f"{name}: {logged.size} samples in {channel.unit}, {comparison} the samples read")


if __name__ == "__main__":
    main()
