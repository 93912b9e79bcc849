"""Settings of a task: its channels, timing, triggers and streams."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from daq.extras.ni_device.devices.measurements import Measurement
from daq.extras.ni_device.devices.modules import Module
from daq.extras.ni_device.devices.names import numbered, parse_port, unflatten
from daq.extras.ni_device.errors import Code, DaqError, invalid_value
from daq.extras.ni_device.settings.channels import Channel
from daq.extras.ni_device.settings.properties import GROUPS, Properties
from daq.extras.ni_device.settings.scales import Scale
from daq.extras.ni_device.values import Regeneration, SampleMode, TimingType

# Default size of the buffer of a continuous task, as in NI's driver: highest rate, S/s, and samples per channel.
_BUFFER_SIZES = ((100.0, 1000), (10_000.0, 10_000), (1_000_000.0, 100_000), (math.inf, 1_000_000))


class TaskSettings:
    """The settings of a task by NI's names, in groups: timing, trig, read, write, buffer, exported_signal.

    `find_module` returns a device by its name. `scales` are the custom scales that channels may use.
    """

    def __init__(self, find_module: Callable[[str], Module], scales: Mapping[str, Scale]) -> None:
        self._find_module, self._scales = find_module, scales
        self.channels: list[Channel] = []
        self.groups = {name: Properties(name, defaults) for name, defaults in GROUPS.items()}

    @property
    def direction(self) -> str:
        """Direction of the task: "ai" (inputs), "ao" (outputs), or "" without channels."""
        return self.channels[0].direction if self.channels else ""

    @property
    def device_names(self) -> list[str]:
        """Names of the devices in use, as the script spells them."""
        return list(dict.fromkeys(channel.port.device for channel in self.channels))

    @property
    def device(self) -> str:
        """Name of the first device in use."""
        return next(iter(self.device_names), "")

    @property
    def has_sample_clock(self) -> bool:
        """Whether the task uses the sample clock."""
        return bool(self.groups["timing"]["samp_timing_type"] == TimingType.SAMPLE_CLOCK)

    @property
    def is_finite(self) -> bool:
        """Whether the task ends by itself."""
        return bool(self.groups["timing"]["samp_quant_samp_mode"] == SampleMode.FINITE)

    @property
    def rate(self) -> float:
        """Actual rate of the sample clock, S/s."""
        requested = self.groups["timing"]["samp_clk_rate"]
        if not self.channels:
            return float(requested)
        return self.clock_modules[0].coerced_rate(requested, output=self.direction == "ao")

    @property
    def clock_modules(self) -> list[Module]:
        """Modules that determine the rate: those of delta-sigma converters, which other modules of a chassis follow."""
        modules = [channel.module for channel in self.channels]
        output = self.direction == "ao"
        return [module for module in modules if not module.chassis or module.rates_of(output).available] or modules

    @property
    def max_rate(self) -> float:
        """Highest rate of the sample clock, S/s: that of the slowest device."""
        modules = [channel.module for channel in self.channels]
        output = self.direction == "ao"
        return min((module.max_rate(modules.count(module), output) for module in modules), default=math.inf)

    @property
    def regenerates(self) -> bool:
        """Whether the output repeats its buffer."""
        return bool(self.groups["write"]["regen_mode"] == Regeneration.ALLOWED)

    def scale_of(self, channel: Channel) -> Scale | None:
        """Return the custom scale of a channel; None without a scale."""
        if not channel.has_custom_scale:
            return None
        if channel.scale_name not in self._scales:
            remedy = f"Choose {', '.join(self._scales)}." if self._scales else "Create the scale first."
            raise DaqError(
                f"channel {channel.name}: there is no scale {channel.scale_name!r}. {remedy}",
                Code.CUSTOM_SCALE_DOES_NOT_EXIST,
            )
        return self._scales[channel.scale_name]

    def require(self, direction: str) -> None:
        """Raise `DaqError` if the task has no channels of this direction: -200460 for inputs, -200459 for outputs."""
        if self.direction != direction:
            name, code = {
                "ai": ("input", Code.READ_NO_INPUT_CHANS_IN_TASK),
                "ao": ("output", Code.WRITE_NO_OUTPUT_CHANS_IN_TASK),
            }[direction]
            raise DaqError(f"the task has no {name} channels. Add a channel with {direction}_channels.add_...", code)

    def add(
        self, physical_channels: str, name: str, measurement: Measurement | None, settings: Mapping[str, Any]
    ) -> list[Channel]:
        """Add channels and return them.

        `physical_channels` are names such as "cDAQ1Mod1/ai0:3". `name` is the virtual name, a list of virtual names, or
        the prefix of numbered virtual names; if it is empty, the names of the physical channels are used. `measurement`
        is None for outputs. `settings` are initial properties by NI's names. Raises `DaqError` -200171 for a duplicate
        name, and the errors of `Channel.declare`.
        """
        direction = "ao" if measurement is None else "ai"
        ports = [parse_port(terminal) for terminal in unflatten(physical_channels)]
        if not ports:
            raise DaqError(
                "no physical channel was given. Give a name such as cDAQ1Mod1/ai0:3.", Code.PHYSICAL_CHAN_DOES_NOT_EXIST
            )
        if self.direction not in ("", direction):
            raise DaqError(
                "a task has either inputs or outputs. Use two tasks, and start one by the other's start trigger.",
                Code.TASK_NOT_IN_DATA_NEIGHBORHOOD,
            )
        names = [port.name for port in ports]
        if "," in name:
            listed = [part.strip() for part in name.split(",")]
            if len(listed) > len(names):
                raise invalid_value(
                    f"there are {len(listed)} names for {len(names)} channels. Give at most one name per channel."
                )
            names[: len(listed)] = listed
        elif name:
            names = numbered(name, len(names))
        added: list[Channel] = []
        for port, virtual_name in zip(ports, names, strict=True):
            module = self._find_module(port.device)
            if port.direction != direction:
                raise module.channel_error(port.direction, port.number)
            used_names = [channel.name.lower() for channel in (*self.channels, *added)]
            if virtual_name.lower() in used_names and not name:
                # A terminal may be used twice, under different virtual names.
                number = 1
                while f"{virtual_name}_{number}".lower() in used_names:
                    number += 1
                virtual_name = f"{virtual_name}_{number}"
            elif virtual_name.lower() in used_names:
                raise DaqError(
                    f"the task already has a channel {virtual_name!r}. Choose another name.",
                    Code.VIRTUAL_CHAN_NAME_USED,
                )
            channel = Channel.declare(virtual_name, port, module, measurement, settings)
            used_indices = [other.bench_index for other in (*self.channels, *added)]
            if direction == "ao" and channel.bench_index in used_indices:
                raise DaqError(
                    f"{port.name} is already in the task. Add each output only once.", Code.REPEATED_PHYSICAL_CHAN
                )
            self.scale_of(channel)
            added.append(channel)
        self.channels += added
        return added

    def find(self, names: str) -> list[Channel]:
        """Return channels by names or terminals, all for an empty string; `DaqError` -200488 if a name is unknown."""
        selected = []
        for name in unflatten(names):
            key = name.lower().lstrip("/")
            matches = [channel for channel in self.channels if key in (channel.name.lower(), channel.port.name.lower())]
            if not matches:
                present = ", ".join(channel.name for channel in self.channels) or "none"
                raise DaqError(
                    f"the task has no channel {name!r}; it has {present}. Add the channel first.",
                    Code.VIRTUAL_CHAN_DOES_NOT_EXIST,
                )
            selected.append(matches[0])
        return selected if names else list(self.channels)

    @property
    def input_buffer_size(self) -> int:
        """Size of the buffer of the inputs, samples per channel; 0 without a sample clock."""
        buffer = self.groups["buffer"]
        if buffer.was_set("input_buf_size"):
            return int(buffer["input_buf_size"])
        if not self.has_sample_clock:
            return 0
        samples = int(self.groups["timing"]["samp_quant_samp_per_chan"])
        if self.is_finite:
            return samples
        return max(next(size for max_rate, size in _BUFFER_SIZES if self.rate <= max_rate), samples)

    @property
    def samples_per_channel(self) -> int:
        """Samples per channel of a finite task, or minimum size of the buffer of a continuous task.

        Raises `DaqError` -200077 for fewer than 2 samples with a sample clock.
        """
        samples = int(self.groups["timing"]["samp_quant_samp_per_chan"])
        if samples < 2 and self.has_sample_clock:
            raise invalid_value(f"samps_per_chan is {samples}. Give 2 or more samples per channel.")
        return samples

    def indices_to_read(self) -> list[int]:
        """Return the indices of the channels whose samples a read returns."""
        return [self.channels.index(channel) for channel in self.find(self.groups["read"]["channels_to_read"])]
