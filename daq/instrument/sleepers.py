"""Who waits for a bench's time to come: each is woken when its own has, not at every block."""

from __future__ import annotations

import threading

# Who sleeps longer looks up anyway, s: what is waited for may have become impossible.
_NAP = 1.0


class Sleepers:
    """Threads that wait for positions of a bench.

    Ten readers that each wait for a tenth of a second would be woken 25 times for nothing by a bench that moves every
    four milliseconds, and would hold up the one whose samples have come.

    Parameters
    ----------
    lock : lock
        The bench's; whoever sleeps holds it, and lets go of it meanwhile.
    """

    def __init__(self, lock: threading.RLock) -> None:
        self._lock = lock
        self._waiting: dict[threading.Condition, int] = {}

    def sleep(self, until: int) -> None:
        """Sleep until the bench has come to a position, or something else has happened."""
        mine = threading.Condition(self._lock)
        self._waiting[mine] = until
        try:
            mine.wait(_NAP)
        finally:
            del self._waiting[mine]

    def wake(self, position: int | None = None) -> None:
        """Wake those whose position has come; without one, all."""
        for each, until in self._waiting.items():
            if position is None or until <= position:
                each.notify()
