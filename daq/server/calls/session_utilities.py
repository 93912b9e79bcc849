"""Calls of the session service: the devices there are, reservations by name, a reset of the server."""

from __future__ import annotations

import threading
from collections.abc import Callable

from daq.instrument.errors import Code, DaqError, bad
from daq.server.calls.call import Answer, Call
from daq.server.protocol import DeviceProperties

# A client that waits for a reservation is looked after this often, s: it may have gone.
_LOOK = 0.1
_MOST = 10_000


class Reservations:
    """Names that clients reserve among themselves; the server gives them no meaning."""

    def __init__(self) -> None:
        self._holders: dict[str, str] = {}
        self._changed = threading.Condition()

    def reserve(self, name: str, client: str, waits: Callable[[], bool]) -> bool:
        """Reserve a name once no other client holds it; False if the client waits no more."""
        with self._changed:
            while self._holders.get(name, client) != client:
                if not waits():
                    return False
                self._changed.wait(_LOOK)
            if name not in self._holders and len(self._holders) >= _MOST:
                raise DaqError(
                    f"{_MOST} names are reserved: release some before reserving {name!r}",
                    Code.PAL_RESOURCE_RESERVED,
                )
            self._holders[name] = client
            return True

    def held(self, name: str, client: str) -> bool:
        """Whether a client holds a name."""
        return self._holders.get(name) == client

    def release(self, name: str, client: str) -> bool:
        """Release a name; False if the client does not hold it."""
        with self._changed:
            if not self.held(name, client):
                return False
            del self._holders[name]
            self._changed.notify_all()
            return True

    def clear(self) -> None:
        """Release all names."""
        with self._changed:
            self._holders.clear()
            self._changed.notify_all()


def _devices(call: Call) -> Answer:
    devices = call.server.chassis.devices
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
    call.server.sessions.close_all()
    call.server.reservations.clear()
    return {"is_server_reset": True}


CALLS: dict[str, Callable[[Call], Answer]] = {
    "EnumerateDevices": _devices,
    "Reserve": lambda call: {
        "is_reserved": call.server.reservations.reserve(*_names(call), waits=call.is_active)
    },
    "IsReservedByClient": lambda call: {"is_reserved": call.server.reservations.held(*_names(call))},
    "Unreserve": lambda call: {"is_unreserved": call.server.reservations.release(*_names(call))},
    "ResetServer": _reset,
}
