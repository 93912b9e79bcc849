"""Running a script with the rig as its hardware, for the real package nidaqmx and for `daq.nidaqmx`."""

from __future__ import annotations

import builtins
import importlib.util
import math
import runpy
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from daq.instrument.chassis import Chassis
from daq.instrument.connection import connect
from rig.errors import SceneError

# How long a script that asks for Enter is left waiting on the fast clock, s of bench time.
PROMPT = 10.0


def run_script(
    path: str | Path,
    arguments: Sequence[str] = (),
    scene: str | None = None,
    clock: str | None = None,
    seconds: float | None = None,
) -> int:
    """Run a script as Python would, with the rig as its hardware.

    Parameters
    ----------
    path : str or Path
        The script.
    arguments : sequence of str
        What it finds in `sys.argv` after its name.
    scene : str, optional
        Name or path of the scene on the bench, see `daq.connect`.
    clock : str, optional
        Clock, see `daq.connect`. On the fast one `time.sleep` lets bench time pass, and so does `input`,
        which then returns an empty line.
    seconds : float, optional
        Bench time after which the script gets a Ctrl-C; if it waits for Enter then, it gets that instead.

    Returns
    -------
    int
        Exit code: the script's own; 1 if it raised an exception, whose traceback is then on stderr.

    Raises
    ------
    SceneError
        If there is no such script, the scene cannot be used, or `seconds` is no time.
    """
    path = Path(path)
    if seconds is not None and not 0 < seconds < math.inf:
        raise SceneError(f"seconds {seconds:g}: expected a time above 0; leave it out for no limit")
    if not path.is_file():
        raise SceneError(f"there is no script {path}: give the path of a Python file")
    chassis = connect(scene, clock)
    if importlib.util.find_spec("nidaqmx") is not None:
        from daq.face.interpreter import plug_in

        plug_in()
    limit = _Limit(chassis, seconds)
    with _as_main(path, arguments), _passing_time(chassis, limit):
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            return _exit_code(end)
        except KeyboardInterrupt:
            if not limit.reached:
                raise
        except ModuleNotFoundError as error:
            _show(error, path)
            if error.name == "nidaqmx":
                print("The real nidaqmx package comes with: pip install 'shotrig[nidaqmx]'", file=sys.stderr)
            return 1
        except Exception as error:
            _show(error, path)
            return 1
    return 0


class _Limit:
    """Ends a script after a time on the bench."""

    def __init__(self, chassis: Chassis, seconds: float | None) -> None:
        self._chassis, self._seconds = chassis, seconds
        self.reached = False
        if seconds is not None:
            chassis.at(seconds, self._interrupt)

    @property
    def limited(self) -> bool:
        """Whether there is a limit."""
        return self._seconds is not None

    def left(self) -> float:
        """Seconds a prompt waits: until the limit, if there is one."""
        return PROMPT if self._seconds is None else max(0.0, self._seconds - self._chassis.elapsed)

    def answer(self) -> None:
        """Let the prompt's answer be the end."""
        self.reached = True

    def _interrupt(self) -> None:
        if self.reached:
            return
        self.reached = True
        main = threading.main_thread()
        if threading.current_thread() is main:
            raise KeyboardInterrupt
        assert main.ident is not None
        signal.pthread_kill(main.ident, signal.SIGINT)


@contextmanager
def _as_main(path: Path, arguments: Sequence[str]) -> Iterator[None]:
    """Give a script the arguments and the import path Python would give it."""
    argv, first = sys.argv, str(path.resolve().parent)
    sys.argv = [str(path), *arguments]
    sys.path.insert(0, first)
    try:
        yield
    finally:
        sys.argv = argv
        sys.path.remove(first)


@contextmanager
def _passing_time(chassis: Chassis, limit: _Limit) -> Iterator[None]:
    """Let bench time pass where a script waits for something else than the bench."""
    sleep, prompt = time.sleep, builtins.input

    def wait_for_enter(text: object = "", /) -> str:
        print(text, end="", flush=True)
        left = limit.left()
        limit.answer()
        chassis.pass_time(left)
        return ""

    fast = not chassis.clock.runs_free
    timed: Any = chassis.pass_time
    if fast:
        time.sleep = timed
    if fast or limit.limited:
        builtins.input = wait_for_enter
    try:
        yield
    finally:
        time.sleep, builtins.input = sleep, prompt


def _exit_code(end: SystemExit) -> int:
    if end.code is None or isinstance(end.code, int):
        return end.code or 0
    print(end.code, file=sys.stderr)
    return 1


def _show(error: BaseException, path: Path) -> None:
    """Print a traceback that begins in the script; there is none if the script cannot be compiled."""
    trace = error.__traceback__
    while trace is not None and Path(trace.tb_frame.f_code.co_filename) != path:
        trace = trace.tb_next
    if trace is None and getattr(error, "filename", None) != str(path):
        print(f"cannot run {path}:", file=sys.stderr)
    traceback.print_exception(type(error), error, trace)
