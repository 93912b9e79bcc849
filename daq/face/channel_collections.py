"""Adding channels to a task."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from daq.face import argument
from daq.face.constants import (
    AccelSensitivityUnits,
    AccelUnits,
    ChannelType,
    Coupling,
    ExcitationSource,
    ForceIEPESensorSensitivityUnits,
    ForceUnits,
    TerminalConfiguration,
    UsageTypeAI,
    UsageTypeAO,
    VelocityIEPESensorSensitivityUnits,
    VelocityUnits,
    VoltageUnits,
)
from daq.face.virtual_channels import Channel, Terminal, check
from daq.instrument.errors import DaqError, DAQmxErrors, unsupported
from daq.instrument.terminals import parse_port, unflatten

if TYPE_CHECKING:
    from daq.face.task import Task

_WIRING = frozenset({"ai_coupling", "ai_excit_src", "ai_excit_val", "ai_term_cfg", "description"})
_WRITABLE = _WIRING | {"ai_max", "ai_min", "units", "sensitivity", "sensitivity_units"}


class ChannelCollection(Sequence[Channel]):
    """The channels of a task, in the order in which they were added."""

    kind = ""

    def __init__(self, task: Task) -> None:
        self._task = task
        self.terminals: list[Terminal] = []

    @property
    def channel_names(self) -> list[str]:
        """Names of the channels."""
        return [each.name for each in self.terminals]

    @property
    def all(self) -> Channel:
        """All channels, as one."""
        return Channel(self._task, self.terminals)

    def __len__(self) -> int:
        return len(self.terminals)

    def __iter__(self) -> Iterator[Channel]:
        return iter(self.all)

    def __contains__(self, item: object) -> bool:
        names = item.channel_names if isinstance(item, Channel) else unflatten(str(item))
        return all(name in self.channel_names for name in names)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, str):
            return Channel(self._task, self.find(unflatten(index)))
        picked = self.terminals[index]
        return Channel(self._task, picked if isinstance(picked, list) else [picked])

    def find(self, names: Sequence[str]) -> list[Terminal]:
        """Find channels by their names, or those of their terminals.

        Raises
        ------
        DaqError
            With -200498, if there is none of that name.
        """
        found = []
        for name in names:
            wanted = name.lower().lstrip("/")
            match = [
                each
                for each in self.terminals
                if wanted in (each.name.lower(), each.physical.lower().lstrip("/"))
            ]
            if not match:
                raise DaqError(
                    f"the task has no channel {name!r}: it has {', '.join(self.channel_names) or 'none'}",
                    DAQmxErrors.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING,
                    self._task.name,
                )
            found.append(match[0])
        return found

    def _add(
        self, physical_channel: str, name: str, settings: dict[str, Any], writable: frozenset[str]
    ) -> Channel:
        task = self._task
        task.check_idle(f"adding {physical_channel}")
        ports = unflatten(physical_channel) if isinstance(physical_channel, str) else []
        if not ports:
            raise DaqError(
                f"no physical channel was given but {physical_channel!r}: expected for instance cDAQ1Mod1/ai0:3",
                DAQmxErrors.PHYSICAL_CHAN_DOES_NOT_EXIST,
                task.name,
            )
        if task.kind not in ("", self.kind):
            raise DaqError(
                "a task has either inputs or outputs: make another task and start one by the other's start "
                "trigger",
                DAQmxErrors.INVALID_ATTRIBUTE_VALUE,
                task.name,
            )
        names = _names(name, ports, task.name)
        new: list[Terminal] = []
        for port, virtual in zip(ports, names, strict=True):
            terminal = Terminal(virtual, port.lstrip("/"), self._number(port), dict(settings), writable)
            taken = [*self.terminals, *new]
            if any(virtual == each.name or terminal.is_on(each) for each in taken):
                raise DaqError(
                    f"channel {virtual!r} on {port} is in the task already: each terminal and each name once",
                    DAQmxErrors.CHAN_ALREADY_IN_TASK,
                    task.name,
                )
            check(task.chassis, terminal)
            new.append(terminal)
        self.terminals += new
        return Channel(task, new)

    def _number(self, name: str) -> int:
        port = parse_port(name)
        chassis = self._task.chassis
        there = len(chassis.inputs) if self.kind == "ai" else chassis.outputs
        if port.kind != self.kind or port.number >= there:
            have = f"{self.kind}0" + (f":{there - 1}" if there > 1 else "")
            raise DaqError(
                f"there is no physical channel {name} for {self._what}: "
                + (f"the bench has {have}" if there else "the scene on the bench has none"),
                DAQmxErrors.PHYSICAL_CHAN_DOES_NOT_EXIST,
                self._task.name,
            )
        return port.number

    @property
    def _what(self) -> str:
        return "analog input" if self.kind == "ai" else "analog output"

    def __getattr__(self, name: str) -> Any:
        if name.startswith("add_"):
            raise unsupported(f"{name} ({self._what})")
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")


def _names(given: str, ports: list[str], task: str) -> list[str]:
    """Name channels: a list gives each its name, one name for several is numbered; without, as their terminals."""
    names = unflatten(given)
    if len(names) > len(ports):
        raise DaqError(
            f"{len(names)} names for {len(ports)} channel(s), {given!r} for {', '.join(ports)}: expected a name "
            "for each, or one for all",
            DAQmxErrors.INVALID_ATTRIBUTE_VALUE,
            task,
        )
    if len(names) == 1 and len(ports) > 1:
        return [f"{names[0]}{i}" for i in range(len(ports))]
    return [*names, *ports[len(names) :]]


class AIChannelCollection(ChannelCollection):
    """Input channels of a task."""

    kind = "ai"

    def add_ai_voltage_chan(
        self,
        physical_channel: str,
        name_to_assign_to_channel: str = "",
        terminal_config: TerminalConfiguration = TerminalConfiguration.DEFAULT,
        min_val: float = -5.0,
        max_val: float = 5.0,
        units: VoltageUnits = VoltageUnits.VOLTS,
        custom_scale_name: str = "",
    ) -> Channel:
        """Add inputs that read volts."""
        return self._sensor(
            UsageTypeAI.VOLTAGE,
            physical_channel,
            name_to_assign_to_channel,
            custom_scale_name,
            {
                "ai_term_cfg": terminal_config,
                "ai_min": min_val,
                "ai_max": max_val,
                "units": argument.choice(VoltageUnits, units, "units"),
            },
            (ExcitationSource.NONE, 0.0),
        )

    def add_ai_accel_chan(
        self,
        physical_channel: str,
        name_to_assign_to_channel: str = "",
        terminal_config: TerminalConfiguration = TerminalConfiguration.DEFAULT,
        min_val: float = -5.0,
        max_val: float = 5.0,
        units: AccelUnits = AccelUnits.G,
        sensitivity: float = 1000.0,
        sensitivity_units: AccelSensitivityUnits = AccelSensitivityUnits.MILLIVOLTS_PER_G,
        current_excit_source: ExcitationSource = ExcitationSource.INTERNAL,
        current_excit_val: float = 0.004,
        custom_scale_name: str = "",
    ) -> Channel:
        """Add inputs that read acceleration; limits are in `units`."""
        return self._sensor(
            UsageTypeAI.ACCELERATION_ACCELEROMETER_CURRENT_INPUT,
            physical_channel,
            name_to_assign_to_channel,
            custom_scale_name,
            {
                "ai_term_cfg": terminal_config,
                "ai_min": min_val,
                "ai_max": max_val,
                "units": argument.choice(AccelUnits, units, "units"),
                "sensitivity": argument.number(sensitivity, "sensitivity"),
                "sensitivity_units": argument.choice(
                    AccelSensitivityUnits, sensitivity_units, "sensitivity_units"
                ),
            },
            (current_excit_source, current_excit_val),
        )

    def add_ai_force_iepe_chan(
        self,
        physical_channel: str,
        name_to_assign_to_channel: str = "",
        terminal_config: TerminalConfiguration = TerminalConfiguration.DEFAULT,
        min_val: float = -2000.0,
        max_val: float = 2000.0,
        units: ForceUnits = ForceUnits.NEWTONS,
        sensitivity: float = 2.25,
        sensitivity_units: ForceIEPESensorSensitivityUnits = (
            ForceIEPESensorSensitivityUnits.MILLIVOLTS_PER_NEWTON
        ),
        current_excit_source: ExcitationSource = ExcitationSource.INTERNAL,
        current_excit_val: float = 0.004,
        custom_scale_name: str = "",
    ) -> Channel:
        """Add inputs that read force (a hammer, a force sensor); limits are in `units`."""
        return self._sensor(
            UsageTypeAI.FORCE_IEPE_SENSOR,
            physical_channel,
            name_to_assign_to_channel,
            custom_scale_name,
            {
                "ai_term_cfg": terminal_config,
                "ai_min": min_val,
                "ai_max": max_val,
                "units": argument.choice(ForceUnits, units, "units"),
                "sensitivity": argument.number(sensitivity, "sensitivity"),
                "sensitivity_units": argument.choice(
                    ForceIEPESensorSensitivityUnits, sensitivity_units, "sensitivity_units"
                ),
            },
            (current_excit_source, current_excit_val),
        )

    def add_ai_velocity_iepe_chan(
        self,
        physical_channel: str,
        name_to_assign_to_channel: str = "",
        terminal_config: TerminalConfiguration = TerminalConfiguration.DEFAULT,
        min_val: float = -50.0,
        max_val: float = 50.0,
        units: VelocityUnits = VelocityUnits.INCHES_PER_SECOND,
        sensitivity: float = 100.0,
        sensitivity_units: VelocityIEPESensorSensitivityUnits = (
            VelocityIEPESensorSensitivityUnits.MILLIVOLTS_PER_INCH_PER_SECOND
        ),
        current_excit_source: ExcitationSource = ExcitationSource.INTERNAL,
        current_excit_val: float = 0.002,
        custom_scale_name: str = "",
    ) -> Channel:
        """Add inputs that read velocity; limits are in `units`."""
        return self._sensor(
            UsageTypeAI.VELOCITY_IEPE_SENSOR,
            physical_channel,
            name_to_assign_to_channel,
            custom_scale_name,
            {
                "ai_term_cfg": terminal_config,
                "ai_min": min_val,
                "ai_max": max_val,
                "units": argument.choice(VelocityUnits, units, "units"),
                "sensitivity": argument.number(sensitivity, "sensitivity"),
                "sensitivity_units": argument.choice(
                    VelocityIEPESensorSensitivityUnits, sensitivity_units, "sensitivity_units"
                ),
            },
            (current_excit_source, current_excit_val),
        )

    def _sensor(
        self,
        measures: UsageTypeAI,
        physical_channel: str,
        name: str,
        custom_scale: str,
        settings: dict[str, Any],
        excitation: tuple[ExcitationSource, float],
    ) -> Channel:
        if custom_scale or settings["units"].name.startswith("FROM_"):
            raise unsupported("a custom scale", "Read in one of the physical units and scale the result.")
        coupling = self._task.chassis.converter.coupling
        source = argument.choice(ExcitationSource, excitation[0], "current_excit_source")
        iepe = source is ExcitationSource.INTERNAL
        settings |= {
            "ai_term_cfg": argument.choice(TerminalConfiguration, settings["ai_term_cfg"], "terminal_config"),
            "ai_min": argument.number(settings["ai_min"], "min_val"),
            "ai_max": argument.number(settings["ai_max"], "max_val"),
            "chan_type": ChannelType.ANALOG_INPUT,
            "ai_meas_type": measures,
            # The usual vibration module feeds its sensors in AC coupling only.
            "ai_coupling": Coupling.AC if iepe or coupling == "AC" else Coupling.DC,
            "ai_excit_src": source,
            "ai_excit_val": argument.number(excitation[1], "current_excit_val"),
            "description": "",
        }
        return self._add(physical_channel, name, settings, _WRITABLE)


class AOChannelCollection(ChannelCollection):
    """Output channels of a task."""

    kind = "ao"

    def add_ao_voltage_chan(
        self,
        physical_channel: str,
        name_to_assign_to_channel: str = "",
        min_val: float = -10.0,
        max_val: float = 10.0,
        units: VoltageUnits = VoltageUnits.VOLTS,
        custom_scale_name: str = "",
    ) -> Channel:
        """Add the output to the shaker amplifier."""
        if custom_scale_name or argument.choice(VoltageUnits, units, "units") is not VoltageUnits.VOLTS:
            raise unsupported("a custom scale", "Write volts.")
        settings = {
            "chan_type": ChannelType.ANALOG_OUTPUT,
            "ao_output_type": UsageTypeAO.VOLTAGE,
            "ao_min": argument.number(min_val, "min_val"),
            "ao_max": argument.number(max_val, "max_val"),
            "units": VoltageUnits.VOLTS,
            "description": "",
        }
        return self._add(
            physical_channel,
            name_to_assign_to_channel,
            settings,
            frozenset({"ao_min", "ao_max", "description"}),
        )
