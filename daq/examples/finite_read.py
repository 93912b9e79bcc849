"""Finite read: drive the table with a sine and read a second of all four accelerometers.

The start trigger of the inputs starts the output, so both begin at the same sample of the common clock.
"""

import nidaqmx
import numpy as np
from nidaqmx.constants import READ_ALL_AVAILABLE, AccelUnits, AcquisitionType

import daq


def main() -> None:
    """Print the peak acceleration of each channel."""
    # With clock="fast", the simulation runs as fast as the computer allows, not in real time.
    with (
        daq.connect("bare-structure", clock="fast") as bench,
        nidaqmx.Task(grpc_options=bench) as inputs,
        nidaqmx.Task(grpc_options=bench) as output,
    ):
        # The sensors of this scene are ideal, with 1 V per m/s²; NI expects mV per g.
        inputs.ai_channels.add_ai_accel_chan(
            "cDAQ1Mod1/ai0:3",
            min_val=-500.0,
            max_val=500.0,
            units=AccelUnits.METERS_PER_SECOND_SQUARED,
            sensitivity=9806.65,
        )
        inputs.timing.cfg_samp_clk_timing(5000.0, sample_mode=AcquisitionType.FINITE, samps_per_chan=5120)
        # The clock divides 51.2 kHz by whole numbers: use the actual rate for all time axes.
        rate = inputs.timing.samp_clk_rate

        output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output.timing.cfg_samp_clk_timing(rate, sample_mode=AcquisitionType.CONTINUOUS)
        output.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
        # 1 V of drive is 1 mm of table displacement. The 512 samples, which are repeated, are two periods of 20 Hz.
        output.write(0.1 * np.sin(2 * np.pi * 20.0 * np.arange(512) / rate))

        output.start()
        inputs.start()
        data = np.array(inputs.read(READ_ALL_AVAILABLE))
        print(f"{data.shape[1]} samples per channel at {rate:g} S/s")
        for name, samples in zip(inputs.channel_names, data, strict=True):
            print(f"{name}: peak {np.abs(samples).max():.3f} m/s^2")


if __name__ == "__main__":
    main()
