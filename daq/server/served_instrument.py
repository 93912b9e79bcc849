"""The instrument as all clients share it: chassis, tasks, stored settings, reservations, and texts of errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq.instrument.devices.names import Port
from daq.instrument.devices.teds import TedsMemory
from daq.instrument.errors import DRIVER_TEXTS, DaqError, invalid_value, meaning
from daq.instrument.settings.storage import Storage
from daq.server.sessions import Reservations, Sessions

if TYPE_CHECKING:
    from daq.instrument.chassis import Chassis

# Maximum length of an error text, which is sent in a header of limited size.
_MAX_TEXT_BYTES = 3000
# Maximum length of the name of a task in an error text.
_MAX_NAME_BYTES = 200


@dataclass(frozen=True)
class Limits:
    """Limits of the resources of clients."""

    message: int = 256 << 20  # maximum size of a message, bytes
    tasks: int = 64  # maximum number of open tasks per client
    memory: int = 2 << 30  # maximum total size of the buffers of a client's tasks, bytes
    calls: int = 256  # maximum number of simultaneous calls per client, including event streams
    all_calls: int = 1024  # maximum number of simultaneous calls of all clients; further calls are rejected
    patience: float = 30.0  # time after which the sessions of a disconnected client are ended, s


class ServedInstrument:
    """The instrument and the state that all clients share."""

    def __init__(self, chassis: Chassis, limits: Limits) -> None:
        self.chassis, self.limits = chassis, limits
        self.storage, self.teds = Storage(), TedsMemory(self._sensor_sheet)
        self.sessions = Sessions(chassis, self.storage, limits.tasks)
        self.reservations = Reservations()
        self._reported: dict[tuple[str, int], str] = {}  # latest text by client and code

    def _sensor_sheet(self, port: Port) -> bytes | None:
        module = self.chassis.devices.module(port.device)
        row = module.row("ai", port.number)
        return self.chassis.terminals.data_sheet(row) if module.teds else None

    def check_size(self, size: int) -> None:
        """Raise `DaqError` -200077 if a response of that size, bytes, is too large."""
        if size > self.limits.message:
            raise invalid_value(
                f"a response of {size >> 20} MB exceeds the maximum of this server, {self.limits.message >> 20} MB. "
                "Read fewer samples at a time."
            )

    def store_error(self, peer: str, error: DaqError, task: str) -> None:
        """Store the text of an error that the protocol reports only by its number."""
        if len(self._reported) > 1000:
            self._reported.clear()
        self._reported[peer, error.code] = error_text(error, task)

    def text_of_error(self, peer: str, code: int) -> str:
        """Return the text of the client's latest error with this code, or the general meaning of the code."""
        if (peer, code) in self._reported:
            return self._reported[peer, code]
        return meaning(code)


def truncated(text: str, max_bytes: int = _MAX_TEXT_BYTES) -> str:
    """Return the beginning of a text, at most `max_bytes` of UTF-8."""
    return text.encode(errors="replace")[:max_bytes].decode(errors="ignore")


def error_text(error: DaqError, task: str) -> str:
    """Return the text of an error in the format of NI's driver."""
    task_line = f"Task Name: {truncated(task, _MAX_NAME_BYTES)}" if task else ""
    paragraphs = [DRIVER_TEXTS.get(error.code, ""), truncated(str(error)), task_line, f"Status Code: {error.code}"]
    return "\n\n".join(paragraph for paragraph in paragraphs if paragraph)
