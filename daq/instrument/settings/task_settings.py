"""Settings of a task: its channels, timing, triggers and streams."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from daq.instrument.devices.measurements import Measurement
from daq.instrument.devices.modules import Module
from daq.instrument.devices.names import numbered, parse_port, unflatten
from daq.instrument.errors import Code, DaqError, invalid_value
from daq.instrument.settings.channels import Channel
from daq.instrument.settings.properties import GROUPS, Properties
from daq.instrument.settings.scales import Scale
from daq.instrument.values import Regeneration, SampleMode, TimingType

# Buffer of a continuous task, samples per channel, up to each rate in S/s, as in NI's driver.
_BUFFER_SIZES = ((100.0, 1000), (10_000.0, 10_000), (1_000_000.0, 100_000), (math.inf, 1_000_000))


class TaskSettings:
    """The settings of a task by NI's names, in groups: timing, trig, read, write, buffer, exported_signal.

    `module` returns a device by its name. `scales` are the custom scales that channels may use.
    """

    def __init__(self, module: Callable[[str], Module], scales: Mapping[str, Scale]) -> None:
        self._module, self._scales = module, scales
        self.channels: list[Channel] = []
        self.groups = {name: Properties(name, defaults) for name, defaults in GROUPS.items()}

    @property
    def kind(self) -> str:
        """Direction of the task: "ai", "ao", or "" without channels."""
        return self.channels[0].side if self.channels else ""

    @property
    def device_names(self) -> list[str]:
        """Names of the devices in use, as in the script."""
        return list(dict.fromkeys(channel.port.device for channel in self.channels))

    @property
    def device(self) -> str:
        """Name of the first device in use."""
        return next(iter(self.device_names), "")

    @property
    def clocked(self) -> bool:
        """Whether the task uses the sample clock."""
        return bool(self.groups["timing"]["samp_timing_type"] == TimingType.SAMPLE_CLOCK)

    @property
    def finite(self) -> bool:
        """Whether the task ends by itself."""
        return bool(self.groups["timing"]["samp_quant_samp_mode"] == SampleMode.FINITE)

    @property
    def rate(self) -> float:
        """Actual rate of the sample clock, S/s."""
        requested = self.groups["timing"]["samp_clk_rate"]
        if not self.channels:
            return float(requested)
        return self.channels[0].module.coerced(requested, output=self.kind == "ao")

    @property
    def regenerates(self) -> bool:
        """Whether the output repeats its buffer."""
        return bool(self.groups["write"]["regen_mode"] == Regeneration.ALLOWED)

    def scale_of(self, channel: Channel) -> Scale | None:
        """Return the custom scale of a channel; None without a scale."""
        if not channel.scaled:
            return None
        if channel.scale_name not in self._scales:
            remedy = f"Choose {', '.join(self._scales)}." if self._scales else "Create it first."
            raise DaqError(
                f"channel {channel.name}: there is no scale {channel.scale_name!r}. {remedy}",
                Code.CUSTOM_SCALE_DOES_NOT_EXIST,
            )
        return self._scales[channel.scale_name]

    def require(self, kind: str) -> None:
        """Raise `DaqError` if the task has no inputs (-200460) or no outputs (-200459)."""
        if self.kind != kind:
            name, code = {
                "ai": ("input", Code.READ_NO_INPUT_CHANS_IN_TASK),
                "ao": ("output", Code.WRITE_NO_OUTPUT_CHANS_IN_TASK),
            }[kind]
            raise DaqError(f"the task has no {name} channels. Add a channel with {kind}_channels.add_...", code)

    def add(self, physical: str, name: str, kind: Measurement | None, given: Mapping[str, Any]) -> list[Channel]:
        """Add channels and return them.

        `physical` are terminals, such as "cDAQ1Mod1/ai0:3". `name` is the virtual name, or the common prefix of several
        names; if it is empty, the names are those of the terminals. `kind` is the kind of measurement of inputs, None
        for outputs. `given` are settings by NI's names. Raises `DaqError` -200171 for a duplicate name, and the errors
        of `Channel.declare`.
        """
        side = "ao" if kind is None else "ai"
        ports = [parse_port(terminal) for terminal in unflatten(physical)]
        if not ports:
            raise DaqError(
                "no physical channel was given. Give a name such as cDAQ1Mod1/ai0:3.",
                Code.PHYSICAL_CHAN_DOES_NOT_EXIST,
            )
        if self.kind not in ("", side):
            raise DaqError(
                "a task has either inputs or outputs. Create another task, and start one by the other's start trigger.",
                Code.TASK_NOT_IN_DATA_NEIGHBORHOOD,
            )
        names = [port.name for port in ports]
        if "," in name:
            listed = [part.strip() for part in name.split(",")]
            if len(listed) > len(names):
                raise invalid_value(f"{len(listed)} names for {len(names)} channels. Give at most one for each.")
            names[: len(listed)] = listed
        elif name:
            names = numbered(name, len(names))
        added: list[Channel] = []
        for port, virtual in zip(ports, names, strict=True):
            module = self._module(port.device)
            if port.kind != side:
                raise module.channel_error(port.kind, port.number)
            used_names = [channel.name.lower() for channel in (*self.channels, *added)]
            if virtual.lower() in used_names and not name:
                # A terminal may be used twice, under different names.
                number = 1
                while f"{virtual}_{number}".lower() in used_names:
                    number += 1
                virtual = f"{virtual}_{number}"
            elif virtual.lower() in used_names:
                raise DaqError(
                    f"the task has a channel {virtual!r} already. Choose another name.", Code.VIRTUAL_CHAN_NAME_USED
                )
            channel = Channel.declare(virtual, port, module, kind, given)
            if side == "ao" and channel.row in [channel.row for channel in (*self.channels, *added)]:
                raise DaqError(
                    f"{port.name} is in the task already. Add each output only once.", Code.CHAN_ALREADY_IN_TASK
                )
            self.scale_of(channel)
            added.append(channel)
        self.channels += added
        return added

    def find(self, names: str) -> list[Channel]:
        """Return channels by their names or the names of their terminals; all channels for an empty string.

        Raises `DaqError` -200488 if there is no channel of that name.
        """
        selected = []
        for name in unflatten(names):
            key = name.lower().lstrip("/")
            matches = [channel for channel in self.channels if key in (channel.name.lower(), channel.port.name.lower())]
            if not matches:
                present = ", ".join(channel.name for channel in self.channels) or "none"
                raise DaqError(
                    f"the task has no channel {name!r}: it has {present}. Add the channel first.",
                    Code.VIRTUAL_CHAN_DOES_NOT_EXIST,
                )
            selected.append(matches[0])
        return selected if names else list(self.channels)

    @property
    def input_size(self) -> int:
        """Samples per channel in the buffer of an input."""
        buffer = self.groups["buffer"]
        if buffer.was_set("input_buf_size"):
            return int(buffer["input_buf_size"])
        if not self.clocked:
            return 0
        samples = int(self.groups["timing"]["samp_quant_samp_per_chan"])
        if self.finite:
            return samples
        return max(next(size for rate, size in _BUFFER_SIZES if self.rate <= rate), samples)

    @property
    def samples(self) -> int:
        """Samples per channel of a finite task, or minimum size of the buffer of a continuous task.

        Raises `DaqError` -200077 for fewer than 2.
        """
        samples = int(self.groups["timing"]["samp_quant_samp_per_chan"])
        if samples < 2 and self.clocked:
            raise invalid_value(f"{samples} samples per channel; expected 2 or more.")
        return samples

    def rows_to_read(self) -> list[int]:
        """Return the indexes in the task of the channels that reads return."""
        return [self.channels.index(channel) for channel in self.find(self.groups["read"]["channels_to_read"])]
