"""Channels of a task: what a script declares about the terminals it uses."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Any

from daq.face import argument
from daq.face.constants import (
    AccelSensitivityUnits,
    AccelUnits,
    ForceIEPESensorSensitivityUnits,
    ForceUnits,
    UsageTypeAI,
    VelocityIEPESensorSensitivityUnits,
    VelocityUnits,
    VoltageUnits,
)
from daq.instrument.errors import DaqError, DAQmxErrors, unsupported
from daq.instrument.terminals import flatten

if TYPE_CHECKING:
    from daq.face.task import Task
    from daq.instrument.chassis import Chassis

# Full scale of the output, V.
OUTPUT_RANGE = 10.0

_G, _POUND, _INCH = 9.80665, 4.4482216152605, 0.0254

# Size of the units scripts read in, and of the units in which sensitivities are stated, in SI.
_UNIT = {
    VoltageUnits.VOLTS: (1.0, "V"),
    AccelUnits.G: (_G, "g"),
    AccelUnits.METERS_PER_SECOND_SQUARED: (1.0, "m/s^2"),
    AccelUnits.INCHES_PER_SECOND_SQUARED: (_INCH, "in/s^2"),
    ForceUnits.NEWTONS: (1.0, "N"),
    ForceUnits.POUNDS: (_POUND, "lb"),
    ForceUnits.KILOGRAM_FORCE: (_G, "kgf"),
    VelocityUnits.METERS_PER_SECOND: (1.0, "m/s"),
    VelocityUnits.INCHES_PER_SECOND: (_INCH, "in/s"),
}
_VOLTS_PER_SI = {
    AccelSensitivityUnits.MILLIVOLTS_PER_G: 1e-3 / _G,
    AccelSensitivityUnits.VOLTS_PER_G: 1.0 / _G,
    ForceIEPESensorSensitivityUnits.MILLIVOLTS_PER_NEWTON: 1e-3,
    ForceIEPESensorSensitivityUnits.MILLIVOLTS_PER_POUND: 1e-3 / _POUND,
    VelocityIEPESensorSensitivityUnits.MILLIVOLTS_PER_MILLIMETER_PER_SECOND: 1.0,
    VelocityIEPESensorSensitivityUnits.MILLIVOLTS_PER_INCH_PER_SECOND: 1e-3 / _INCH,
}


@dataclass
class Terminal:
    """One channel of a task.

    Settings carry the names of the driver's properties. What describes the wiring (coupling, excitation,
    terminal configuration) is kept and read back, but what is wired on the bench is what the scene says.

    Attributes
    ----------
    name : str
        Virtual name.
    physical : str
        Name of the terminal, as the script gave it.
    number : int
        Number of the input or output.
    settings : dict
        Properties.
    writable : frozenset of str
        Those a script may set.
    """

    name: str
    physical: str
    number: int
    settings: dict[str, Any] = field(default_factory=dict)
    writable: frozenset[str] = frozenset()

    @property
    def device(self) -> str:
        """Name of its device, as the script calls it."""
        return self.physical.partition("/")[0]

    def is_on(self, other: Terminal) -> bool:
        """Whether another channel has the same terminal; the output is one, whatever device it is named after."""
        shared = self.device.lower() == other.device.lower() or "ai_meas_type" not in self.settings
        return shared and self.number == other.number

    @property
    def unit(self) -> str:
        """Unit of the readings."""
        return _UNIT[self.settings["units"]][1]

    @property
    def volts_per_unit(self) -> float:
        """Volts per unit of the readings."""
        if "sensitivity" not in self.settings:
            return 1.0
        per_si = self.settings["sensitivity"] * _VOLTS_PER_SI[self.settings["sensitivity_units"]]
        return float(per_si * _UNIT[self.settings["units"]][0])

    @property
    def per_volt(self) -> float:
        """Readings per volt."""
        return 1.0 / self.volts_per_unit


class Channel:
    """One or several channels of a task, for reading and setting their properties.

    The properties have the names of the driver's: `ai_max`, `ai_accel_sensitivity`, ...
    """

    def __init__(self, task: Task, terminals: Sequence[Terminal]) -> None:
        object.__setattr__(self, "_task", task)
        object.__setattr__(self, "terminals", list(terminals))

    @property
    def name(self) -> str:
        """Names of the channels, joined."""
        return flatten(self.channel_names)

    @property
    def channel_names(self) -> list[str]:
        """Names of the channels."""
        return [each.name for each in self.terminals]

    @property
    def device_names(self) -> list[str]:
        """Names of the devices in use, as the script calls them."""
        return list(dict.fromkeys(each.device for each in self.terminals))

    def __len__(self) -> int:
        return len(self.terminals)

    def __iter__(self) -> Iterator[Channel]:
        return (Channel(self._task, [each]) for each in self.terminals)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Channel)
            and self._task is other._task
            and set(self.channel_names) == set(other.channel_names)
        )

    def __hash__(self) -> int:
        return hash((id(self._task), frozenset(self.channel_names)))

    def __repr__(self) -> str:
        return f"{type(self).__name__}(name={self.name})"

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name == "physical_channel":
            from daq.face.devices import PhysicalChannel

            return PhysicalChannel(flatten([each.physical for each in self.terminals]), self._task.chassis)
        if not self.terminals:
            raise DaqError(
                f"{name}: the task has no channels",
                DAQmxErrors.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK,
                self._task.name,
            )
        values = [read(self._task, each, name) for each in self.terminals]
        if any(value != values[0] for value in values):
            raise DaqError(
                f"{name} differs among {', '.join(self.channel_names)}: ask one channel at a time",
                DAQmxErrors.INVALID_ATTRIBUTE_VALUE,
                self._task.name,
            )
        return values[0]

    def __setattr__(self, name: str, value: Any) -> None:
        self._task.check_idle(name)
        for each in self.terminals:
            write(self._task, each, name, value)


# The driver's property names, by kind of measurement, for what `Terminal.settings` holds.
_SENSOR = {
    UsageTypeAI.ACCELERATION_ACCELEROMETER_CURRENT_INPUT: "ai_accel",
    UsageTypeAI.FORCE_IEPE_SENSOR: "ai_force_iepe_sensor",
    UsageTypeAI.VELOCITY_IEPE_SENSOR: "ai_velocity_iepe_sensor",
}
_UNITS = {
    UsageTypeAI.VOLTAGE: "ai_voltage_units",
    UsageTypeAI.ACCELERATION_ACCELEROMETER_CURRENT_INPUT: "ai_accel_units",
    UsageTypeAI.FORCE_IEPE_SENSOR: "ai_force_units",
    UsageTypeAI.VELOCITY_IEPE_SENSOR: "ai_velocity_units",
}


def _key(terminal: Terminal, name: str) -> str:
    """Translate the driver's name of a property into that of a setting."""
    kind = terminal.settings.get("ai_meas_type")
    if kind is not None:
        if name == _UNITS[kind]:
            return "units"
        if kind in _SENSOR and name in (f"{_SENSOR[kind]}_sensitivity", f"{_SENSOR[kind]}_sensitivity_units"):
            return name.removeprefix(f"{_SENSOR[kind]}_")
    return "units" if name == "ao_voltage_units" else name


def read(task: Task, terminal: Terminal, name: str) -> Any:
    """Read a property of a channel.

    Raises
    ------
    DaqError
        With -200452, if channels of this kind have no such property.
    """
    computed = _COMPUTED.get(name)
    if computed is not None and ("ai_meas_type" in terminal.settings) == name.startswith("ai_"):
        return computed(task.chassis, terminal)
    key = _key(terminal, name)
    if key in terminal.settings:
        return terminal.settings[key]
    raise unsupported(f"property {name} of channel {terminal.name}")


def write(task: Task, terminal: Terminal, name: str, value: Any) -> None:
    """Set a property of a channel.

    Raises
    ------
    DaqError
        With -200452, if it cannot be set; with -200077 for a value that is out of range.
    """
    key = _key(terminal, name)
    if key not in terminal.settings or key not in terminal.writable:
        raise unsupported(f"setting property {name} of channel {terminal.name}")
    old = terminal.settings[key]
    if isinstance(old, Enum):
        value = argument.choice(type(old), value, name)
    elif isinstance(old, float):
        value = argument.number(value, name)
    changed = replace(terminal, settings=terminal.settings | {key: value})
    check(task.chassis, changed)
    terminal.settings = changed.settings


def _full_scale(chassis: Chassis, terminal: Terminal) -> float:
    """Largest reading the converter's range allows."""
    return chassis.input_range * terminal.per_volt


def _coerced_limit(chassis: Chassis, terminal: Terminal, sign: float) -> float:
    scale = _full_scale(chassis, terminal)
    return (
        sign * scale if scale < float("inf") else float(terminal.settings["ai_max" if sign > 0 else "ai_min"])
    )


def _delay(chassis: Chassis, terminal: Terminal) -> float:
    info = chassis.inputs[terminal.number]
    return info.delay + (0.5 / info.rate if info.average else 0.0)


_COMPUTED: dict[str, Any] = {
    # The module has one range, so that limits within it are coerced to it.
    "ai_max": lambda chassis, terminal: _coerced_limit(chassis, terminal, 1.0),
    "ai_min": lambda chassis, terminal: _coerced_limit(chassis, terminal, -1.0),
    "ai_rng_high": lambda chassis, terminal: chassis.input_range,
    "ai_rng_low": lambda chassis, terminal: -chassis.input_range,
    "ai_filter_delay": _delay,
    "ai_remove_filter_delay": lambda chassis, terminal: chassis.converter.remove_delay,
    "ai_raw_samp_size": lambda chassis, terminal: 32,
    "ai_resolution": lambda chassis, terminal: float(chassis.converter.bits or 64),
}


def check(chassis: Chassis, terminal: Terminal) -> None:
    """Check a channel's sensitivity, and its limits against what its module can do.

    Raises
    ------
    DaqError
        With -200077.
    """
    settings = terminal.settings
    output = "ai_meas_type" not in settings
    kind = "ao" if output else "ai"
    low, high = settings[f"{kind}_min"], settings[f"{kind}_max"]
    if not sys.float_info.min <= terminal.volts_per_unit < math.inf:
        raise _bad(terminal, f"sensitivity {settings['sensitivity']:g}: must be positive, and finite")
    scale = OUTPUT_RANGE if output else _full_scale(chassis, terminal)
    if not low < high:
        raise _bad(terminal, f"limits {low:g} to {high:g}: the lower one must be below the upper one")
    if max(abs(low), abs(high)) > scale * (1 + 1e-9):
        unit = terminal.unit
        raise _bad(
            terminal,
            f"limits {low:g} to {high:g} {unit} go beyond what the module can do, {-scale:g} to {scale:g} "
            f"{unit}"
            + (
                f" ({scale / terminal.per_volt:g} V over the sensitivity)"
                if "sensitivity" in settings
                else ""
            ),
        )


def _bad(terminal: Terminal, message: str) -> DaqError:
    return DaqError(f"channel {terminal.name}: {message}", DAQmxErrors.INVALID_ATTRIBUTE_VALUE)
