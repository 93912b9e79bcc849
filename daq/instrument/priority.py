"""Priority of the threads that run a bench in real time and serve its clients."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress

# Linux nice value: before ordinary programs (0), after the most urgent system programs (-20).
_NICE = -10


def raise_priority() -> None:
    """Raise the priority of this thread if the operating system supports and permits it."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
