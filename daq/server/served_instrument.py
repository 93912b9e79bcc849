"""The instrument as clients of the server have it in common: chassis, tasks, stored settings, reservations, errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq.instrument.devices.names import Port
from daq.instrument.devices.teds import TedsMemory
from daq.instrument.driver_texts import DRIVER_TEXTS
from daq.instrument.errors import DaqError, bad, meaning
from daq.instrument.settings.storage import Storage
from daq.server.reservations import Reservations
from daq.server.sessions import Sessions

if TYPE_CHECKING:
    from daq.instrument.chassis import Chassis

# Message text travels in headers, which have little room: bytes.
_LONGEST_TEXT, _LONGEST_NAME = 3000, 200


@dataclass(frozen=True)
class Limits:
    """What clients may ask for.

    Parameters
    ----------
    message : int
        Bytes of a message.
    tasks : int
        Open tasks of one client.
    memory : int
        Bytes that the buffers of one client's tasks take in all.
    calls : int
        Calls of one client that are answered at the same time, event streams included.
    all_calls : int
        Calls of all clients that are answered at the same time; what is beyond is refused at once.
    patience : float
        Seconds after which the session of a client that has gone without goodbye is ended.
    """

    message: int = 256 << 20
    tasks: int = 64
    memory: int = 2 << 30
    calls: int = 256
    all_calls: int = 1024
    patience: float = 30.0


class ServedInstrument:
    """What the calls of all clients act on.

    Parameters
    ----------
    chassis : Chassis
        The instrument.
    limits : Limits
        What clients may ask for.
    """

    def __init__(self, chassis: Chassis, limits: Limits) -> None:
        self.chassis, self.limits = chassis, limits
        self.storage, self.teds = Storage(), TedsMemory(self._sensor_sheet)
        self.sessions = Sessions(chassis, self.storage, limits.tasks)
        self.reservations = Reservations()
        self._reported: dict[tuple[str, int], str] = {}

    def _sensor_sheet(self, port: Port) -> bytes | None:
        module = self.chassis.devices.module(port.device)
        row = module.row("ai", port.number)
        return self.chassis.terminals.data_sheet(row) if module.teds else None

    def check_size(self, size: int) -> None:
        """Make sure that an answer is not too large; with -200077."""
        if size > self.limits.message:
            raise bad(
                f"an answer of {size >> 20} MB: this server sends {self.limits.message >> 20} MB at a time; read "
                "less at once"
            )

    def remember(self, peer: str, error: DaqError, task: str) -> None:
        """Keep the text of an error that the protocol reports by its number alone."""
        if len(self._reported) > 1000:
            self._reported.clear()
        self._reported[peer, error.code] = error_text(error, task)

    def recall(self, peer: str, code: int) -> str:
        """Say what an error number means; what was last said of it to this client."""
        if (peer, code) in self._reported:
            return self._reported[peer, code]
        return meaning(code)


def cut(text: str, most: int = _LONGEST_TEXT) -> str:
    """Shorten a text to what fits into a header."""
    return text.encode(errors="replace")[:most].decode(errors="ignore")


def error_text(error: DaqError, task: str) -> str:
    """Write an error as the driver does."""
    named = f"Task Name: {cut(task, _LONGEST_NAME)}" if task else ""
    lines = [DRIVER_TEXTS.get(error.code, ""), cut(str(error)), named, f"Status Code: {error.code}"]
    return "\n\n".join(line for line in lines if line)
