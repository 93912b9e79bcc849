"""Which of the package nidaqmx's numbers means which property, and how values go through its seam."""

from __future__ import annotations

from enum import Enum
from typing import Any

from nidaqmx.system import device, physical_channel, system
from nidaqmx.system._collections import (
    device_collection,
    persisted_channel_collection,
    persisted_scale_collection,
    persisted_task_collection,
    physical_channel_collection,
)
from nidaqmx.task import _in_stream, _out_stream, _task, _timing
from nidaqmx.task.channels import _ai_channel, _ao_channel
from nidaqmx.task.triggering import (
    _arm_start_trigger,
    _handshake_trigger,
    _pause_trigger,
    _reference_trigger,
    _start_trigger,
    _triggers,
)

from daq.face.devices import Device, PhysicalChannel, System
from daq.face.in_stream import InStream
from daq.face.out_stream import OutStream
from daq.face.task import Task
from daq.face.timing import Timing
from daq.face.virtual_channels import Channel
from daq.instrument import errors
from daq.instrument.terminals import flatten


def _properties(*classes: type) -> dict[int, str]:
    """Read out of the package's classes which number stands for which property.

    The number is the one constant of a property that asks the interpreter for an attribute; properties that do
    not (old names of others, say) have constants that mean something else.
    """
    found: dict[int, str] = {}
    for each in classes:
        for owner in reversed(each.__mro__):
            for name, value in vars(owner).items():
                getter = value.fget if isinstance(value, property) else None
                code = getattr(getter, "__code__", None)
                if code is not None and any("_attribute_" in called for called in code.co_names):
                    found |= {constant: name for constant in code.co_consts if isinstance(constant, int)}
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
SAVED = _properties(
    persisted_task_collection.PersistedTaskCollection,
    persisted_channel_collection.PersistedChannelCollection,
    persisted_scale_collection.PersistedScaleCollection,
)
AI_TERMINALS = _properties(physical_channel_collection.AIPhysicalChannelCollection)
AO_TERMINALS = _properties(physical_channel_collection.AOPhysicalChannelCollection)
# Counters and digital lines: there are none.
OTHER_TERMINALS = _properties(
    physical_channel_collection.CIPhysicalChannelCollection,
    physical_channel_collection.COPhysicalChannelCollection,
    physical_channel_collection.DILinesCollection,
    physical_channel_collection.DOLinesCollection,
    physical_channel_collection.DIPortsCollection,
    physical_channel_collection.DOPortsCollection,
)
# Of triggers that the instrument does not have, for errors to name.
ABSENT = _properties(
    _arm_start_trigger.ArmStartTrigger, _handshake_trigger.HandshakeTrigger, _pause_trigger.PauseTrigger
)
# Asked for by the package's reads, but no property of any class.
DEFAULT_SAMPLES = 0x31E8


def as_text(value: Any) -> str:
    """Turn what a property holds into the string that goes through the seam; lists of names are joined."""
    if isinstance(value, list | tuple):
        return flatten([as_text(each) for each in value])
    if isinstance(value, Channel | PhysicalChannel | Device):
        return value.name
    return "" if value is None else str(value)


def as_number(value: Any) -> Any:
    """Turn what a property holds into the number, or list of numbers, that goes through the seam."""
    return value.value if isinstance(value, Enum) else value


def _named(names: dict[int, str], number: int, what: str) -> str:
    if number not in names:
        raise errors.unsupported(f"{what} property {ABSENT.get(number, hex(number))}")
    return names[number]


def get(target: Any, names: dict[int, str], number: int, what: str) -> Any:
    """Read a property by its number; `what` names its owner in errors."""
    return getattr(target, _named(names, number, what))


def put(target: Any, names: dict[int, str], number: int, value: Any, what: str) -> None:
    """Set a property by its number; `what` names its owner in errors."""
    setattr(target, _named(names, number, what), value)


def reset(target: Any, names: dict[int, str], number: int, untouched: Any, what: str) -> None:
    """Give a property by its number the value it has in an object that nobody has set anything of."""
    put(target, names, number, get(untouched, names, number, what), what)


def _channels(task: Task, names: str) -> Channel:
    collection = task.ao_channels if task.kind == "ao" else task.ai_channels
    return collection[names] if names else collection.all


# The calls of the seam, in which `_` is the interpreter. It has one call for each type of value; the types make no
# difference here, so they are left out of the names (get_timing_attribute_double is get_timing_attribute). What
# these calls return is then turned into a string or a number, see `as_text` and `as_number`.


def _get_task_attribute(_: Any, task: Task, number: int) -> Any:
    return get(task, TASK, number, "Task")


def _get_chan_attribute(_: Any, task: Task, channel: str, number: int) -> Any:
    return get(_channels(task, channel), CHANNEL, number, "channel")


def _set_chan_attribute(_: Any, task: Task, channel: str, number: int, value: Any) -> None:
    put(_channels(task, channel), CHANNEL, number, value, "channel")


def _get_read_attribute(_: Any, task: Task, number: int, size_hint: int = 0) -> Any:
    if number == DEFAULT_SAMPLES:
        return task.in_stream.default_count()
    return get(task.in_stream, READ, number, "in_stream")


def _set_read_attribute(_: Any, task: Task, number: int, value: Any) -> None:
    put(task.in_stream, READ, number, value, "in_stream")


def _reset_read_attribute(_: Any, task: Task, number: int) -> None:
    reset(task.in_stream, READ, number, InStream(task), "in_stream")


def _get_write_attribute(_: Any, task: Task, number: int, size_hint: int = 0) -> Any:
    return get(task.out_stream, WRITE, number, "out_stream")


def _set_write_attribute(_: Any, task: Task, number: int, value: Any) -> None:
    put(task.out_stream, WRITE, number, value, "out_stream")


def _reset_write_attribute(_: Any, task: Task, number: int) -> None:
    reset(task.out_stream, WRITE, number, OutStream(task), "out_stream")


def _buffer(task: Task, number: int) -> tuple[Any, dict[int, str]]:
    return (task.in_stream, READ) if number in READ else (task.out_stream, WRITE)


def _get_buffer_attribute(_: Any, task: Task, number: int) -> Any:
    return get(*_buffer(task, number), number, "buffer")


def _set_buffer_attribute(_: Any, task: Task, number: int, value: Any) -> None:
    target, names = _buffer(task, number)
    put(target, names, number, value, "buffer")


def _get_timing_attribute(_: Any, task: Task, number: int) -> Any:
    return get(task.timing, TIMING, number, "timing")


def _set_timing_attribute(_: Any, task: Task, number: int, value: Any) -> None:
    put(task.timing, TIMING, number, value, "timing")


def _reset_timing_attribute(_: Any, task: Task, number: int) -> None:
    reset(task.timing, TIMING, number, Timing(task), "timing")


def _get_timing_attribute_ex(_: Any, task: Task, device_names: str, number: int) -> Any:
    return _get_timing_attribute(_, task, number)


def _set_timing_attribute_ex(_: Any, task: Task, device_names: str, number: int, value: Any) -> None:
    _set_timing_attribute(_, task, number, value)


def _trigger(task: Task, number: int) -> tuple[Any, dict[int, str]]:
    for target, names in (
        (task.triggers.start_trigger, START),
        (task.triggers.reference_trigger, REFERENCE),
    ):
        if number in names:
            return target, names
    return task.triggers, TRIGGERS


def _get_trig_attribute(_: Any, task: Task, number: int) -> Any:
    return get(*_trigger(task, number), number, "trigger")


def _set_trig_attribute(_: Any, task: Task, number: int, value: Any) -> None:
    target, names = _trigger(task, number)
    put(target, names, number, value, "trigger")


def _get_system_info_attribute(_: Any, number: int) -> Any:
    if number in SAVED:
        return ""
    name = SYSTEM.get(number, "")
    version = {"_major_version": 0, "_minor_version": 1, "_update_version": 2}
    if name in version:
        return System.local().driver_version[version[name]]
    if name != "device_names":
        raise errors.unsupported(f"system property {name or hex(number)}")
    return System.local().devices.device_names


def _get_device_attribute(_: Any, name: str, number: int) -> Any:
    found = Device(name)
    if number in AI_TERMINALS:
        return found.ai_physical_chans.channel_names
    if number in AO_TERMINALS:
        return found.ao_physical_chans.channel_names
    if number in OTHER_TERMINALS:
        return []
    return get(found, DEVICE, number, "Device")


def _get_physical_chan_attribute(_: Any, name: str, number: int) -> Any:
    return get(PhysicalChannel(name), PHYSICAL, number, "PhysicalChannel")


def _reset_device(_: Any, name: str) -> None:
    Device(name).reset_device()


def _self_test_device(_: Any, name: str) -> None:
    Device(name).self_test_device()


CALLS = {
    call.__name__[1:]: call
    for call in (
        _get_task_attribute,
        _get_chan_attribute,
        _set_chan_attribute,
        _get_read_attribute,
        _set_read_attribute,
        _reset_read_attribute,
        _get_write_attribute,
        _set_write_attribute,
        _reset_write_attribute,
        _get_buffer_attribute,
        _set_buffer_attribute,
        _get_timing_attribute,
        _set_timing_attribute,
        _reset_timing_attribute,
        _get_timing_attribute_ex,
        _set_timing_attribute_ex,
        _get_trig_attribute,
        _set_trig_attribute,
        _get_system_info_attribute,
        _get_device_attribute,
        _get_physical_chan_attribute,
        _reset_device,
        _self_test_device,
    )
}
