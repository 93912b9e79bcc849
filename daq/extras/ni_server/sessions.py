"""Sessions of clients (tasks under names), the end of abandoned sessions, and names that clients reserve.

Several clients can use a session by its name; only the client that created it can end it. A peer is the address of a
client's connection.
"""

import itertools
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from urllib.parse import unquote

from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.errors import Code, DaqError, invalid_value
from daq.extras.ni_device.settings.storage import Storage
from daq.extras.ni_device.task import Task
from daq.extras.ni_device.values import TaskMode
from rig.core.base.errors import ShotrigError

# Values of NI's initialization behavior: only create a session, or only attach to an existing session.
INITIALIZE, ATTACH = 1, 2
# Interval at which the server checks whether a client that waits for a name is still connected.
_CHECK_INTERVAL_S = 0.1
# Maximum number of reserved names, so a client cannot exhaust the memory.
_MAX_NAMES = 10_000


@dataclass
class Session:
    """A task of a client."""

    task: Task
    owner: str  # peer that created it
    users: set[str] = field(default_factory=set)  # peers that have used it
    disconnected_at: float | None = None  # monotonic time of the last disconnection [s]; None while a user is connected


class SessionExists(ShotrigError):
    """A new session was requested under an existing name."""


class Sessions:
    """The sessions of a server, at most `max_sessions` per connection; `storage` has the custom scales of the tasks."""

    def __init__(self, chassis: Chassis, storage: Storage, max_sessions: int) -> None:
        self._chassis, self._storage, self._max_sessions = chassis, storage, max_sessions
        self._open: dict[str, Session] = {}
        self._numbers = itertools.count(1)
        self._lock = threading.RLock()

    def open(self, name: str, behavior: int, peer: str, strict: bool = False) -> tuple[str, bool]:
        """Open a session, or attach to the existing session of this name.

        Return the name of the session, and whether it is new. `behavior` is `INITIALIZE`, `ATTACH`, or 0 for either.
        With `strict`, an existing name is always an error. Raises `SessionExists` if a new session was requested and
        the name exists, and `DaqError` -200088 if there is no session to attach to, -50103 if the client has the
        maximum number of sessions, -200089 if there is a task of that name and `strict` is true.
        """
        with self._lock:
            if name and name in self._open and not strict:
                if behavior == INITIALIZE:
                    raise SessionExists(f"there is already a session {name!r}. Attach to it, or choose another name.")
                self._open[name].users.add(peer)
                return name, False
            if behavior == ATTACH:
                raise DaqError(f"there is no session {name!r} to attach to. Create it first.", Code.INVALID_TASK)
            if sum(session.owner == peer for session in self._open.values()) >= self._max_sessions:
                raise DaqError(
                    f"this client has {self._max_sessions} open tasks, the maximum. Close a task first.",
                    Code.PAL_RESOURCE_RESERVED,
                )
            task = Task(self._chassis, name, self._storage.scales)
            session = name or f"session_{next(self._numbers)}"
            self._open[session] = Session(task, peer, {peer})
            return session, True

    def check_memory(self, name: str, max_bytes: int) -> None:
        """Raise `DaqError` -200077, and release the session's buffers, if all buffers of its client exceed a size."""
        with self._lock:
            session = self._open.get(name)
            if session is None:
                return
            size = sum(other.task.memory for other in self._open.values() if other.owner == session.owner)
        if size > max_bytes:
            session.task.free_memory()
            raise invalid_value(
                f"the buffers of this client's tasks require {size >> 20} MB, the maximum is {max_bytes >> 20} MB. "
                "Use smaller buffers, or close tasks."
            )

    def find(self, name: str, peer: str) -> Task:
        """Return the task of a session. Raises `DaqError` -200088 if the session does not exist."""
        with self._lock:
            session = self._open.get(name)
            if session is None:
                raise DaqError("the task does not exist, or has been closed. Create another task.", Code.INVALID_TASK)
            session.users.add(peer)
            session.disconnected_at = None
            return session.task

    def task_name(self, name: str) -> str:
        """Return the name of a session's task; the name of the session if the session is not open."""
        with self._lock:
            session = self._open.get(name)
            return name if session is None else session.task.name

    def close(self, name: str, peer: str) -> None:
        """End a session; a client that did not create it only detaches from it."""
        with self._lock:
            self.find(name, peer)
            session = self._open[name]
            if session.owner != peer:
                session.users.discard(peer)
                return
            del self._open[name]
        session.task.close()

    def abort_on_device(self, device: str, peer: str) -> None:
        """Abort the tasks of a client on a device. Raises `DaqError` -50103 if other clients use the device."""
        with self._lock:
            sessions = [session for session in self._open.values() if device in session.task.settings.device_names]
            other_tasks = [session.task.name for session in sessions if session.owner != peer]
            if other_tasks:
                raise DaqError(
                    f"{device} is in use by other clients (task {', '.join(other_tasks)}). End their tasks first.",
                    Code.PAL_RESOURCE_RESERVED,
                )
            for session in sessions:
                session.task.control(TaskMode.ABORT)

    def end_abandoned(self, connected: Collection[tuple[str, int]], disconnect_timeout: float) -> list[str]:
        """End the sessions of clients that disconnected without closing them; return the names of the ended tasks.

        `connected` has the address and port of every connected client, `disconnect_timeout` is the time in s from the
        disconnection of the last client of a session to its end.
        """
        ended = []
        with self._lock:
            now = time.monotonic()
            for name, session in list(self._open.items()):
                if any(_endpoint(user) in connected for user in session.users):
                    session.disconnected_at = None
                elif session.disconnected_at is None:
                    session.disconnected_at = now
                elif now - session.disconnected_at >= disconnect_timeout:
                    ended.append(self._open.pop(name).task)
        for task in ended:
            self._end(task)
        return [task.name for task in ended]

    def close_all(self, keep: Collection[str] = ()) -> None:
        """End all sessions, except those of the tasks named in `keep`."""
        with self._lock:
            names = [name for name, session in self._open.items() if session.task.name not in keep]
            tasks = [self._open.pop(name).task for name in names]
        for task in tasks:
            self._end(task)

    def _end(self, task: Task) -> None:
        """Close a task without a client to which an error, for example of the log, could be reported."""
        try:
            task.close()
        except Exception as error:
            self._chassis.report_problem(f"task {task.name}", error)


def _endpoint(peer: str) -> tuple[str, int]:
    """Return address and port of a peer such as "ipv4:127.0.0.1:40022"."""
    host, _, port = unquote(peer).partition(":")[2].rpartition(":")
    return host.strip("[]"), int(port) if port.isdigit() else 0


class Reservations:
    """Names that clients reserve to coordinate with each other; the server does not interpret them."""

    def __init__(self) -> None:
        self._holders: dict[str, str] = {}  # client of each reserved name
        self._changed = threading.Condition()

    def reserve(self, name: str, client: str, is_waiting: Callable[[], bool]) -> bool:
        """Reserve a name as soon as no other client has reserved it; return False if the client stops waiting."""
        with self._changed:
            while self._holders.get(name, client) != client:
                if not is_waiting():
                    return False
                self._changed.wait(_CHECK_INTERVAL_S)
            if name not in self._holders and len(self._holders) >= _MAX_NAMES:
                raise DaqError(
                    f"{_MAX_NAMES} names are reserved, the maximum. Release a name before reserving {name!r}.",
                    Code.PAL_RESOURCE_RESERVED,
                )
            self._holders[name] = client
            return True

    def is_reserved_by(self, name: str, client: str) -> bool:
        """Return whether a client has reserved a name."""
        return self._holders.get(name) == client

    def release(self, name: str, client: str) -> bool:
        """Release a name; return False if the client has not reserved it."""
        with self._changed:
            if not self.is_reserved_by(name, client):
                return False
            del self._holders[name]
            self._changed.notify_all()
            return True

    def clear(self) -> None:
        """Release all names."""
        with self._changed:
            self._holders.clear()
            self._changed.notify_all()
