"""Handlers of calls about tasks as a whole, devices, and the names that clients reserve."""

from collections.abc import Callable
from pathlib import Path

from daq.extras.ni_device.devices.names import parse_port
from daq.extras.ni_device.errors import Code, DaqError, invalid_value
from daq.extras.ni_device.task import Task
from daq.extras.ni_server.calls.call import Call, Handler, ResponseFields, task_action
from daq.extras.ni_server.protocol import DeviceProperties
from rig.core.base.input_files import read_file


def _create_task(call: Call) -> ResponseFields:
    name, behavior = call.fields["session_name"], call.fields.get("initialization_behavior", 0)
    session, is_new = call.instrument.sessions.open(name, behavior, call.peer, call.strict)
    return {"task": session, "new_session_initialized": is_new}


def _load_task(call: Call) -> ResponseFields:
    name = call.fields["session_name"]
    if name not in call.instrument.storage.tasks:
        raise DaqError(f"there is no saved task {name!r}. Save it first.", Code.TASK_NOT_IN_DATA_NEIGHBORHOOD)
    response = _create_task(call)
    if response["new_session_initialized"]:
        task = call.instrument.sessions.find(response["task"], call.peer)
        call.instrument.storage.load_task(task.settings, name)
    return response


def _nth_name(list_names: Callable[[Task], list[str]]) -> Handler:
    """Return the handler that returns an element of a list of names, by its index from 1."""

    def get_name(call: Call) -> ResponseFields:
        names, index = list_names(call.task), call.fields["index"]
        if not 1 <= index <= len(names):
            remedy = f"Give an index from 1 to {len(names)}." if names else "Add a channel first."
            raise invalid_value(f"index {index} is out of range: the task has {len(names)} names. {remedy}")
        return {"buffer": names[index - 1]}

    return get_name


def _check_device(call: Call) -> ResponseFields:
    """Raise `DaqError` -200220 if the device does not exist; a simulated device needs no other action."""
    call.instrument.chassis.devices.module(call.fields["device_name"])
    return {}


def _reset_device(call: Call) -> None:
    module = call.instrument.chassis.devices.module(call.fields["device_name"])
    call.instrument.sessions.abort_on_device(module.name, call.peer)


def _teds(action: str) -> Handler:
    """Return the handler of an action on a TEDS: "configure", "clear", "write" (from an array), "write_file"."""

    def handle(call: Call) -> None:
        teds, port = call.instrument.teds, parse_port(call.fields["physical_channel"])
        # The lookup raises an error if the channel does not exist.
        call.instrument.chassis.devices.module(port.device).bench_index(port.direction, port.number)
        path = call.fields.get("file_path", "")
        if action == "configure":
            teds.configure(port, path)
        elif action == "clear":
            teds.clear(port)
        elif action == "write_file":
            try:
                teds.write(port, read_file(Path(path)) if path else b"")
            except OSError as error:
                raise DaqError(
                    f"{path}: {error.strerror}. Give the path of a virtual TEDS file.", Code.VIRTUAL_TEDS_FILE_NOT_FOUND
                ) from None
        else:
            teds.write(port, call.fields["bit_stream"])

    return handle


def _enumerate_devices(call: Call) -> ResponseFields:
    devices = call.instrument.chassis.devices
    return {
        "devices": [
            DeviceProperties(
                name=module.name,
                model=module.product_type,
                vendor="National Instruments",
                serial_number=f"{module.attributes()['serial_num']:08X}",
                product_id=module.number,
            )
            for module in map(devices.module, devices.names)
        ]
    }


def _reservation(call: Call) -> tuple[str, str]:
    """Return the name that a call reserves, and the client."""
    name, client = call.fields["reservation_id"], call.fields["client_id"]
    if not (name and client):
        raise invalid_value("a reservation requires a reservation_id and a client_id. Give both.")
    return name, client


def _reset_server(call: Call) -> ResponseFields:
    call.instrument.sessions.close_all()
    call.instrument.reservations.clear()
    return {"is_server_reset": True}


CALLS: dict[str, Handler] = {
    "CreateTask": _create_task,
    "LoadTask": _load_task,
    "ClearTask": lambda call: call.instrument.sessions.close(call.fields["task"], call.peer),
    "StartTask": task_action(lambda task, fields: task.start()),
    "StopTask": task_action(lambda task, fields: task.stop()),
    "TaskControl": task_action(lambda task, fields: task.control(fields["action"])),
    "IsTaskDone": lambda call: {"is_task_done": call.task.is_done()},
    "WaitUntilTaskDone": task_action(lambda task, fields: task.wait_until_done(fields["time_to_wait"])),
    "GetNthTaskChannel": _nth_name(lambda task: [channel.name for channel in task.settings.channels]),
    "GetNthTaskDevice": _nth_name(lambda task: task.settings.device_names),
    "GetNthTaskReadChannel": _nth_name(
        lambda task: [task.settings.channels[index].name for index in task.settings.indices_to_read()]
    ),
    "GetErrorString": lambda call: {
        "error_string": call.instrument.latest_message(call.peer, call.fields["error_code"])
    },
    "UnregisterEveryNSamplesEvent": task_action(
        lambda task, fields: task.events.listen_every(fields["every_n_samples_event_type"], n_samples=0, listener=None)
    ),
    "UnregisterDoneEvent": task_action(lambda task, fields: task.events.listen_done(None)),
    "UnregisterSignalEvent": task_action(lambda task, fields: task.events.listen_signal(fields["signal_id"], None)),
    "SelfTestDevice": _check_device,
    "SelfCal": _check_device,
    "RestoreLastExtCalConst": _check_device,
    "ResetDevice": _reset_device,
    "UnreserveNetworkDevice": _check_device,
    "ReserveNetworkDevice": _check_device,
    "DeviceSupportsCal": lambda call: _check_device(call) | {"cal_supported": False},
    "ConfigureTEDS": _teds("configure"),
    "ClearTEDS": _teds("clear"),
    "WriteToTEDSFromArray": _teds("write"),
    "WriteToTEDSFromFile": _teds("write_file"),
    "EnumerateDevices": _enumerate_devices,
    "Reserve": lambda call: {
        "is_reserved": call.instrument.reservations.reserve(*_reservation(call), is_waiting=call.is_active)
    },
    "IsReservedByClient": lambda call: {
        "is_reserved": call.instrument.reservations.is_reserved_by(*_reservation(call))
    },
    "Unreserve": lambda call: {"is_unreserved": call.instrument.reservations.release(*_reservation(call))},
    "ResetServer": _reset_server,
}
