"""Live control: hold the acceleration of body 1 by writing the next stretch of a tone after each one read.

The output does not regenerate: it plays what is written, once; each stretch is written while the one before
is played. The loop is causal; what is written acts on what is read two stretches later.
"""

import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType, RegenerationMode

import daq

RATE, STRETCH, FREQUENCY, WANTED = 5120.0, 512, 20.0, 0.5


def main(stretches: int = 60) -> float:
    """Run the loop; return the amplitude reached, m/s^2."""
    carrier = np.exp(2j * np.pi * FREQUENCY * np.arange(STRETCH) / RATE)
    drive, amplitude = 0.005, 0.0
    with (
        daq.connect("bare-structure", clock="fast") as rig,
        nidaqmx.Task(grpc_options=rig) as inputs,
        nidaqmx.Task(grpc_options=rig) as output,
    ):
        inputs.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0", min_val=-500.0, max_val=500.0)
        inputs.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        output.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        output.out_stream.output_buf_size = 4 * STRETCH
        output.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
        # The stretch holds whole periods, so that it joins on to itself. Two are in the buffer at all times.
        output.write(np.tile(drive * carrier.imag, 2))
        output.start()
        inputs.start()
        for stretch in range(stretches):
            samples = np.array(inputs.read(STRETCH))
            amplitude = 2 * abs((samples * carrier.conj()).mean())
            if stretch > 10:
                # Once the start has died down: an eighth of the way to the drive that would be right.
                drive *= (WANTED / amplitude) ** 0.125
            output.write(drive * carrier.imag)
            if stretch % 10 == 0:
                print(f"{stretch * STRETCH / RATE:4.1f} s: {amplitude:.4f} m/s^2 at {1e3 * drive:.3f} um")
    return amplitude


if __name__ == "__main__":
    main()
