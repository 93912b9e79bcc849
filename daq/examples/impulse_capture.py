"""Impulse capture with pretrigger: wait for the hammer, keep what came just before and what follows.

The scene's own test goes on by itself: somebody hits body 1 with the hammer every few seconds.
"""

import nidaqmx
import numpy as np
from nidaqmx.constants import READ_ALL_AVAILABLE, AccelUnits, AcquisitionType, Slope

import daq

PRETRIGGER, SAMPLES, LEVEL = 256, 5120, 10.0


def main() -> None:
    """Print what was captured of one hit."""
    with daq.connect("fig10b-no-damper", clock="fast") as rig, nidaqmx.Task(grpc_options=rig) as task:
        for number, sensor in enumerate(rig.sensors):
            print(f"ai{number}: {sensor.name}, {1e3 * sensor.sensitivity:.4g} mV per {sensor.unit}")
        task.ai_channels.add_ai_force_iepe_chan("cDAQ1Mod1/ai3", "hammer", sensitivity=2.25)
        task.ai_channels.add_ai_accel_chan(
            "cDAQ1Mod1/ai0:2",
            "body",
            min_val=-50.0,
            max_val=50.0,
            sensitivity=100.0,
            units=AccelUnits.G,
        )
        task.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.FINITE, samps_per_chan=SAMPLES)
        task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("hammer", PRETRIGGER, Slope.RISING, LEVEL)
        force, *bodies = np.array(task.read(READ_ALL_AVAILABLE, timeout=20.0))
        at = int(np.argmax(force > LEVEL))
        print(f"first sample above {LEVEL:g} N: index {at}; {force.max():.1f} N at most")
        for name, samples in zip(task.channel_names[1:], bodies, strict=True):
            before, after = np.abs(samples[: PRETRIGGER - 32]).max(), np.abs(samples[PRETRIGGER:]).max()
            print(f"{name}: up to {before:.4f} g before the hit, {after:.2f} g after it")


if __name__ == "__main__":
    main()
