"""Forwarding of signals from `daq run` to its script, so that the script ends too."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from types import FrameType
from typing import Any

from rig.ending_signals import handle_interrupts

# Time between the request to end and the kill of a script, s.
PATIENCE = 1.0
# Time after which a signal to a process group has reached all its processes, s.
_DELIVERY_S = 1.0


class _Witness:
    """A process of the same group that Ctrl-C ends: it shows whether the whole group received Ctrl-C."""

    _COMMAND = (sys.executable, "-I", "-S", "-c", "import sys; sys.stdin.read()")

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        # It ends when its input closes, even if this process crashes.
        self._process = subprocess.Popen(
            self._COMMAND, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def received(self) -> bool:
        """Return whether it received the latest Ctrl-C; it is then restarted for the next signal."""
        try:
            self._process.wait(_DELIVERY_S)
        except subprocess.TimeoutExpired:
            return False
        self.close()
        self._begin()
        return True

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


@contextmanager
def signals_passed_on(process: subprocess.Popen[Any]) -> Iterator[None]:
    """Forward signals to a process while the body runs, and end the process afterwards.

    The script handles Ctrl-C. Other signals request its end; after `PATIENCE` it is killed.

    `process`: process in the group of this process; Ctrl-C in a terminal reaches the whole group.
    """
    end = threading.Timer(PATIENCE, process.kill)
    end.daemon = True
    try:
        with closing(_Witness()) as witness:

            def pass_on(number: int, frame: FrameType | None) -> None:
                if number != signal.SIGINT:
                    process.send_signal(number)
                    if end.ident is None:
                        end.start()
                elif os.name == "posix" and not witness.received():
                    process.send_signal(number)

            with handle_interrupts(pass_on):
                yield
    finally:
        end.cancel()
        process.kill()
        process.wait()
