"""Controlled test on a device: hold the motion of a body at a level, with the drive queued in the device.

The test is that of `daq record`. `run_on_device` gives each window of drive to the device and takes the readings that
were acquired meanwhile. With `daq.connect` the device is virtual; without `grpc_options` it is NI hardware.
"""

from typing import Any

import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType, RegenerationMode

import daq
import rig
from daq.core.excitation import Station, excitation
from daq.core.measurement.device_loop import run_on_device
from daq.core.virtual_bench.bench import Bench
from rig.core.base.arrays import Array

QUEUED = 256  # samples of drive that wait in the device
BUFFER = 1 << 15  # samples


def main() -> list[dict[str, Any]]:
    """Run the test; return the settings of its points."""
    scene = rig.load("held-response", {"test.displacement": "0.2 mm", "test.points": 2})
    bench = Bench(scene)
    points: list[dict[str, Any]] = []

    def mark(kind: str, first: int, stop: int, **fields: Any) -> None:
        if kind == "measure":
            points.append(fields)
            print(f"{fields['frequency']:.2f} Hz: 0.2 mm at {fields['drive']:.4f} N, settled: {fields['settled']}")

    station = Station(scene, bench.channels, bench.inputs, bench.rate, mark)
    sensitivities = np.array([[channel.sensitivity] for channel in bench.channels])
    with (
        daq.connect(scene, clock="fast") as device,
        nidaqmx.Task(grpc_options=device) as inputs,
        nidaqmx.Task(grpc_options=device) as output,
    ):
        inputs.ai_channels.add_ai_voltage_chan(f"cDAQ1Mod1/ai0:{len(bench.channels) - 1}")
        inputs.timing.cfg_samp_clk_timing(bench.rate, sample_mode=AcquisitionType.CONTINUOUS)
        output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output.timing.cfg_samp_clk_timing(bench.rate, sample_mode=AcquisitionType.CONTINUOUS)
        output.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        output.out_stream.output_buf_size = BUFFER
        output.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")

        def read(samples: int) -> Array:
            if inputs.is_task_done():
                output.start()
                inputs.start()
            return np.array(inputs.read(samples)) / sensitivities

        run_on_device(excitation, station, read, lambda volts: output.write(volts[0]), QUEUED)
    return points


if __name__ == "__main__":
    main()
