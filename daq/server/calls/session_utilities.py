"""Calls of the session service: list of devices, reservations by name, reset of the server."""

from __future__ import annotations

from collections.abc import Callable

from daq.instrument.errors import bad
from daq.server.calls.call import Answer, Call
from daq.server.protocol import DeviceProperties


def _devices(call: Call) -> Answer:
    devices = call.instrument.chassis.devices
    found = []
    for name in devices.names:
        module = devices.module(name)
        known = module.attributes([])
        found.append(
            DeviceProperties(
                name=name,
                model=module.product_type,
                vendor="National Instruments",
                serial_number=f"{known['serial_num']:08X}",
                product_id=module.number,
            )
        )
    return {"devices": found}


def _names(call: Call) -> tuple[str, str]:
    name, client = call.fields["reservation_id"], call.fields["client_id"]
    if not (name and client):
        raise bad("a reservation needs a reservation_id and a client_id: give both")
    return name, client


def _reset(call: Call) -> Answer:
    call.instrument.sessions.close_all()
    call.instrument.reservations.clear()
    return {"is_server_reset": True}


CALLS: dict[str, Callable[[Call], Answer]] = {
    "EnumerateDevices": _devices,
    "Reserve": lambda call: {
        "is_reserved": call.instrument.reservations.reserve(*_names(call), waits=call.is_active)
    },
    "IsReservedByClient": lambda call: {
        "is_reserved": call.instrument.reservations.is_reserved_by(*_names(call))
    },
    "Unreserve": lambda call: {"is_unreserved": call.instrument.reservations.release(*_names(call))},
    "ResetServer": _reset,
}
