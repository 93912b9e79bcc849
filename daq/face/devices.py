"""What is installed: the system, its devices, their physical channels, with the driver's names."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from daq.face.constants import BusType, ProductCategory
from daq.face.virtual_channels import OUTPUT_RANGE
from daq.instrument.chassis import Chassis
from daq.instrument.connection import connected
from daq.instrument.errors import DaqError, DAQmxErrors, unsupported
from daq.instrument.sample_rates import DIVISORS, FASTEST_RATE
from daq.instrument.terminals import CHASSIS, INPUTS, OUTPUTS, check_device, parse_port, unflatten


class DriverVersion(NamedTuple):
    """Version of the driver whose interface this follows."""

    major_version: int
    minor_version: int
    update_version: int


class PhysicalChannel:
    """A terminal that channels can be made on."""

    def __init__(self, name: str, chassis: Chassis | None = None) -> None:
        self.name = name
        self._chassis = chassis

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PhysicalChannel) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        return f"PhysicalChannel(name={self.name})"

    @property
    def sensor(self) -> Any:
        """What is wired to an input, as an electronic data sheet would tell."""
        port = parse_port(self.name)
        inputs = (self._chassis or connected()).inputs
        if port.kind != "ai" or port.number >= len(inputs):
            raise DaqError(
                f"no sensor is wired to {self.name}: the inputs are ai0 to ai{len(inputs) - 1}",
                DAQmxErrors.PHYSICAL_CHAN_DOES_NOT_EXIST,
            )
        return inputs[port.number]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise unsupported(f"PhysicalChannel.{name}")


class PhysicalChannels(Sequence[PhysicalChannel]):
    """Physical channels of a device, by position or by name."""

    def __init__(self, names: list[str], chassis: Chassis) -> None:
        self.channel_names = names
        self._chassis = chassis

    def __len__(self) -> int:
        return len(self.channel_names)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, str):
            return PhysicalChannel(index, self._chassis)
        if isinstance(index, slice):
            return [PhysicalChannel(name, self._chassis) for name in self.channel_names[index]]
        return PhysicalChannel(self.channel_names[index], self._chassis)

    def __contains__(self, item: object) -> bool:
        return (item.name if isinstance(item, PhysicalChannel) else item) in self.channel_names

    def __iter__(self) -> Iterator[PhysicalChannel]:
        return (PhysicalChannel(name, self._chassis) for name in self.channel_names)


class Device:
    """A device by name; see `daq.instrument.terminals` for the names that are understood.

    Parameters
    ----------
    name : str
        Name of the device, or of one of its channels.
    chassis : Chassis, optional
        The chassis; by default the one connected last.

    Raises
    ------
    DaqError
        With -200220, if there is no such device.
    """

    def __init__(self, name: str, chassis: Chassis | None = None) -> None:
        self._chassis = chassis or connected()
        self.name = name
        self._device = check_device(name.lstrip("/").partition("/")[0])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Device) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        return f"Device(name={self.name})"

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise unsupported(f"Device.{name}")

    @property
    def _is_chassis(self) -> bool:
        return self._device.lower().startswith("cdaq") and "mod" not in self._device.lower()

    def _channels(self, kind: str, count: int, elsewhere: str) -> PhysicalChannels:
        absent = self._is_chassis or self._device == elsewhere
        names = [f"{self._device}/{kind}{number}" for number in range(0 if absent else count)]
        return PhysicalChannels(names, self._chassis)

    @property
    def ai_physical_chans(self) -> PhysicalChannels:
        """Inputs."""
        return self._channels("ai", len(self._chassis.inputs), OUTPUTS)

    @property
    def ao_physical_chans(self) -> PhysicalChannels:
        """Outputs."""
        return self._channels("ao", self._chassis.outputs, INPUTS)

    @property
    def product_type(self) -> str:
        """What the device is."""
        if self._is_chassis:
            return "shotrig chassis"
        return {INPUTS: "shotrig vibration inputs", OUTPUTS: "shotrig shaker output"}.get(
            self._device, "shotrig vibration module"
        )

    @property
    def product_category(self) -> ProductCategory:
        """Family of the device: scripts find terminals by it."""
        if self._is_chassis:
            return ProductCategory.COMPACT_DAQ_CHASSIS
        is_module = self._device.lower().startswith("cdaq")
        return ProductCategory.C_SERIES_MODULE if is_module else ProductCategory.DSA

    @property
    def bus_type(self) -> BusType:
        """How it is attached."""
        return BusType.COMPACT_DAQ if self._device.lower().startswith("cdaq") else BusType.USB

    @property
    def is_simulated(self) -> bool:
        """Whether the device is simulated: it is."""
        return True

    @property
    def dev_is_simulated(self) -> bool:
        """The same as `is_simulated`."""
        return True

    @property
    def serial_num(self) -> int:
        """Serial number: none."""
        return 0

    dev_serial_num = serial_num

    @property
    def chassis_module_devices(self) -> list[Device]:
        """Modules of a chassis."""
        return [Device(name, self._chassis) for name in (INPUTS, OUTPUTS)] if self._is_chassis else []

    @property
    def compact_daq_chassis_device(self) -> Device:
        """Chassis of a module."""
        return Device(CHASSIS, self._chassis)

    @property
    def ai_simultaneous_sampling_supported(self) -> bool:
        """Whether all inputs are sampled at one instant: they are."""
        return True

    @property
    def ai_max_single_chan_rate(self) -> float:
        """Fastest rate of an input."""
        return FASTEST_RATE

    ai_max_multi_chan_rate = ai_max_single_chan_rate
    ao_max_rate = ai_max_single_chan_rate

    @property
    def ai_min_rate(self) -> float:
        """Slowest rate of the clock."""
        return FASTEST_RATE / DIVISORS[-1]

    ao_min_rate = ai_min_rate

    @property
    def ai_voltage_rngs(self) -> list[float]:
        """Ranges of the inputs: low, high; empty if they are not limited."""
        full = self._chassis.input_range
        return [-full, full] if math.isfinite(full) else []

    @property
    def ao_voltage_rngs(self) -> list[float]:
        """Ranges of the output: low, high."""
        return [-OUTPUT_RANGE, OUTPUT_RANGE] if self._chassis.outputs else []

    @property
    def ao_samp_clk_supported(self) -> bool:
        """Whether the output runs on the sample clock."""
        return True

    @property
    def anlg_trig_supported(self) -> bool:
        """Whether analog triggers work."""
        return True

    @property
    def dig_trig_supported(self) -> bool:
        """Whether digital triggers work."""
        return True

    def reset_device(self) -> None:
        """Do nothing: there is nothing that could be stuck."""

    def self_test_device(self) -> None:
        """Do nothing: a simulated device is always well."""


class Devices(Sequence[Device]):
    """The devices of the system, by position or by name."""

    device_names = (CHASSIS, INPUTS, OUTPUTS)

    def __len__(self) -> int:
        return len(self.device_names)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, str):
            found = [Device(name) for name in unflatten(index)]
            return found[0] if len(found) == 1 else found
        if isinstance(index, slice):
            return [Device(name) for name in self.device_names[index]]
        return Device(self.device_names[index])

    def __contains__(self, item: object) -> bool:
        return (item.name if isinstance(item, Device) else item) in self.device_names


class System:
    """The system: what is installed."""

    @staticmethod
    def local() -> System:
        """Give the system this runs on."""
        return System()

    @property
    def devices(self) -> Devices:
        """Its devices."""
        return Devices()

    @property
    def driver_version(self) -> DriverVersion:
        """Version of the driver whose interface this follows."""
        return DriverVersion(26, 0, 0)

    @property
    def tasks(self) -> list[Any]:
        """What was saved with the driver for later use: nothing can be."""
        return []

    global_channels = scales = tasks

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise unsupported(f"System.{name}")
