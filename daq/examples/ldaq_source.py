"""The rig as an acquisition source of LDAQ, tried with LDAQ 1.3.2 (pip install LDAQ).

LDAQ asks for three methods and two attributes; `daq.examples.acquisition_source` shows the same without it.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import daq
from daq.nidaqmx import Task
from daq.nidaqmx.constants import READ_ALL_AVAILABLE, AcquisitionType


def rig_acquisition(scene: str, rate: float = 5120.0) -> Any:
    """Make a source of all inputs of a scene, in volts, in real time."""
    from LDAQ.acquisition_base import BaseAcquisition

    class RigAcquisition(BaseAcquisition):
        def __init__(self) -> None:
            super().__init__()
            self.acquisition_name = "rig"
            self.task: Any = None
            self.chassis = daq.connect(scene, clock="real")
            self.sample_rate = self.chassis.coerce_rate(rate)
            self._channel_names_init = [sensor.name for sensor in self.chassis.inputs]
            self.set_data_source(begin=False)
            self.set_trigger(1e20, 0)

        def set_data_source(self, begin: bool = True) -> None:
            if begin and self.task is None:
                self.task, limit = Task(), min(500.0, self.chassis.input_range)
                inputs = f"Dev1/ai0:{len(self._channel_names_init) - 1}"
                self.task.ai_channels.add_ai_voltage_chan(inputs, min_val=-limit, max_val=limit)
                self.task.timing.cfg_samp_clk_timing(self.sample_rate, sample_mode=AcquisitionType.CONTINUOUS)
                self.task.start()
            super().set_data_source()

        def read_data(self) -> NDArray[np.float64]:
            return np.array(self.task.read(READ_ALL_AVAILABLE)).reshape(len(self._channel_names_init), -1).T

        def terminate_data_source(self) -> None:
            if self.task is not None:
                self.task.close()
            self.task = None

    return RigAcquisition()


def main() -> None:
    """Let LDAQ measure for a second."""
    source = rig_acquisition("bare-structure")
    source.run_acquisition(1.0)
    measured = source.get_measurement_dict()
    print(f"{measured['data'].shape} samples and channels: {', '.join(measured['channel_names'])}")


if __name__ == "__main__":
    main()
