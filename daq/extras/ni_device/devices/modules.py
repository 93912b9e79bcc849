"""Modules and other devices of the instrument, with the properties of their data sheets as scripts can query them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from daq.extras.ni_device.devices.measurements import MEASUREMENTS, SUPPORTED_TYPES, VOLTAGE
from daq.extras.ni_device.devices.names import ASSIGNED_BY_DRIVER
from daq.extras.ni_device.errors import Code, DaqError, invalid_value
from daq.extras.ni_device.values import Coupling, SampleMode, TerminalConfiguration
from rig.core.base.errors import SceneError
from rig.core.data_sheets.modules import Rates

# Bit of each value in NI's encoding of sets.
_COUPLING_BITS = {Coupling.AC: 1, Coupling.DC: 2, Coupling.GND: 4}
TERMINAL_CONFIGURATION_BITS = {
    TerminalConfiguration.RSE: 1,
    TerminalConfiguration.NRSE: 2,
    TerminalConfiguration.DIFFERENTIAL: 4,
    TerminalConfiguration.PSEUDO_DIFFERENTIAL: 8,
}
_REFERENCE_TRIGGER, _START_TRIGGER = 4, 8

# NI's numbers of product categories and bus types.
CHASSIS_CATEGORY, MODULE_CATEGORY, SOUND_AND_VIBRATION_CATEGORY, MULTIFUNCTION_CATEGORY = 14658, 14659, 14649, 14646
COMPACT_DAQ_BUS, USB_BUS = 14637, 12586
# Terminals with the signals of the chassis, or of a separate device.
_TERMINALS = (
    "PFI0",
    "PFI1",
    "ai/SampleClock",
    "ai/StartTrigger",
    "ao/SampleClock",
    "ao/StartTrigger",
    "ai/ReferenceTrigger",
)
# Timebase of CompactDAQ chassis [Hz].
CHASSIS_TIMEBASE_HZ = 80e6
# Rates of inputs and outputs without a named module: 51.2 kS/s divided by integers up to 31.
DEFAULT_RATES = Rates(51200.0 / 31, 51200.0, tuple(51200.0 / divisor for divisor in range(31, 0, -1)))


@dataclass(frozen=True)
class Module:
    """A device that scripts can use: a module, a chassis or a separate device.

    Of several couplings or currents, the first is the default; of terminal configurations, the last.
    """

    name: str  # name on this bench
    product_type: str  # NI's name, for example "NI 9234"
    category: int = MODULE_CATEGORY
    bus: int = COMPACT_DAQ_BUS
    inputs: tuple[int, ...] = ()  # indices of the bench's channels at ai0, ai1, ...
    outputs: tuple[int, ...] = ()  # indices of the bench's outputs at ao0, ao1, ...
    ranges: tuple[float, ...] = ()  # input ranges, ± V, smallest first; empty if the inputs are not limited
    output_range: float = 10.0  # range of the outputs, ± V
    bits: int | None = None  # resolution of the inputs; None if they are ideal
    output_bits: int | None = None  # resolution of the outputs; None if they are ideal
    rates: Rates = DEFAULT_RATES  # sample rates of the inputs
    output_rates: Rates = DEFAULT_RATES  # sample rates of the outputs
    timebase: float = 13.1072e6  # clock that the listed rates divide [Hz]
    scene_rate: float | None = None  # rate of a converter without a preset, S/s, accepted in addition to `rates`
    couplings: tuple[Coupling, ...] = (Coupling.AC, Coupling.DC)
    terminal_configurations: tuple[TerminalConfiguration, ...] = (TerminalConfiguration.PSEUDO_DIFFERENTIAL,)
    currents: tuple[float, ...] = (0.002,)  # currents of the supply of IEPE sensors, A
    supply_coupling: Literal["AC", "any"] = "any"  # coupling that the IEPE supply requires
    on_demand: bool = True  # inputs can be read without a sample clock; delta-sigma modules require a clock
    output_on_demand: bool = True  # outputs can be written without a sample clock
    analog_trigger: bool = True  # an analog input can be the source of a trigger
    teds: bool = True  # reads the electronic data sheets of sensors
    # Highest total rate of inputs that share a converter, S/s; None: all inputs are sampled at the same time.
    aggregate_rate: float | None = None
    chassis: str = ""  # name of the chassis; empty for a separate device
    slot: int = 0  # number of the slot; 0 for a separate device
    number: int = 0  # NI's product number; 0 if unknown

    def coerced_rate(self, rate: float, output: bool) -> float:
        """Return the lowest rate of the sample clock of inputs or outputs, S/s, that is not below the requested rate.

        Raises `DaqError` -200077 if the requested rate is not positive or exceeds the highest rate.

        >>> module = Module("Mod1", "NI 9234")
        >>> [module.coerced_rate(rate, output=False) for rate in (5000.0, 8000.0, 1000.0)]
        [5120.0, 8533.333333333334, 1651.6129032258063]
        """
        if rate == self.scene_rate:
            return rate
        try:
            return self.rates_of(output).at_least(rate)
        except SceneError as error:
            raise invalid_value(f"sample clock rate of {self.product_type}: {error}") from None

    @property
    def uses_dma(self) -> bool:
        """Whether samples are transferred by DMA (direct memory access), as on PCI and PXI."""
        return self.product_type.upper().startswith(("PCI", "PXI"))

    def timebase_of(self, output: bool) -> float:
        """Return the frequency of the clock that the sample clock of inputs or outputs divides [Hz]."""
        rates = self.rates_of(output)
        # A module with exact rates is next to a delta-sigma module, in a chassis.
        return rates.timebase or (self.timebase if rates.available else CHASSIS_TIMEBASE_HZ)

    def rates_of(self, output: bool) -> Rates:
        """Return the sample rates of the inputs or outputs."""
        return self.output_rates if output else self.rates

    def max_rate(self, count: int, output: bool) -> float:
        """Return the highest sample rate of `count` inputs or outputs, S/s.

        A shared converter converts one input after the other. Above `aggregate_rate`, the driver warns that the inputs
        do not settle (200011), and returns samples.
        """
        rates = self.rates_of(output)
        limit = rates.fastest if output or self.aggregate_rate is None else rates.fastest / count
        return limit if rates.timebase is None else rates.timebase / math.ceil(rates.timebase / limit - 1e-6)

    def terminal_configurations_at(self, number: int) -> tuple[TerminalConfiguration, ...]:
        """Return the terminal configurations of an input.

        Where inputs have single ends too, an input and that 8 above it (4 above it, of 8 inputs) are the ends of a
        differential input.
        """
        pair_distance = max(1, min(8, len(self.inputs) // 2))
        single_ended = {TerminalConfiguration.RSE, TerminalConfiguration.NRSE}
        if single_ended.isdisjoint(self.terminal_configurations) or number // pair_distance % 2 == 0:
            return self.terminal_configurations
        return tuple(value for value in self.terminal_configurations if value != TerminalConfiguration.DIFFERENTIAL)

    def range_for(self, limit: float) -> float:
        """Return the smallest range that includes a limit [V], infinite without limit; `DaqError` -200077 if none."""
        if not self.ranges:
            return math.inf
        for input_range in self.ranges:
            if limit <= input_range * (1 + 1e-9):
                return input_range
        raise invalid_value(
            f"{limit:g} V exceeds the largest range of {self.product_type}, ±{self.ranges[-1]:g} V. Give a lower limit."
        )

    def channel_names(self, direction: str) -> list[str]:
        """Return the names of the module's inputs ("ai") or outputs ("ao")."""
        count = len(self.inputs if direction == "ai" else self.outputs)
        return [f"{self.name}/{direction}{number}" for number in range(count)]

    def bench_index(self, direction: str, number: int) -> int:
        """Return the bench's channel or output at a terminal; raise `DaqError` -200170 for an unknown terminal."""
        bench_indices = {"ai": self.inputs, "ao": self.outputs}.get(direction, ())
        if not 0 <= number < len(bench_indices):
            raise self.channel_error(direction, number)
        return bench_indices[number]

    def unsupported_measurement_error(self, where: str) -> DaqError:
        """Return the error for a measurement that the device does not support (-200431)."""
        remedy = f"Choose {', '.join(MEASUREMENTS)}." if self.inputs else "It has outputs only; choose Voltage."
        return DaqError(
            f"{where}: {self.product_type} does not support this measurement. {remedy}", Code.PHYS_CHAN_MEAS_TYPE
        )

    def channel_error(self, direction: str, number: int) -> DaqError:
        """Return the error for a channel that the device does not have (-200170)."""
        names = self.channel_names("ai") + self.channel_names("ao")
        return DaqError(
            f"there is no channel {self.name}/{direction}{number}. {self.name} has {', '.join(names) or 'none'}.",
            Code.PHYSICAL_CHAN_DOES_NOT_EXIST,
        )

    def attributes(self, modules: Sequence[str] = ()) -> dict[str, Any]:
        """Return the properties of the device by NI's names; `modules` are the modules in it, if it is a chassis."""
        attributes: dict[str, Any] = {
            "product_type": self.product_type,
            "product_category": self.category,
            "product_num": self.number,
            "serial_num": 0,
            "is_simulated": True,
            "bus_type": self.bus,
            "ai_physical_chans": self.channel_names("ai"),
            "ao_physical_chans": self.channel_names("ao"),
            "chassis_module_dev_names": list(modules),
            "compact_daq_chassis_dev_name": self.chassis,
            "compact_daq_slot_num": self.slot,
            "terminals": [f"/{self.chassis or self.name}/{terminal}" for terminal in _TERMINALS],
            "accessory_product_types": [],
            "accessory_product_nums": [],
            "accessory_serial_nums": [],
            "anlg_trig_supported": bool(self.inputs) and self.analog_trigger,
            "dig_trig_supported": True,
            "time_trig_supported": False,
            "tcpip_ethernet_ip": "",
            "tcpip_hostname": "",
            "tcpip_wireless_ip": "",
            "num_dma_chans": 0,
        }
        lines = ("di_lines", "di_ports", "do_lines", "do_ports", "ci_physical_chans", "co_physical_chans")
        attributes |= {key: [] for key in lines}
        attributes["teds_hwteds_supported"] = bool(self.inputs) and self.teds
        if self.inputs:
            attributes |= {
                "ai_max_single_chan_rate": self.rates.fastest,
                "ai_max_multi_chan_rate": self.aggregate_rate or self.rates.fastest,
                "ai_min_rate": self.rates.slowest,
                "ai_simultaneous_sampling_supported": self.aggregate_rate is None,
                "ai_voltage_rngs": [sign * limit for limit in self.ranges for sign in (-1.0, 1.0)],
                "ai_current_int_excit_discrete_vals": list(self.currents),
                "ai_couplings": sum(_COUPLING_BITS[coupling] for coupling in self.couplings),
                "ai_samp_modes": [int(mode) for mode in SampleMode],
                "ai_supported_meas_types": SUPPORTED_TYPES,
                "ai_trig_usage": _REFERENCE_TRIGGER | _START_TRIGGER,
                "ai_num_samp_timing_engines": 1,
            }
        if self.outputs:
            attributes |= {
                "ao_max_rate": self.output_rates.fastest,
                "ao_min_rate": self.output_rates.slowest,
                "ao_samp_clk_supported": True,
                "ao_voltage_rngs": [-self.output_range, self.output_range],
                "ao_samp_modes": [int(mode) for mode in SampleMode],
                "ao_supported_output_types": [VOLTAGE],
                "ao_trig_usage": _START_TRIGGER,
            }
        return attributes


class DeviceList:
    """Finds devices by their names.

    The device with an empty name has all inputs and outputs. It replaces devices of other hardware, such as Dev1, that
    a script names.
    """

    def __init__(self, modules: Sequence[Module]) -> None:
        self._modules = {module.name.lower(): module for module in modules}

    def module(self, name: str) -> Module:
        """Return a device by its name, or the device with all inputs and outputs for a name that NI's driver assigns.

        Raises `DaqError` -200220 for any other name.
        """
        device_name = name.strip().lstrip("/").partition("/")[0]
        module = self._modules.get(device_name.lower())
        if module is not None:
            return module
        all_channels = self._modules.get("")
        if all_channels is not None and ASSIGNED_BY_DRIVER.fullmatch(device_name):
            return replace(all_channels, name=device_name)
        raise DaqError(
            f"there is no device {device_name!r}: the bench has {', '.join(self.names)}. Give one of these"
            + (", or a name like Dev1, cDAQ1Mod1, PXI1Slot2." if all_channels else "."),
            Code.INVALID_DEVICE_ID,
        )

    def remove(self, name: str) -> Module:
        """Remove a device of the bench, and return it."""
        return self._modules.pop(name.lower())

    def add(self, module: Module) -> None:
        """Add a device."""
        self._modules[module.name.lower()] = module

    def all(self) -> list[Module]:
        """Return the devices on the bench."""
        return [module for module in self._modules.values() if module.name]

    @property
    def names(self) -> list[str]:
        """Names of the devices on the bench."""
        return [module.name for module in self.all()]

    def modules_of(self, chassis: str) -> list[str]:
        """Return the names of the modules in a chassis, by slot."""
        modules = [module for module in self._modules.values() if module.chassis and module.chassis == chassis]
        return [module.name for module in sorted(modules, key=lambda module: module.slot)]
