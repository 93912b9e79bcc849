"""Continuous read with a callback that evaluates the new samples every tenth of a second.

The callback runs on a thread of the client. On the fast clock, the bench waits briefly for the callback. On the real
clock (omit ``clock="fast"``), the bench continues: only read the samples in the callback, and evaluate them in another
thread.
"""

import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType
from nidaqmx.stream_readers import AnalogMultiChannelReader

import daq


def main() -> None:
    """Print the RMS of each tenth of a second. The scene's own test runs, because no task drives the output."""
    with daq.connect("bare-structure", clock="fast") as bench, nidaqmx.Task(grpc_options=bench) as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:3", min_val=-500.0, max_val=500.0)
        task.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.CONTINUOUS)
        reader = AnalogMultiChannelReader(task.in_stream)
        block = np.zeros((4, 512))

        def print_rms(handle: int, event: int, samples: int, data: object) -> int:
            first = task.in_stream.curr_read_pos
            reader.read_many_sample(block, samples)
            rms = np.sqrt((block**2).mean(axis=1))
            print(f"from {first / 5120.0:.1f} s: " + ", ".join(f"{value:.4f}" for value in rms) + " V")
            return 0

        task.register_every_n_samples_acquired_into_buffer_event(512, print_rms)
        task.start()
        bench.pass_time(1.0)
        task.stop()
        print(f"{task.in_stream.total_samp_per_chan_acquired} samples per channel")


if __name__ == "__main__":
    main()
