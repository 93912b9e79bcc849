"""Functions that workers call in tests, in a module that they import quickly."""

import logging
import os
import signal
import threading
from pathlib import Path

from rig.core.base.errors import SceneError


def square(number: int) -> int:
    if number < 0:
        raise SceneError(f"{number}: expected a number that is not negative")
    return number * number


def exit_process(_: int) -> None:
    os._exit(1)


def wait_forever_unless_zero(number: int) -> None:
    if number:
        threading.Event().wait()


def log_compilation(folder: Path) -> None:
    """Log a compilation as soon as two workers run."""
    (folder / str(os.getpid())).touch()
    while len(list(folder.iterdir())) < 2:
        os.sched_yield()
    logging.getLogger("shotrig.compiling").warning("compiling")


def sigint_is_ignored(_: int) -> bool:
    return signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def write_id_and_wait(file: Path) -> None:
    """Write the id of this process, in one step, then wait forever."""
    temporary = file.with_name("temporary")
    temporary.write_text(str(os.getpid()))
    temporary.rename(file)
    threading.Event().wait()


def sigint_is_blocked(_: int) -> bool:
    """Return whether the worker began with Ctrl-C blocked."""
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
