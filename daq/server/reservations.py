"""Names that clients reserve among themselves."""

from __future__ import annotations

import threading
from collections.abc import Callable

from daq.instrument.errors import Code, DaqError

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
