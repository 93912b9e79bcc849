"""What ends `daq run` ends the script it runs: signals to this process alone are passed on to the script's."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

from daq.recording.interrupts import answered

# Time that a script has to end after a request, before it is killed, s.
PATIENCE = 1.0
# Where a signal reached a whole group, all of it has heard after this, s.
_HEARD = 1.0


class _Witness:
    """A process of the same group, which Ctrl-C ends: it shows whether a Ctrl-C went to the group or to one process."""

    _COMMAND = (sys.executable, "-I", "-S", "-c", "import sys; sys.stdin.read()")

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        # With its input it ends, whatever becomes of this process.
        self._process = subprocess.Popen(
            self._COMMAND, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def heard(self) -> bool:
        """Whether it has heard the latest Ctrl-C as well; it then waits for the next."""
        try:
            self._process.wait(_HEARD)
        except subprocess.TimeoutExpired:
            return False
        self.__exit__(None, None, None)
        self._begin()
        return True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()


@contextmanager
def signals_passed_on(process: subprocess.Popen[Any]) -> Iterator[None]:
    """Pass on to a process what comes to this one in the body, and leave none of it running after.

    Ctrl-C is the script's to deal with. Other signals ask it to end, and `PATIENCE` later it has to.

    Parameters
    ----------
    process : Popen
        In this process's group, which a terminal's Ctrl-C reaches as a whole.
    """
    end = threading.Timer(PATIENCE, process.kill)
    end.daemon = True
    try:
        with _Witness() as witness:

            def pass_on(number: int, frame: FrameType | None) -> None:
                if number != signal.SIGINT:
                    process.send_signal(number)
                    if end.ident is None:
                        end.start()
                elif os.name == "posix" and not witness.heard():
                    process.send_signal(number)

            with answered(pass_on):
                yield
    finally:
        end.cancel()
        process.kill()
        process.wait()
