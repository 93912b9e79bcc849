"""Sessions: the tasks of all clients, who may end them, and what becomes of those that are left behind."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Collection
from dataclasses import dataclass, field
from urllib.parse import unquote

from daq.instrument.chassis import Chassis
from daq.instrument.errors import Code, DaqError, bad
from daq.instrument.settings.storage import Storage
from daq.instrument.task import Task
from rig.errors import ShotrigError

AUTO, INITIALIZE, ATTACH = 0, 1, 2


@dataclass
class Session:
    """A task of a client.

    Attributes
    ----------
    task : Task
        The task.
    owner : str
        The connection that made it.
    users : set of str
        Connections that have used it.
    left_at : float or None
        When all of them were found gone, s.
    """

    task: Task
    owner: str
    users: set[str] = field(default_factory=set)
    left_at: float | None = None


class SessionExists(ShotrigError):
    """A new session was asked for under a name that is taken."""


class Sessions:
    """The sessions of a server.

    Parameters
    ----------
    chassis : Chassis
        Where tasks run.
    storage : Storage
        Where their custom scales are.
    most : int
        Tasks that one connection may have open.
    """

    def __init__(self, chassis: Chassis, storage: Storage, most: int) -> None:
        self._chassis, self._storage, self._most = chassis, storage, most
        self._open: dict[str, Session] = {}
        self._numbers = itertools.count(1)
        self._lock = threading.RLock()

    def open(self, name: str, behavior: int, peer: str) -> tuple[str, bool]:
        """Open a session, or attach to the one of that name.

        Returns
        -------
        tuple
            Name of the session; whether it is new.

        Raises
        ------
        SessionExists
            If a new one was asked for and there is one of that name.
        DaqError
            With -200088, if there is none to attach to; with -50103, if the client has as many as it may.
        """
        with self._lock:
            if name and name in self._open:
                if behavior == INITIALIZE:
                    raise SessionExists(f"there is a session {name!r} already")
                self._open[name].users.add(peer)
                return name, False
            if behavior == ATTACH:
                raise DaqError(f"there is no session {name!r} to attach to", Code.INVALID_TASK)
            if sum(each.owner == peer for each in self._open.values()) >= self._most:
                raise DaqError(
                    f"this client has {self._most} tasks open, which is as many as it may: close some",
                    Code.PAL_RESOURCE_RESERVED,
                )
            task = Task(self._chassis, name, self._storage.scales)
            session = name or f"session_{next(self._numbers)}"
            self._open[session] = Session(task, peer, {peer})
            return session, True

    def check_memory(self, name: str, most: int) -> None:
        """Make sure that the buffers of a client do not take more than so many bytes; else the last one has to go."""
        with self._lock:
            session = self._open.get(name)
            if session is None:
                return
            held = sum(each.task.memory for each in self._open.values() if each.owner == session.owner)
        if held > most:
            session.task.free_memory()
            raise bad(
                f"the buffers of this client's tasks would take {held >> 20} MB; it may have {most >> 20} MB: "
                "take smaller buffers, or close tasks"
            )

    def check_free(self, name: str) -> None:
        """Make sure that no task has a name; with -200089."""
        if name in self._chassis.tasks:
            raise DaqError(
                f"there is a task named {name!r} already: close it first, or choose another name",
                Code.DUPLICATE_TASK,
            )

    def find(self, name: str, peer: str) -> Task:
        """Find the task of a session; with -200088, if there is none."""
        with self._lock:
            session = self._open.get(name)
            if session is None:
                raise DaqError(
                    "the task does not exist, or has been closed: make a new one", Code.INVALID_TASK
                )
            session.users.add(peer)
            session.left_at = None
            return session.task

    def task_name(self, name: str) -> str:
        """Give the name of a session's task; the session's own if it is not open."""
        with self._lock:
            session = self._open.get(name)
            return name if session is None else session.task.name

    def close(self, name: str, peer: str) -> None:
        """End a session; a client that only attached to it leaves it to the one that made it."""
        with self._lock:
            self.find(name, peer)
            session = self._open[name]
            if session.owner != peer:
                session.users.discard(peer)
                return
            del self._open[name]
        session.task.close()

    def end_on(self, device: str, peer: str) -> None:
        """Abort what a client runs on a device; with -50103, if others use it too."""
        with self._lock:
            there = [each for each in self._open.values() if device in each.task.settings.device_names]
            others = [each.task.name for each in there if each.owner != peer]
            if others:
                raise DaqError(
                    f"{device} is in use by other clients (task {', '.join(others)}): it is not reset",
                    Code.PAL_RESOURCE_RESERVED,
                )
            for each in there:
                each.task.control(5)

    def sweep(self, there: Collection[tuple[str, int]], patience: float) -> list[str]:
        """End the sessions whose clients have gone without goodbye.

        Parameters
        ----------
        there : collection of tuple
            Address and port of every client that is connected.
        patience : float
            Seconds that a session is kept for its client to come back.

        Returns
        -------
        list of str
            Names of the tasks that were ended.
        """
        ended = []
        with self._lock:
            now = time.monotonic()
            for name, session in list(self._open.items()):
                if any(_endpoint(each) in there for each in session.users):
                    session.left_at = None
                elif session.left_at is None:
                    session.left_at = now
                elif now - session.left_at >= patience:
                    ended.append(self._open.pop(name).task)
        for task in ended:
            task.close()
        return [each.name for each in ended]

    def close_all(self) -> None:
        """End all sessions."""
        with self._lock:
            sessions, self._open = list(self._open.values()), {}
        for each in sessions:
            each.task.close()


def _endpoint(peer: str) -> tuple[str, int]:
    """Give address and port of a peer, as in "ipv4:127.0.0.1:40022"."""
    host, _, port = unquote(peer).partition(":")[2].rpartition(":")
    return host.strip("[]"), int(port) if port.isdigit() else 0
