"""Names that clients reserve among themselves."""

from __future__ import annotations

import threading
from collections.abc import Callable

from daq.instrument.errors import Code, DaqError

# Interval at which a waiting client is checked, s: it may have disconnected.
_LOOK = 0.1
_MOST = 10_000


class Reservations:
    """Names that clients reserve among themselves; they have no meaning for the server."""

    def __init__(self) -> None:
        self._holders: dict[str, str] = {}
        self._changed = threading.Condition()

    def reserve(self, name: str, client: str, waits: Callable[[], bool]) -> bool:
        """Reserve a name as soon as no other client has reserved it; return False if the client no longer waits."""
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
        """Return whether a client has reserved a name."""
        return self._holders.get(name) == client

    def release(self, name: str, client: str) -> bool:
        """Release a name; return False if the client has not reserved it."""
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
