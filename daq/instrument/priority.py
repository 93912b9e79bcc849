"""The priority of the threads that keep a bench at real time and answer its clients."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress

# Linux: ahead of ordinary programs (0), behind the system's most urgent ones (-20).
_NICE = -10


def raise_priority() -> None:
    """Raise the priority of this thread where the system has priorities of threads and permits it."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
