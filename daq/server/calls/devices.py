"""Calls about devices and the data sheets of sensors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from daq.instrument.devices.names import parse_port
from daq.instrument.errors import Code, DaqError
from daq.server.calls.call import Answer, Call
from rig.input_files import read_file


def _on_device(call: Call) -> Answer:
    call.instrument.chassis.devices.module(call.fields["device_name"])
    return {}


def _reset_device(call: Call) -> Answer:
    module = call.instrument.chassis.devices.module(call.fields["device_name"])
    call.instrument.sessions.end_on(module.name, call.peer)
    return {}


def _teds(action: str) -> Callable[[Call], Answer]:
    def act(call: Call) -> Answer:
        teds, port = call.instrument.teds, parse_port(call.fields["physical_channel"])
        call.instrument.chassis.devices.module(port.device).row(port.kind, port.number)
        if action == "configure":
            teds.configure(port, call.fields["file_path"])
        elif action == "clear":
            teds.clear(port)
        elif action == "write_file":
            path = call.fields["file_path"]
            teds.write(port, b"" if not path else _file(path))
        else:
            teds.write(port, call.fields["bit_stream"])
        return {}

    return act


def _file(path: str) -> bytes:
    try:
        return read_file(Path(path))
    except OSError as error:
        raise DaqError(f"{path}: {error.strerror}", Code.VIRTUAL_TEDS_FILE_NOT_FOUND) from None


CALLS: dict[str, Callable[[Call], Answer]] = {
    "SelfTestDevice": _on_device,
    "SelfCal": _on_device,
    "RestoreLastExtCalConst": _on_device,
    "ResetDevice": _reset_device,
    "UnreserveNetworkDevice": _on_device,
    "ReserveNetworkDevice": _on_device,
    "DeviceSupportsCal": lambda call: _on_device(call) | {"cal_supported": False},
    "ConfigureTEDS": _teds("configure"),
    "ClearTEDS": _teds("clear"),
    "WriteToTEDSFromArray": _teds("write"),
    "WriteToTEDSFromFile": _teds("write_file"),
}
