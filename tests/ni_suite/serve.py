"""Start a server of the devices that NI's tests expect; it prints its port as NI's server does."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.clock import RealClock
from daq.extras.ni_device.task import Task
from daq.extras.ni_server.served_instrument import Limits
from daq.extras.ni_server.service import Server
from tests.ni_suite.devices import SimulatedSignals, modules, save_inputs, save_outputs

if __name__ == "__main__":
    chassis = Chassis(modules(), SimulatedSignals(), RealClock())
    server = Server(chassis, limits=Limits(max_tasks_per_client=10_000))
    for save in (save_inputs, save_outputs):
        task = Task(chassis, "", server.instrument.storage.scales)
        save(server.instrument.storage, task)
        task.close()
    print(f"Server listening on port {server.port}", flush=True)
    server.wait()
