"""State of the instrument that all clients share: chassis, tasks, stored settings, reservations, error messages."""

from dataclasses import dataclass

from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.devices.names import Port
from daq.extras.ni_device.devices.teds import TedsMemory
from daq.extras.ni_device.errors import DRIVER_TEXTS, DaqError, driver_text, invalid_value
from daq.extras.ni_device.settings.storage import Storage
from daq.extras.ni_server.sessions import Reservations, Sessions

# Maximum length of an error message, which is sent in a header of limited size.
_MAX_MESSAGE_BYTES = 3000
# Maximum number of bytes of the name of a task in an error message; most of the message remains for the cause.
_MAX_NAME_BYTES = 200
# All stored error messages are removed at this number, because some clients never request their messages.
_MAX_STORED_MESSAGES = 1000


@dataclass(frozen=True)
class Limits:
    """Limits of the resources of clients."""

    max_request_bytes: int = 32 << 20  # size of a request [bytes]: 4 million samples of outputs
    max_message_bytes: int = 256 << 20  # size of a response [bytes]
    max_tasks_per_client: int = 64  # number of open tasks
    max_buffer_bytes: int = 2 << 30  # total size of the buffers of a client's tasks [bytes]
    max_calls_per_client: int = 256  # number of simultaneous calls, including event streams
    max_calls: int = 1024  # number of simultaneous calls of all clients; further calls are rejected
    disconnect_timeout: float = 30.0  # time after which the sessions of a disconnected client are ended [s]


class ServedInstrument:
    """The instrument and the state that all clients share."""

    def __init__(self, chassis: Chassis, limits: Limits) -> None:
        self.chassis, self.limits = chassis, limits
        self.storage, self.teds = Storage(), TedsMemory(self._teds_of_sensor)
        self.sessions = Sessions(chassis, self.storage, limits.max_tasks_per_client)
        self.reservations = Reservations()
        self._latest_messages: dict[tuple[str, int], str] = {}  # latest message of each client (peer) and error code

    def _teds_of_sensor(self, port: Port) -> bytes | None:
        module = self.chassis.devices.module(port.device)
        bench_index = module.bench_index("ai", port.number)
        return self.chassis.terminals.teds(bench_index) if module.teds else None

    def check_size(self, size: int) -> None:
        """Raise `DaqError` -200077 if a response of that size, bytes, is too large."""
        max_size = self.limits.max_message_bytes
        if size > max_size:
            raise invalid_value(
                f"a response of {size >> 20} MB exceeds the maximum of this server, {max_size >> 20} MB. "
                "Read fewer samples at a time."
            )

    def store_error(self, peer: str, error: DaqError, task: str) -> None:
        """Store the message of an error that the protocol reports only by its code."""
        if len(self._latest_messages) > _MAX_STORED_MESSAGES:
            self._latest_messages.clear()
        self._latest_messages[peer, error.code] = format_error(error, task)

    def latest_message(self, peer: str, code: int) -> str:
        """Return the message of the client's latest error with this code; without one, the text of NI's driver."""
        return self._latest_messages.get((peer, code)) or driver_text(code)


def truncate(text: str, max_bytes: int = _MAX_MESSAGE_BYTES) -> str:
    """Return the beginning of a text, at most `max_bytes` of UTF-8."""
    return text.encode(errors="replace")[:max_bytes].decode(errors="ignore")


def format_error(error: DaqError, task: str) -> str:
    """Return the message of an error in the format of NI's driver."""
    task_line = f"Task Name: {truncate(task, _MAX_NAME_BYTES)}" if task else ""
    paragraphs = [DRIVER_TEXTS.get(error.code, ""), truncate(str(error)), task_line, f"Status Code: {error.code}"]
    return "\n\n".join(paragraph for paragraph in paragraphs if paragraph)
