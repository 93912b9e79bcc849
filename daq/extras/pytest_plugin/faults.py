"""Faults of a device, injected while a program uses it: failed calls, overloads, reserved and missing devices."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.devices.measurements import MEASUREMENTS
from daq.extras.ni_device.devices.modules import Module
from daq.extras.ni_device.engines.acquisition import Acquisition
from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_device.task import Task
from daq.extras.pytest_plugin.description import BenchError, find_channel

CALLS = ("start", "read", "write")


@dataclass
class _FutureError:
    call: str
    code: int
    n_calls_before: int  # number of calls that succeed before the failing call


class Faults:
    """Injects faults into a device; names of devices and channels are those of the bench."""

    def __init__(self, chassis: Chassis) -> None:
        self._chassis = chassis
        self._future: list[_FutureError] = []
        self._unplugged: dict[str, Module] = {}  # unplugged devices, by their names in lower case
        self.other_clients: dict[str, Task] = {}  # tasks of simulated other clients, by name; each reserves a device
        terminals: Any = _OverloadedTerminals(chassis.terminals)
        chassis.terminals = self._terminals = terminals
        chassis.call_listeners.append(self._on_call)

    def fail(self, call: str, code: int, after: int = 0) -> None:
        """Let a call fail once with an error code of the driver, such as -200284 (timeout).

        `call` is "start", "read" or "write"; `after` is the number of calls that succeed before the failing call. The
        task continues as with hardware: before a read that fails with -200279, the buffer overflows, and later reads
        fail too if time passes before them, until the task is started again; -200361 ends the acquisition. Raises
        `BenchError` for an unknown call, an unknown code, or a negative number of calls.
        """
        if call not in CALLS:
            raise BenchError(f"there is no call {call!r}. Choose {', '.join(CALLS)}.")
        if code not in list(Code):
            hint = f"Give {-code}." if -code in list(Code) else "Choose a code of nidaqmx.error_codes.DAQmxErrors."
            raise BenchError(f"the driver has no error {code}. {hint}")
        if after < 0:
            raise BenchError(f"after is {after}. Give 0 for the next call, or a positive number of calls.")
        self._future.append(_FutureError(call, code, after))

    def _on_call(self, call: str, task: Task) -> None:
        for name in task.settings.device_names:
            if name.lower() in self._unplugged:
                raise _unplugged_error(name)
        for fault in [fault for fault in self._future if fault.call == call]:
            fault.n_calls_before -= 1
            if fault.n_calls_before < 0:
                self._future.remove(fault)
                self._cause(fault.code, task)

    def _cause(self, code: int, task: Task) -> None:
        error = DaqError("a test has injected this error.", code, samples_done=0)
        run = task.run
        if code == Code.SAMPLES_NO_LONGER_AVAILABLE and isinstance(run, Acquisition) and run.plan.samples is None:
            # The error is raised by the read itself, which detects the loss of samples.
            n_free = run.plan.buffer_size - (run.ring.written - run.position)
            self._chassis.advance(run.ticks_until(n_free + 1, self._chassis.position))
            return
        if code == Code.INPUT_FIFO_OVERFLOW_2 and run is not None:
            run.stop(error)
        raise error

    def overload(self, channel: str, seconds: float = 0.1) -> None:
        """Overload an input from now on for a time on the bench [s]: the input reads full scale, and is flagged."""
        index = find_channel(self._chassis.devices.all(), channel, "ai", "overload")[1]
        start = self._chassis.elapsed
        self._terminals.overloads.append((index, start, start + seconds))

    def reserve(self, device: str) -> None:
        """Reserve a device for another client: starting a task on it fails with -50103."""
        module = self._module(device)
        for direction, measurement in (("ai", MEASUREMENTS["Voltage"]), ("ao", None)):
            if names := module.channel_names(direction):
                task = Task(self._chassis, f"another client's {device}/{direction}", {})
                task.settings.add(", ".join(names), "", measurement, {})
                task.reserve()
                self.other_clients[task.name] = task

    def release(self, device: str) -> None:
        """End the reservation of a device."""
        for direction in ("ai", "ao"):
            if task := self.other_clients.pop(f"another client's {device}/{direction}", None):
                task.close()

    def unplug(self, device: str) -> None:
        """Unplug a device, or a chassis with its modules: calls fail with -201003, and new channels with -200220."""
        devices = self._chassis.devices
        names = [self._module(device).name, *devices.modules_of(device)]
        with self._chassis.changed:
            self._unplugged |= {name.lower(): devices.remove(name) for name in names}
            self._chassis.stop_runs(_unplugged_error(device), [name.lower() for name in names])

    def plug_in(self, device: str = "") -> None:
        """Connect an unplugged device again, or a chassis with its modules; without a name, all devices."""
        name, unplugged = device.lower(), list(self._unplugged.values())
        selected = [module for module in unplugged if name in ("", module.name.lower(), module.chassis.lower())]
        if name and not selected:
            names = ", ".join(module.name for module in unplugged) or "none"
            raise BenchError(f"{device} is not unplugged. Give one of {names}.")
        with self._chassis.changed:
            # A module is connected through its chassis.
            connected = {name for module in selected for name in (module.name, module.chassis)}
            for module in unplugged:
                if module.name in connected:
                    self._chassis.devices.add(self._unplugged.pop(module.name.lower()))

    def reset(self) -> list[str]:
        """End all faults, and return the failures that have not occurred, as the calls that required them."""
        unused = [f"faults.fail({fault.call!r}, {fault.code})" for fault in self._future]
        self._future.clear()
        self._terminals.overloads.clear()
        for task in self.other_clients.values():
            task.close()
        self.other_clients.clear()
        self.plug_in()
        return unused

    def _module(self, name: str) -> Module:
        try:
            return self._chassis.devices.module(name)
        except DaqError as error:
            raise BenchError(str(error)) from None


def _unplugged_error(name: str) -> DaqError:
    return DaqError(f"{name} has been unplugged. Connect it again.", Code.DEV_CANNOT_BE_ACCESSED, samples_done=0)


class _OverloadedTerminals:
    """The terminals of a bench with overloaded inputs; all other methods are those of `terminals`."""

    def __init__(self, terminals: Any) -> None:
        self._terminals = terminals
        self.overloads: list[tuple[int, float, float]] = []  # index of input; start and end in bench time [s]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._terminals, name)

    def advance(self, volts: Any, ticks: int, rates: Any) -> Mapping[float, Any]:
        """See `daq.extras.ni_device.terminals.Terminals.advance`."""
        blocks = self._terminals.advance(volts, ticks, rates)
        return {rate: self._overloaded(block, rate) for rate, block in blocks.items()} if self.overloads else blocks

    def _overloaded(self, block: Any, rate: float) -> Any:
        samples, overload = block.samples.copy(), block.overload.copy()
        time = (block.first + np.arange(samples.shape[1])) / rate
        for index, start, end in self.overloads:
            channel, selected = self._terminals.bench.channels[index], (time >= start) & (time < end)
            overload[index, selected] = True
            if channel.range is not None:
                # The largest count of a converter is one less than full scale.
                scale = channel.volts_per_count
                samples[index, selected] = channel.range if scale is None else round(channel.range / scale) - 1
        return replace(block, samples=samples, overload=overload)
