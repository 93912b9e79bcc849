"""The rig as a source for a library that takes acquisition plug-ins, such as LDAQ.

`VirtualRig` has the three methods that the library calls, and the two attributes that it reads. LDAQ's own source for
NI's client works unchanged with `daq run` (see the README).
"""

import nidaqmx
import numpy as np
from nidaqmx.constants import READ_ALL_AVAILABLE, AcquisitionType
from numpy.typing import NDArray

import daq


class VirtualRig:
    """Acquisition source: the inputs of a scene, in volts."""

    def __init__(self, scene: str, sample_rate: float = 5120.0, clock: str = "real") -> None:
        self.bench = daq.connect(scene, clock=clock)
        self.channel_names = [sensor.name for sensor in self.bench.sensors]
        self.sample_rate = sample_rate

    def set_data_source(self) -> None:
        """Start the acquisition."""
        self.task = nidaqmx.Task(grpc_options=self.bench)
        for number, name in enumerate(self.channel_names):
            # Input range [V]; without a range, the input is ideal, and any limit above its voltages is valid.
            limit = min(500.0, self.bench.sensors[number].range or 500.0)
            self.task.ai_channels.add_ai_voltage_chan(f"cDAQ1Mod1/ai{number}", name, min_val=-limit, max_val=limit)
        self.task.timing.cfg_samp_clk_timing(self.sample_rate, sample_mode=AcquisitionType.CONTINUOUS)
        # The clock may not support the requested rate: use the actual rate for all time axes.
        self.sample_rate = self.task.timing.samp_clk_rate
        self.task.start()

    def read_data(self) -> NDArray[np.float64]:
        """Return the samples acquired since the last call, shape (samples, channels)."""
        return np.atleast_2d(np.array(self.task.read(READ_ALL_AVAILABLE))).T

    def terminate_data_source(self) -> None:
        """Stop the acquisition and disconnect."""
        self.task.close()
        self.bench.close()


def main() -> None:
    """Poll the source as an acquisition library does."""
    source = VirtualRig("bare-structure", clock="fast")
    source.set_data_source()
    total = 0
    for _ in range(20):
        total += len(source.read_data())
    source.terminate_data_source()
    print(f"{total} samples of {', '.join(source.channel_names)} at {source.sample_rate:g} S/s")


if __name__ == "__main__":
    main()
