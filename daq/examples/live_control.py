"""Live control: control the acceleration of body 1 by writing the next block of a tone after each block read.

The output does not regenerate: every written block is output once. While a block is output, the program writes the next
block. The loop is causal: a written block affects the samples that are read two blocks later.
"""

import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType, RegenerationMode

import daq

RATE = 5120.0  # samples per second
BLOCK = 512  # samples
FREQUENCY = 20.0  # Hz
TARGET = 0.5  # acceleration amplitude [m/s²]


def main(blocks: int = 60) -> float:
    """Run the loop over a number of blocks; return the final acceleration amplitude [m/s²]."""
    carrier = np.exp(2j * np.pi * FREQUENCY * np.arange(BLOCK) / RATE)
    # Drive in V (1 V: table displacement of 1 mm); amplitude in m/s² (1 V of the ideal sensor: 1 m/s²).
    drive, amplitude = 0.005, 0.0
    with (
        daq.connect("bare-structure", clock="fast") as bench,
        nidaqmx.Task(grpc_options=bench) as inputs,
        nidaqmx.Task(grpc_options=bench) as output,
    ):
        inputs.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0", min_val=-500.0, max_val=500.0)
        inputs.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        output.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        output.out_stream.output_buf_size = 4 * BLOCK
        output.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
        # A block contains whole periods, so blocks join without a phase jump. Two blocks are written in advance.
        output.write(np.tile(drive * carrier.imag, 2))
        output.start()
        inputs.start()
        for block in range(blocks):
            samples = np.array(inputs.read(BLOCK))
            amplitude = 2 * abs((samples * carrier.conj()).mean())
            if block > 10:
                # From here on, the initial transient has decayed. The exponent 1/8 keeps the delayed loop stable.
                drive *= (TARGET / amplitude) ** 0.125
            output.write(drive * carrier.imag)
            if block % 10 == 0:
                print(f"{block * BLOCK / RATE:4.1f} s: {amplitude:.4f} m/s^2 at {1e3 * drive:.3f} um")
    return amplitude


if __name__ == "__main__":
    main()
