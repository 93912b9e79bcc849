"""Run a command in a child process, and measure its exit code, output, time without output, duration and memory."""

import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import NoReturn

from rig.core.base.ending_signals import TERMINATION_SIGNALS

# A command is killed after this time.
TIME_LIMIT_S = 60.0
# Largest resident memory of a command.
MEMORY_LIMIT_BYTES = 1 << 30
# Address space of a command, so that a fault cannot exhaust the memory of the machine. Libraries reserve much of it.
ADDRESS_SPACE_BYTES = 12 << 30
# Interval between looks at a command.
OBSERVATION_INTERVAL_S = 0.2
PACKAGES = ("rig", "daq", "analysis")


@dataclass(frozen=True)
class CommandResult:
    """Result of a command."""

    command: tuple[str, ...]
    """Words of the command line."""
    code: int
    """Exit code; negative: the signal that ended the command."""
    output: str
    """Standard output and standard error."""
    seconds: float
    """Elapsed time."""
    memory: int
    """Largest resident memory, bytes."""

    @property
    def faults(self) -> list[str]:
        """Names of the faults in the result."""
        names = []
        if "Traceback (most recent call last)" in self.output or "Exception ignored" in self.output:
            names.append("traceback")
        if "this is a fault of shotrig" in self.output:
            names.append("unexpected")
        if self.memory > MEMORY_LIMIT_BYTES:
            names.append("memory")
        # Exit codes of the packages: 0 done, 1 failed, 2 bad input, 128 + number of SIGHUP, SIGINT or SIGTERM. `_watch`
        # kills a command at the time limit; a command that has made progress until then is not at fault.
        if self.code not in (0, 1, 2, 129, 130, 143) and self.seconds < TIME_LIMIT_S:
            names.append(f"exit code {self.code}")
        if any(ord(character) < 32 and character not in "\n\t\r" for character in self.output):
            names.append("control character")
        return names


def run(words, folder, on_poll=None, environment=None, prepare=None, time_limit=TIME_LIMIT_S):
    """Run `rig`, `daq` or `analysis` in a fork of this process, which has already imported the packages.

    Parameters
    ----------
    words : sequence of str
        Words of the command line.
    folder : Path
        Working directory.
    on_poll : callable, optional
        ``on_poll(process_id, seconds)``, called every few milliseconds while the command runs; it may send a signal.
    environment : dict, optional
        Environment variables to set.
    prepare : callable, optional
        Called in the child process before the command.
    time_limit : float
        Time after which the command is killed, s.
    """

    def run_command() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE_BYTES, ADDRESS_SPACE_BYTES))
        if prepare is not None:
            prepare()
        sys.argv = list(words)
        import_module(f"{words[0]}.commands.cli").main()

    return _watch(words, *_fork(folder, environment or {}, run_command), on_poll, time_limit)


def run_new_process(words, folder, on_poll=None, module=False):
    """Run a command in a new process, as a shell does: by its installed script, or by ``python -m`` if `module`.

    `words`, `folder`, `on_poll`: as of `run`.
    """
    script = Path(sys.executable).with_name(words[0])
    program = [sys.executable, "-m", words[0]] if module or not script.exists() else [str(script)]

    def run_command() -> NoReturn:
        os.execv(program[0], [*program, *words[1:]])

    return _watch(words, *_fork(folder, {}, run_command), on_poll, TIME_LIMIT_S)


def is_own_traceback(output: str) -> bool:
    """Return whether a traceback contains a file of the packages, and not only of the start of Python."""
    return any(f'File "{Path(import_module(package).__file__ or "").parent}{os.sep}' in output for package in PACKAGES)


def processes_remain(group: int, seconds: float = 5.0) -> bool:
    """Return whether processes of a process group still exist after a time."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return False
        time.sleep(OBSERVATION_INTERVAL_S)
    return True


def _watch(words, process_id, output, on_poll, time_limit):
    """Collect the output of a child process from a pipe until it ends."""
    start = time.monotonic()
    received, is_open = bytearray(), True
    try:
        while is_open:
            ready, _, _ = select.select([output], [], [], 0.005 if on_poll is not None else OBSERVATION_INTERVAL_S)
            now = time.monotonic()
            if ready:
                data = os.read(output, 1 << 16)
                received += data
                is_open = bool(data)
            if on_poll is not None:
                on_poll(process_id, now - start)
            if now - start > time_limit:
                break
    finally:
        if is_open:
            os.killpg(process_id, signal.SIGKILL)
        _, status, usage = os.wait4(process_id, 0)
        os.close(output)
    return CommandResult(
        tuple(words),
        os.waitstatus_to_exitcode(status),
        received.decode(errors="replace"),
        time.monotonic() - start,
        usage.ru_maxrss * 1024,
    )


def _fork(folder: Path, environment: dict[str, str], run_command: Callable[[], None]) -> tuple[int, int]:
    """Start a child process in a folder; return its process id and the reading end of the pipe of its output."""
    reading_end, writing_end = os.pipe()
    # Block signals until the child has the default handlers of a new process.
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINATION_SIGNALS)
    process_id = os.fork()
    if process_id == 0:
        # A separate process group, as in a shell: a terminal sends Ctrl-C to the whole group.
        os.setpgid(0, 0)
        for signal_number in TERMINATION_SIGNALS:
            signal.signal(signal_number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
        _execute(folder, writing_end, environment, run_command)
    with suppress(OSError):
        # Parent and child both set the group, because either may run first.
        os.setpgid(process_id, process_id)
    signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
    os.close(writing_end)
    return process_id, reading_end


def _execute(folder: Path, output: int, environment: dict[str, str], run_command: Callable[[], None]) -> NoReturn:
    """Run a command in the child of a fork with its output to a pipe, and end the process."""
    code = 70
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdin, sys.stdout, sys.stderr = (
            open(number, mode, closefd=False)  # noqa: SIM115
            for number, mode in ((0, "r"), (1, "w"), (2, "w"))
        )
        os.chdir(folder)
        os.environ.update(environment)
        code = 0
        run_command()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else (0 if end.code is None else 1)
    except BaseException:
        sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
        code = 1
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)
