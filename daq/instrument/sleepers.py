"""Threads that wait for a bench time: each is woken at its own time, not at every block."""

from __future__ import annotations

import threading

# Maximum sleep before the condition is checked again, s: it may have become impossible.
_NAP = 1.0


class Sleepers:
    """Threads that wait for positions of a bench.

    A bench that advances every 4 ms would wake ten readers that each wait for 100 ms unnecessarily 25 times. This
    would delay the reader whose samples are available.

    `lock`: lock of the bench; the calling thread holds it, and releases it while it sleeps.
    """

    def __init__(self, lock: threading.RLock) -> None:
        self._lock = lock
        self._waiting: dict[threading.Condition, int] = {}

    def sleep(self, until: int) -> None:
        """Sleep until the bench has reached a position, or until all threads are woken."""
        mine = threading.Condition(self._lock)
        self._waiting[mine] = until
        try:
            mine.wait(_NAP)
        finally:
            del self._waiting[mine]

    def wake(self, position: int | None = None) -> None:
        """Wake the threads whose position has been reached; without a position, wake all."""
        for each, until in self._waiting.items():
            if position is None or until <= position:
                each.notify()
