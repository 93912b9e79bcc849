"""Description of a bench without mechanics: modules, wires from outputs to inputs, and voltage sources."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from daq.extras.ni_device.connecting import name_devices, with_inputs, with_outputs
from daq.extras.ni_device.devices.measurements import MEASUREMENTS
from daq.extras.ni_device.devices.modules import (
    CHASSIS_CATEGORY,
    CHASSIS_TIMEBASE_HZ,
    COMPACT_DAQ_BUS,
    MODULE_CATEGORY,
    MULTIFUNCTION_CATEGORY,
    USB_BUS,
    Module,
)
from daq.extras.ni_device.devices.names import parse_port, unflatten
from daq.extras.ni_device.settings.task_settings import TaskSettings
from daq.extras.ni_device.values import Coupling, SampleMode, TerminalConfiguration, TimingType
from rig.core.base.errors import SceneError
from rig.core.data_sheets.data_sheets import data_sheets
from rig.core.data_sheets.modules import Rates, module
from rig.core.settings.problems import KeyPath, Problem, describe, problems_of
from rig.core.settings.quantities import FREQUENCY, SAMPLE_RATE, VOLTAGE
from rig.core.settings.quantity_field import Quantity
from rig.core.settings.settings import Settings

Voltage = Annotated[float, Quantity(VOLTAGE)]
Range = Annotated[float, Quantity(VOLTAGE, above=0.0)]
Frequency = Annotated[float, Quantity(FREQUENCY, above=0.0)]
SampleRate = Annotated[float, Quantity(SAMPLE_RATE, above=0.0)]
#: Voltage of a source [V], as a function of bench time [s]; argument and result are arrays of the same shape.
VoltageFunction = Callable[[NDArray[np.float64]], NDArray[np.float64]]
_WIRE = re.compile(r"\s*(\S+)\s*->\s*(\S+)\s*")
_NAME_IN_CHASSIS = re.compile(r"(.+)Mod([1-9]\d*)")
# Lowest sample rate [Hz] of a device that is described by its numbers of channels; slower tests would take hours.
_SLOWEST_HZ = 0.1
# Timebase of M Series devices such as USB-6211 [Hz].
_USB_TIMEBASE_HZ = 20e6
# Number of slots by type of chassis.
_SLOTS = {
    **dict.fromkeys(("cDAQ-9171", "cDAQ-9181", "cDAQ-9191"), 1),
    **dict.fromkeys(("cDAQ-9132", "cDAQ-9134", "cDAQ-9136", "cDAQ-9174", "cDAQ-9184", "cDAQ-9185"), 4),
    **dict.fromkeys(
        (
            *("cDAQ-9133", "cDAQ-9135", "cDAQ-9137", "cDAQ-9138", "cDAQ-9172"),
            *("cDAQ-9178", "cDAQ-9188", "cDAQ-9188XT", "cDAQ-9189"),
        ),
        8,
    ),
    **dict.fromkeys(("cDAQ-9139", "cDAQ-9179"), 14),
}


class ModuleDescription(Settings):
    """A device by its product type, or by its numbers of channels if no data sheet has this type."""

    product_type: Annotated[str, Field(min_length=1, max_length=80)]
    """Name in the driver, such as NI 9234."""
    name: Annotated[str, Field(min_length=1, max_length=80)] | None = None
    """Name on the bench, such as cDAQ1Mod1 or Dev1; None: as the driver assigns it."""
    family: Literal["c_series", "usb"] = "usb"
    """Whether it is a module in a chassis (c_series), or a separate device (usb, also for PCI and PXI)."""
    timebase: Frequency | None = None
    """Clock that the sample clocks divide [Hz]; None: that of the chassis, or 20 MHz of a separate device."""
    inputs: Annotated[int, Field(ge=0, le=1000)] = 0
    """Number of analog inputs."""
    terminals: Annotated[tuple[Literal["rse", "nrse", "differential"], ...], Field(min_length=1)] = (
        "rse",
        "nrse",
        "differential",
    )
    """Terminal configurations of the inputs; the last is the default."""
    aggregate: SampleRate | None = None
    """Highest total sample rate of inputs that share a converter [Hz]; None: simultaneous inputs."""
    ranges: Annotated[float | tuple[float, ...], Quantity(VOLTAGE, above=0.0, listed=True)] = 10.0
    """Ranges of the inputs, ± V."""
    bits: Annotated[int, Field(ge=2, le=32)] = 16
    """Resolution of the inputs."""
    fastest: SampleRate = 250e3
    """Highest sample rate of the inputs [Hz]."""
    analog_trigger: bool = True
    """Whether an analog input can be the source of a trigger."""
    outputs: Annotated[int, Field(ge=0, le=1000)] = 0
    """Number of analog outputs."""
    output_range: Range = 10.0
    """Range of the outputs, ± V."""
    output_bits: Annotated[int, Field(ge=2, le=32)] = 16
    """Resolution of the outputs."""
    output_fastest: SampleRate = 250e3
    """Highest sample rate of the outputs [Hz]."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the channels of the device are known."""
        if not (self.inputs or self.outputs or self.product_type in _modules_with_data_sheet()):
            names = sorted([*_modules_with_data_sheet(), *_common_devices()])
            yield Problem(
                ("product_type",),
                f"no data sheet for {self.product_type!r}. Choose {', '.join(names)}, or give the "
                "channels of the device, such as {product_type: USB-6211, inputs: 16, outputs: 2, fastest: 250 kHz}",
            )
        if self.aggregate is not None and self.aggregate > self.fastest:
            yield Problem(("aggregate",), f"{self.aggregate:g} Hz exceeds fastest, {self.fastest:g} Hz. Reduce it")
        fastest = max(self.fastest if self.inputs else 0.0, self.output_fastest if self.outputs else 0.0)
        if self.timebase is not None and self.timebase < fastest:
            yield Problem(("timebase",), f"{self.timebase:g} Hz is below the fastest rate, {fastest:g} Hz. Increase it")

    def to_module(self, first_input: int, first_output: int) -> Module:
        """Return the device without a name, with the next inputs and outputs of the bench."""
        if not (self.inputs or self.outputs):
            sheet = module(self.product_type)
            device = Module("", sheet.product_type, bits=sheet.input_bits)
            if sheet.inputs is not None:
                device = with_inputs(device, sheet, sheet.inputs)
            if sheet.outputs is not None:
                device = with_outputs(device, sheet, sheet.outputs)
            counts = [0 if channels is None else channels.channels for channels in (sheet.inputs, sheet.outputs)]
        else:
            timebase = self.timebase or (None if self.family == "c_series" else _USB_TIMEBASE_HZ)
            device = Module(
                "",
                self.product_type,
                category=MODULE_CATEGORY if self.family == "c_series" else MULTIFUNCTION_CATEGORY,
                bus=COMPACT_DAQ_BUS if self.family == "c_series" else USB_BUS,
                ranges=tuple(np.sort(np.atleast_1d(self.ranges)).tolist()),
                bits=self.bits,
                rates=Rates(_SLOWEST_HZ, self.fastest, timebase=timebase),
                aggregate_rate=self.aggregate,
                output_range=self.output_range,
                output_bits=self.output_bits,
                output_rates=Rates(_SLOWEST_HZ, self.output_fastest, timebase=timebase),
                couplings=(Coupling.DC,),
                terminal_configurations=tuple(TerminalConfiguration[name.upper()] for name in self.terminals),
                currents=(),
                analog_trigger=self.analog_trigger,
                teds=False,
            )
            counts = [self.inputs, self.outputs]
        return replace(
            device,
            inputs=tuple(range(first_input, first_input + counts[0])),
            outputs=tuple(range(first_output, first_output + counts[1])),
        )


@cache
def _modules_with_data_sheet() -> list[str]:
    return [name for name, sheet in data_sheets().items() if "module" in sheet.facts]


@cache
def _common_devices() -> dict[str, dict[str, Any]]:
    """Return the descriptions of common devices without a data sheet, by their product types."""
    return dict(yaml.safe_load((files(__package__) / "devices.yaml").read_text(encoding="utf-8")))


class Source(Settings):
    """A voltage source: a sine on an offset."""

    offset: Voltage = 0.0
    """Constant voltage [V]."""
    amplitude: Voltage = 0.0
    """Amplitude of the sine [V]."""
    frequency: Frequency | None = None
    """Frequency of the sine [Hz]."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that a sine has a frequency."""
        if self.amplitude and self.frequency is None:
            yield Problem(("frequency",), "missing; a source with an amplitude requires it")

    def voltage(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the voltage [V] at times in s."""
        return self.offset + self.amplitude * np.sin(2.0 * np.pi * (self.frequency or 0.0) * time)


class SavedTask(Settings):
    """A voltage task that the program loads by its name, as from NI MAX."""

    channels: Annotated[str, Field(min_length=1)]
    """Physical channels, such as cDAQ1Mod1/ai0:3."""
    rate: SampleRate = 1000.0
    """Sample rate [Hz]."""
    samples: Annotated[int, Field(ge=2)] | None = None
    """Samples per channel of a finite task; None: continuous."""

    def configure(self, task: TaskSettings) -> None:
        """Add channels and timing to a task."""
        is_output = parse_port(unflatten(self.channels)[0]).direction == "ao"
        task.add(self.channels, "", None if is_output else MEASUREMENTS["Voltage"], {})
        timing = task.groups["timing"]
        timing["samp_timing_type"], timing["samp_clk_rate"] = TimingType.SAMPLE_CLOCK, self.rate
        timing["samp_quant_samp_mode"] = SampleMode.CONTINUOUS if self.samples is None else SampleMode.FINITE
        timing["samp_quant_samp_per_chan"] = self.samples or 1000


class BenchDescription(Settings):
    """A bench without mechanics."""

    modules: Annotated[tuple[ModuleDescription, ...], Field(min_length=1)]
    """Devices, in the order of their slots: product types, or a mapping from names to product types."""
    chassis: str = "cDAQ-9178"
    """Product type of the chassis of C Series modules."""
    wires: tuple[str, ...] = ()
    """Connections of outputs to inputs, such as ao0 -> ai0."""
    sources: dict[str, Source] = Field(default_factory=dict)
    """Voltage sources at inputs: a voltage, or the keys offset, amplitude and frequency."""
    pulses: dict[str, Frequency] = Field(default_factory=dict)
    """Frequencies of pulses at trigger terminals, such as PFI0; the first rises after one period [Hz]."""
    tasks: dict[str, SavedTask] = Field(default_factory=dict)
    """Saved tasks by name."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the chassis is known."""
        if self.chassis not in _SLOTS:
            yield Problem(("chassis",), f"no chassis {self.chassis!r} is known. Choose {', '.join(sorted(_SLOTS))}")

    @classmethod
    def prepare(cls, content: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[Problem]]:
        """Convert product types to descriptions of modules, and voltages to sources."""
        prepared = dict(content)
        modules, sources, chassis = (content.get(key) for key in ("modules", "sources", "chassis"))
        if isinstance(chassis, str):
            prepared["chassis"] = _spelled_as(chassis, _SLOTS)
        if isinstance(modules, Mapping):
            prepared["modules"] = [
                {"name": name, **(keys if isinstance(keys := _module_keys(item), Mapping) else {"product_type": keys})}
                for name, item in modules.items()
            ]
        elif isinstance(modules, list | tuple):
            prepared["modules"] = [_module_keys(item) for item in modules]
        if isinstance(sources, Mapping):
            prepared["sources"] = {
                channel: source if isinstance(source, Mapping | Source) else {"offset": source}
                for channel, source in sources.items()
            }
        return prepared, []


def _module_keys(item: Any) -> Any:
    """Return the keys of a module that may be given by its product type only."""
    if not isinstance(item, str):
        return item
    name = _spelled_as(item, (*_modules_with_data_sheet(), *_common_devices()))
    return {"product_type": name, **_common_devices().get(name, {})}


def _spelled_as(name: str, known_names: Iterable[str]) -> str:
    """Return the known name that differs from a name only by case, spaces and hyphens, or the name itself."""

    def normalize(text: str) -> str:
        return re.sub(r"[\s-]", "", text).lower()

    return next((known for known in known_names if normalize(known) == normalize(name)), name)


class BenchError(SceneError):
    """A bench without mechanics that is not possible, or a request that it cannot fulfill."""


@dataclass(frozen=True)
class WiredBench:
    """The devices of a bench, and the outputs and sources connected to its inputs, by indices on the bench."""

    modules: tuple[Module, ...]
    wires: Mapping[int, int]  # output at each wired input
    sources: Mapping[int, VoltageFunction]
    pulses: Mapping[str, float]  # frequencies of pulses at terminals, by their names in lower case [Hz]
    tasks: Mapping[str, SavedTask]


def wired_bench(
    content: Mapping[str, Any], where: str = "bench", line: Callable[[KeyPath], int] | None = None
) -> WiredBench:
    """Check the content of a description and return its bench.

    A source may also be a function of time; see `VoltageFunction`. `where` and `line` locate problems in messages.
    Raises `BenchError` if the content has problems; the message has one line for each.
    """
    sources = content.get("sources")
    functions = {key: item for key, item in sources.items() if callable(item)} if isinstance(sources, Mapping) else {}
    if functions and isinstance(sources, Mapping):
        content = {**content, "sources": {key: item for key, item in sources.items() if key not in functions}}
    try:
        description = BenchDescription.model_validate(content)
    except ValidationError as error:
        raise BenchError(describe(problems_of(error), where, line)) from None
    modules = _with_chassis_timebase(_named_modules(description))
    slots = _SLOTS[description.chassis]
    if surplus := next((device.name for device in modules if device.slot > slots), None):
        raise BenchError(
            f"{where}: modules: {surplus} is in no slot: {description.chassis} has {slots} slots. Remove it."
        )
    names = [device.name.lower() for device in modules]
    if repeated := next((device.name for device in modules if names.count(device.name.lower()) > 1), None):
        raise BenchError(f"{where}: modules: {repeated!r} is the name of two devices. Give each device its own name.")
    wires: dict[int, int] = {}
    voltages: dict[int, VoltageFunction] = {}
    for wire in description.wires:
        match = _WIRE.fullmatch(wire)
        if match is None:
            raise BenchError(f"{where}: wires: {wire!r} is not a wire. Write it as ao0 -> ai0.")
        output, target = (find_channel(modules, match[1], "ao", where), find_channel(modules, match[2], "ai", where))
        _check_unconnected(target[1], match[2], (wires,), where)
        wires[target[1]] = output[1]
    for name, source in {**description.sources, **functions}.items():
        index = find_channel(modules, name, "ai", where)[1]
        _check_unconnected(index, name, (wires, voltages), where)
        voltages[index] = source.voltage if isinstance(source, Source) else source
    pulses: dict[str, float] = {}
    owners = {device.name.lower(): (device.chassis or device.name).lower() for device in modules}
    for terminal, frequency in description.pulses.items():
        name, _, port = terminal.lower().lstrip("/").rpartition("/")
        if not re.fullmatch(r"pfi\d+", port) or (name and name not in owners):
            raise BenchError(f"{where}: pulses: {terminal!r} is not a trigger terminal. Give a name such as PFI0.")
        pulses[f"{owners[name]}/{port}" if name else port] = frequency
    return WiredBench(tuple(modules), wires, voltages, pulses, description.tasks)


def _check_unconnected(index: int, name: str, connected: Sequence[Mapping[int, Any]], where: str) -> None:
    if any(index in connections for connections in connected):
        raise BenchError(f"{where}: {name} is connected twice. Connect one wire or one source to each input.")


def _named_modules(description: BenchDescription) -> list[Module]:
    modules: list[Module] = []
    for item in description.modules:
        n_inputs, n_outputs = (sum(len(getattr(device, key)) for device in modules) for key in ("inputs", "outputs"))
        modules.append(replace(item.to_module(n_inputs, n_outputs), name=item.name or ""))
    if not any(device.name for device in modules):
        return name_devices(modules, description.chassis)
    chassis: dict[str, Module] = {}
    for index, device in enumerate(modules):
        if device.bus != COMPACT_DAQ_BUS:
            continue
        match = _NAME_IN_CHASSIS.fullmatch(device.name)
        if match is None:
            raise BenchError(
                f"modules: {device.product_type} is in a chassis, which its name {device.name!r} does not state. "
                "Choose a name of chassis and slot, such as cDAQ1Mod1."
            )
        name, slot = match[1], int(match[2])
        chassis[name] = Module(name, description.chassis, category=CHASSIS_CATEGORY, bus=USB_BUS)
        modules[index] = replace(device, chassis=name, slot=slot)
    return [*chassis.values(), *modules]


def _with_chassis_timebase(modules: Sequence[Module]) -> list[Module]:
    """Let the sample clocks of C Series modules divide the timebase of their chassis.

    Next to delta-sigma modules, which have a timebase of their own, the rates of other modules remain exact: inputs and
    outputs of the same requested rate do not drift apart.
    """
    delta_sigma = {
        device.chassis
        for device in modules
        if (device.inputs and device.rates.available) or (device.outputs and device.output_rates.available)
    }

    def dividing(rates: Rates) -> Rates:
        return replace(rates, timebase=rates.timebase or CHASSIS_TIMEBASE_HZ)

    return [
        replace(device, rates=dividing(device.rates), output_rates=dividing(device.output_rates))
        if device.chassis and device.chassis not in delta_sigma
        else device
        for device in modules
    ]


def find_channel(modules: Iterable[Module], name: str, direction: str, where: str) -> tuple[str, int]:
    """Return name and index on the bench of a channel: `cDAQ1Mod1/ai0`, or `ai0` if only one device has this channel.

    `direction` is "ai" or "ao". Raises `BenchError` if there is no such channel, or several.
    """
    channels = {
        channel: index
        for device in modules
        for channel, index in zip(
            device.channel_names(direction), device.inputs if direction == "ai" else device.outputs, strict=True
        )
    }
    key = name.strip().lstrip("/").lower()
    matches = [channel for channel in channels if key in (channel.lower(), channel.lower().partition("/")[2])]
    if len(matches) == 1:
        return matches[0], channels[matches[0]]
    kind = "input" if direction == "ai" else "output"
    if matches:
        raise BenchError(f"{where}: {name!r} is ambiguous. Choose {' or '.join(matches)}.")
    raise BenchError(
        f"{where}: the bench has no {kind} {name!r}. Its {kind}s are {', '.join(channels) or 'none'}; choose one."
    )
