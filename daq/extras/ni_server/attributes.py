"""Handlers of the calls that read, set and reset an attribute of a task, a channel, a device or a scale.

An attribute is a property in NI's protocol. Its owner is the object that it describes, such as a task or a device.
"""

import re
from collections.abc import Callable
from typing import Any

from daq.extras.ni_device.devices.measurements import SUPPORTED_TYPES, VOLTAGE
from daq.extras.ni_device.devices.modules import TERMINAL_CONFIGURATION_BITS
from daq.extras.ni_device.devices.names import parse_port
from daq.extras.ni_device.errors import Code, DaqError, unsupported
from daq.extras.ni_device.settings.storage import Storage
from daq.extras.ni_device.task import Task
from daq.extras.ni_device.task_properties import (
    get_channel_property,
    get_value,
    reset_channel_property,
    reset_value,
    set_channel_property,
    set_value,
)
from daq.extras.ni_server.calls.call import Call, Handler, ResponseFields
from daq.extras.ni_server.protocol import attribute_name, decode

# Parts of a call's name, as in GetTimingAttributeExDouble: action, owner, "Ex" if it names a device, type of the value.
_CALL = re.compile(r"(Get|Set|Reset)([A-Za-z]+?)Attribute(Ex)?(\w*?)")
# Groups of a task's settings, by their names in the calls.
_GROUPS = {
    "Timing": "timing",
    "Trig": "trig",
    "Read": "read",
    "Write": "write",
    "Buffer": "buffer",
    "ExportedSignal": "exported_signal",
}
# Version of the emulated driver: major, minor, update.
DRIVER_VERSION = (26, 0, 0)


def attribute_handler(name: str) -> Handler | None:
    """Return the handler of a call that reads, sets or resets an attribute; None for other calls."""
    match = _CALL.fullmatch(name)
    if not match:
        return None
    action, owner, names_device, value_type = match[1], match[2], bool(match[3]), match[4]

    def handle(call: Call) -> ResponseFields | None:
        attribute = attribute_name(call.message)
        if attribute is None:
            raise unsupported(f"attribute {decode(call.message).get('attribute', 0)}")
        if names_device:
            raise DaqError(
                f"{attribute} applies to the whole task. Omit the device name.",
                Code.M_STUDIO_OPERATION_DOES_NOT_SUPPORT_DEVICE_CONTEXT,
            )
        if action == "Get":
            return {"value": _to_call_type(_get(call, owner, attribute), value_type)}
        is_set = action == "Set"
        if owner in _GROUPS:
            change: Callable[..., None] = set_value if is_set else reset_value
            group_or_channels = _GROUPS[owner]
        elif owner == "Chan":
            change, group_or_channels = (
                (set_channel_property if is_set else reset_channel_property),
                call.fields["channel"],
            )
        elif owner == "Scale" and is_set:
            storage, scale = call.instrument.storage, call.fields["scale_name"]
            storage.scales[scale] = storage.scale(scale).changed(attribute, call.fields["value"])
            return None
        else:
            raise unsupported(f"{'setting' if is_set else 'resetting'} {attribute}")
        change(call.task, group_or_channels, attribute, *([call.fields["value"]] if is_set else []))
        return None

    return handle


def _to_call_type(value: Any, value_type: str) -> Any:
    """Convert a value to the type at the end of a call's name, such as "Int32"."""
    if value_type == "String":
        return ", ".join(value) if isinstance(value, list) else str(value)
    if value_type in ("Int32", "UInt32", "UInt64"):
        return int(value)
    if value_type == "Bool":
        return bool(value)
    return [int(number) for number in value] if value_type == "Int32Array" else value


def _get(call: Call, owner: str, name: str) -> Any:
    """Return the value of an attribute of an owner."""
    if owner in _GROUPS:
        return get_value(call.task, _GROUPS[owner], name)
    if owner == "Chan":
        return get_channel_property(call.task, call.fields["channel"], name)
    if owner not in _OWNERS:
        raise unsupported(f"property {name} of {owner}")
    return _OWNERS[owner](call, name)


def _of_device(call: Call, name: str) -> Any:
    chassis = call.instrument.chassis
    module = chassis.devices.module(call.fields["device_name"])
    attributes = module.attributes(chassis.devices.modules_of(module.name))
    if name not in attributes:
        raise DaqError(f"{module.product_type} has no property {name}. Do not query it.", Code.ATTR_NOT_SUPPORTED)
    return attributes[name]


def _of_physical_channel(call: Call, name: str) -> Any:
    name = name.removeprefix("physical_chan_")
    port = parse_port(call.fields["physical_channel"])
    chassis = call.instrument.chassis
    module = chassis.devices.module(port.device)
    module.bench_index(port.direction, port.number)  # The lookup raises an error if the channel does not exist.
    attributes: dict[str, Any] = {
        "ai_supported_meas_types": SUPPORTED_TYPES,
        "ai_term_cfgs": sum(
            TERMINAL_CONFIGURATION_BITS.get(value, 0) for value in module.terminal_configurations_at(port.number)
        ),
        "ai_input_srcs": [port.name],
    }
    if port.direction == "ao":
        attributes = {"ao_supported_output_types": [VOLTAGE], "ao_term_cfgs": 1}
    elif name.startswith("teds_"):
        return call.instrument.teds.read(port, name)
    if name not in attributes:
        raise DaqError(f"{port.name} has no property {name}. Do not query it.", Code.ATTR_NOT_SUPPORTED)
    return attributes[name]


def _of_task(call: Call, name: str) -> Any:
    task: Task = call.task
    attributes = {
        "name": lambda: task.name,
        "channels": lambda: [channel.name for channel in task.settings.channels],
        "devices": lambda: task.settings.device_names,
        "num_chans": lambda: len(task.settings.channels),
        "num_devices": lambda: len(task.settings.device_names),
        "complete": task.is_done,
    }
    if name not in attributes:
        raise unsupported(f"task property {name}")
    return attributes[name]()


def _of_system(call: Call, name: str) -> Any:
    storage: Storage = call.instrument.storage
    attributes = {
        "dev_names": call.instrument.chassis.devices.names,
        "tasks": list(storage.tasks),
        "scales": list(storage.scales),
        "global_chans": list(storage.channels),
        "nidaq_major_version": DRIVER_VERSION[0],
        "nidaq_minor_version": DRIVER_VERSION[1],
        "nidaq_update_version": DRIVER_VERSION[2],
    }
    if name not in attributes:
        raise unsupported(f"system property {name}")
    return attributes[name]


def _of_scale(call: Call, name: str) -> Any:
    scale = call.instrument.storage.scale(call.fields["scale_name"])
    if name not in scale.settings:
        raise DaqError(
            f"a scale of this type has no {name}. Do not query it.", Code.PROPERTY_NOT_SUPPORTED_FOR_SCALE_TYPE
        )
    return scale.settings[name]


def _of_persisted(call: Call, name: str) -> Any:
    """Return the author of a saved task, channel or scale; True for all other attributes, which are permissions."""
    storage: Storage = call.instrument.storage
    groups: tuple[tuple[str, dict[str, Any], Code], ...] = (
        ("task_name", storage.tasks, Code.TASK_NOT_IN_DATA_NEIGHBORHOOD),
        ("channel", storage.channels, Code.INVALID_GLOBAL_CHAN),
        ("scale_name", storage.scales, Code.CUSTOM_SCALE_DOES_NOT_EXIST),
    )
    field, saved, code = next(group for group in groups if group[0] in call.fields)
    key = call.fields[field]
    if key not in saved:
        raise DaqError(f"nothing is saved under the name {key!r}. Save it first.", code)
    return storage.authors.get(key, "") if name == "author" else True


# Calibration data of NI's simulated devices, which are never calibrated: temperatures in °C, an interval in months.
_CALIBRATION = {
    "cal_dev_temp": 0.0,
    "ext_cal_last_temp": 0.0,
    "self_cal_last_temp": 0.0,
    "ext_cal_recommended_interval": 24,
}


def _of_calibration(call: Call, name: str) -> Any:
    call.instrument.chassis.devices.module(call.fields["device_name"])
    return _CALIBRATION[name] if name in _CALIBRATION else _reject(call, name)


def _reject(call: Call, name: str) -> Any:
    """Reject an attribute that no device on the bench has."""
    raise DaqError(f"no device on the bench has the property {name}. Do not query it.", Code.ATTR_NOT_SUPPORTED)


# For each kind of object (owner) in the names of calls: the function that returns an attribute of such an object.
_OWNERS: dict[str, Callable[[Any, str], Any]] = {
    "Device": _of_device,
    "PhysicalChan": _of_physical_channel,
    "Task": _of_task,
    "SystemInfo": _of_system,
    "Scale": _of_scale,
    "PersistedTask": _of_persisted,
    "PersistedChan": _of_persisted,
    "PersistedScale": _of_persisted,
    "CalInfo": _of_calibration,
    "RealTime": _reject,
    "Watchdog": _reject,
}
