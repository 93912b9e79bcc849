"""Impulse capture with pretrigger: wait for a hammer impact and read the samples around it.

The scene's own test runs: body 1 is hit with the hammer every few seconds.
"""

import nidaqmx
import numpy as np
from nidaqmx.constants import READ_ALL_AVAILABLE, AccelUnits, AcquisitionType, Slope

import daq

PRETRIGGER = 256  # samples before the trigger
SAMPLES = 5120  # samples per channel, pretrigger included
LEVEL = 10.0  # trigger level of the force [N]


def main() -> None:
    """Print the peaks before and after one impact."""
    with daq.connect("fig10b-no-damper", clock="fast") as bench, nidaqmx.Task(grpc_options=bench) as task:
        for number, sensor in enumerate(bench.sensors):
            print(f"ai{number}: {sensor.name}, {1e3 * sensor.sensitivity:.4g} mV per {sensor.unit}")
        task.ai_channels.add_ai_force_iepe_chan("cDAQ1Mod1/ai3", "hammer", sensitivity=2.25)
        task.ai_channels.add_ai_accel_chan(
            "cDAQ1Mod1/ai0:2", "body", min_val=-50.0, max_val=50.0, sensitivity=100.0, units=AccelUnits.G
        )
        task.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.FINITE, samps_per_chan=SAMPLES)
        task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("hammer", PRETRIGGER, Slope.RISING, LEVEL)
        force, *bodies = np.array(task.read(READ_ALL_AVAILABLE, timeout=20.0))
        # Index of the first sample above the trigger level.
        trigger_index = int(np.argmax(force > LEVEL))
        print(f"first sample above {LEVEL:g} N: index {trigger_index}; peak force {force.max():.1f} N")
        for name, samples in zip(task.channel_names[1:], bodies, strict=True):
            # The last 32 samples before the trigger are omitted, because the impact begins below the trigger level.
            before_hit, after_hit = (np.abs(samples[: PRETRIGGER - 32]).max(), np.abs(samples[PRETRIGGER:]).max())
            print(f"{name}: up to {before_hit:.4f} g before the impact, {after_hit:.2f} g after it")


if __name__ == "__main__":
    main()
