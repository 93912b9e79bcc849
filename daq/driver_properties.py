"""Which of the package nidaqmx's numbers means which property, and how values go through its seam."""

from __future__ import annotations

from enum import Enum
from pathlib import PurePath
from typing import Any

from nidaqmx.system import device, physical_channel, system
from nidaqmx.system._collections import device_collection, physical_channel_collection
from nidaqmx.task import _in_stream, _out_stream, _task, _timing
from nidaqmx.task.channels import _ai_channel, _ao_channel
from nidaqmx.task.triggering import _reference_trigger, _start_trigger, _triggers

from daq import errors
from daq.devices import Device, PhysicalChannel
from daq.terminals import flatten
from daq.virtual_channels import Channel


def _properties(*classes: type) -> dict[int, str]:
    """Read out of the package's classes which number stands for which property."""
    found = {}
    for each in classes:
        for owner in reversed(each.__mro__):
            for name, value in vars(owner).items():
                getter = value.fget if isinstance(value, property) else None
                code = getattr(getter, "__code__", None)
                for constant in code.co_consts if code is not None else ():
                    if isinstance(constant, int) and constant > 0xFF:
                        found[constant] = name
    return found


CHANNEL = _properties(_ai_channel.AIChannel, _ao_channel.AOChannel)
READ = _properties(_in_stream.InStream)
WRITE = _properties(_out_stream.OutStream)
TIMING = _properties(_timing.Timing)
START = _properties(_start_trigger.StartTrigger)
REFERENCE = _properties(_reference_trigger.ReferenceTrigger)
TRIGGERS = _properties(_triggers.Triggers)
TASK = _properties(_task.Task)
DEVICE = _properties(device.Device)
PHYSICAL = _properties(physical_channel.PhysicalChannel)
SYSTEM = _properties(system.System, device_collection.DeviceCollection)
AI_TERMINALS = _properties(physical_channel_collection.AIPhysicalChannelCollection)
AO_TERMINALS = _properties(physical_channel_collection.AOPhysicalChannelCollection)
# Asked for by the package's reads, but no property of any class.
DEFAULT_SAMPLES = 0x31E8


def _plain(value: Any) -> Any:
    """Turn a property's value into what goes through the seam."""
    if isinstance(value, Enum):
        return value.value
    if value is None:
        return ""
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, Channel | PhysicalChannel | Device):
        return value.name
    if isinstance(value, list | tuple) and value and not isinstance(value[0], float | int):
        return flatten([_plain(each) for each in value])
    return value


def get(target: Any, names: dict[int, str], number: int, what: str) -> Any:
    """Read a property by its number; `what` names its owner in errors."""
    name = names.get(number)
    if name is None:
        raise errors.unsupported(f"{what} property {number:#x}")
    return _plain(getattr(target, name))


def put(target: Any, names: dict[int, str], number: int, value: Any, what: str) -> None:
    """Set a property by its number; `what` names its owner in errors."""
    name = names.get(number)
    if name is None:
        raise errors.unsupported(f"setting {what} property {number:#x}")
    setattr(target, name, value)
