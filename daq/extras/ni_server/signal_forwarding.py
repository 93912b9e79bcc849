"""Forwards signals from `daq run` to its script so that the script ends too."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from types import FrameType
from typing import Any

from rig.core.base.ending_signals import handle_interrupts

# Time from the signal that requests the end of a script until the script is killed [s].
GRACE_PERIOD_S = 1.0
# A signal to a process group has reached all its processes after this time [s].
_DELIVERY_S = 1.0


class _GroupProbe:
    """A process in the script's process group; its end shows that the group has received Ctrl-C."""

    _COMMAND = (sys.executable, "-I", "-S", "-c", "import sys; sys.stdin.read()")

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        # The process ends when its input closes, even if its parent crashes.
        self._process = subprocess.Popen(
            self._COMMAND, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def received(self) -> bool:
        """Return whether the group received the latest Ctrl-C; if so, restart the process for the next signal."""
        try:
            self._process.wait(_DELIVERY_S)
        except subprocess.TimeoutExpired:
            return False
        self.close()
        self._start()
        return True

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


@contextmanager
def forward_signals(process: subprocess.Popen[Any]) -> Iterator[None]:
    """Forward signals to the process of a script while the body runs, and end the process afterwards.

    Ctrl-C in a terminal reaches the whole process group; it is forwarded only if the script did not receive it. Any
    other signal is forwarded, and the script is killed after `GRACE_PERIOD_S`.
    """
    kill_timer = threading.Timer(GRACE_PERIOD_S, process.kill)
    kill_timer.daemon = True
    try:
        with closing(_GroupProbe()) as probe:

            def forward(signal_number: int, frame: FrameType | None) -> None:
                if signal_number != signal.SIGINT:
                    process.send_signal(signal_number)
                    if kill_timer.ident is None:
                        kill_timer.start()
                elif os.name == "posix" and not probe.received():
                    process.send_signal(signal_number)

            with handle_interrupts(forward):
                yield
    finally:
        kill_timer.cancel()
        process.kill()
        process.wait()
