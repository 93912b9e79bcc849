"""Run a command in a child process, and observe its exit code, output, silences, time and memory."""

from __future__ import annotations

import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import NoReturn

import psutil

from rig.ending_signals import TERMINATION_SIGNALS

# Longest time without output before a command counts as hanging, s.
SILENCE_LIMIT_S = 20.0
# Longest time of a command, s.
TIME_LIMIT_S = 60.0
# Largest memory of a command, bytes.
MEMORY_LIMIT_BYTES = 1 << 30
# Interval between observations of a command, s.
OBSERVATION_INTERVAL_S = 0.2
PACKAGES = ("rig", "daq", "analysis")


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    command: tuple[str, ...]  # its words
    code: int  # exit code; negative: the signal that ended it
    output: str  # what it wrote to both streams
    silence: float  # longest time without output, s, without the time in which it waited for a processor
    seconds: float  # time from start to end
    memory: int  # most resident memory, bytes

    @property
    def faults(self) -> list[str]:
        """Faults of the command."""
        names = []
        if "Traceback (most recent call last)" in self.output or "Exception ignored" in self.output:
            names.append("traceback")
        if "this is a fault of shotrig" in self.output:
            names.append("unexpected")
        if self.silence > SILENCE_LIMIT_S:
            names.append("silence")
        if self.memory > MEMORY_LIMIT_BYTES:
            names.append("memory")
        # A command that still shows progress at the time limit was killed here, which is no fault.
        if self.code not in (0, 1, 2, 129, 130, 143) and self.seconds < TIME_LIMIT_S:
            names.append(f"exit code {self.code}")
        if any(ord(letter) < 32 and letter not in "\n\t\r" for letter in self.output):
            names.append("control character")
        return names


def run(
    words: Sequence[str],
    folder: Path,
    end: Callable[[int, float], None] | None = None,
    environment: dict[str, str] | None = None,
    prepare: Callable[[], None] | None = None,
    longest: float = TIME_LIMIT_S,
) -> Ended:
    """Run `rig`, `daq` or `analysis` in a fork of this process, which has imported them already.

    Parameters
    ----------
    words : sequence of str
        The command.
    folder : Path
        Where it runs.
    end : callable, optional
        ``end(process, seconds)``, called repeatedly while the command runs; it may kill it.
    environment : dict, optional
        Variables to set.
    prepare : callable, optional
        Called in the child before the command.
    longest : float
        Time after which it is killed, s.
    """

    def run_command() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
        if prepare is not None:
            prepare()
        sys.argv = list(words)
        import_module(f"{words[0]}.cli").main()

    return _watch(words, *_fork(folder, environment or {}, run_command), end, longest)


def run_afresh(
    words: Sequence[str], folder: Path, end: Callable[[int, float], None] | None = None, module: bool = False
) -> Ended:
    """Run a command in a new process, as a shell does: by its installed script, or by ``python -m``.

    `words`, `folder`, `end`: as of `run`; `module`: whether to run it by ``python -m``.
    """
    script = Path(sys.executable).with_name(words[0])
    program = [sys.executable, "-m", words[0]] if module or not script.exists() else [str(script)]

    def run_command() -> NoReturn:
        os.execv(program[0], [*program, *words[1:]])

    return _watch(words, *_fork(folder, {}, run_command), end, TIME_LIMIT_S)


def is_own_traceback(output: str) -> bool:
    """Return whether a traceback passes through a file of the packages, not only through the start of Python."""
    return any(f'File "{Path(import_module(package).__file__ or "").parent}{os.sep}' in output for package in PACKAGES)


def processes_remain(process: int, seconds: float = 5.0) -> bool:
    """Return whether processes of a command still exist some time after its end."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            os.killpg(process, 0)
        except ProcessLookupError:
            return False
        time.sleep(OBSERVATION_INTERVAL_S)
    return True


class ComputingTime:
    """Time of a command without that in which it waited for a processor."""

    def __init__(self, process: int) -> None:
        self.process = psutil.Process(process)
        self.last_time, self.computed = time.monotonic(), 0.0

    def passed(self) -> float:
        """Return the time since the previous call, s."""
        now = time.monotonic()
        span, self.last_time = now - self.last_time, now
        computed, ready = 0.0, False
        try:
            for child in (self.process, *self.process.children(recursive=True)):
                computed += sum(child.cpu_times()[:4])
                ready |= child.status() in (psutil.STATUS_RUNNING, psutil.STATUS_DISK_SLEEP)
        except psutil.Error:
            # The command or one of its children is ending.
            return 0.0
        cpu_time, self.computed = max(computed - self.computed, 0.0), computed
        # Background threads wake for moments even in a command that hangs.
        return min(cpu_time, span) if ready or cpu_time > 0.02 * span else span


def _watch(
    words: Sequence[str], process: int, reading: int, end: Callable[[int, float], None] | None, longest: float
) -> Ended:
    """Collect the output of a child until it ends."""
    started = last_observation = time.monotonic()
    computing_time, received, current_silence, silence, is_open = (ComputingTime(process), bytearray(), 0.0, 0.0, True)
    try:
        while is_open:
            ready, _, _ = select.select([reading], [], [], 0.005 if end is not None else OBSERVATION_INTERVAL_S)
            now = time.monotonic()
            if now - last_observation >= OBSERVATION_INTERVAL_S:
                current_silence, last_observation = current_silence + computing_time.passed(), now
                silence = max(silence, current_silence)
            if ready:
                data = os.read(reading, 1 << 16)
                received += data
                is_open, current_silence = bool(data), 0.0
            if end is not None:
                end(process, now - started)
            if now - started > longest:
                break
    finally:
        if is_open:
            os.killpg(process, signal.SIGKILL)
        _, status, usage = os.wait4(process, 0)
        os.close(reading)
    return Ended(
        tuple(words),
        os.waitstatus_to_exitcode(status),
        received.decode(errors="replace"),
        silence,
        time.monotonic() - started,
        usage.ru_maxrss * 1024,
    )


def _fork(folder: Path, environment: dict[str, str], run_command: Callable[[], None]) -> tuple[int, int]:
    """Start a child that acts in a folder; return its process number and the pipe of its output."""
    reading, writing = os.pipe()
    # Block signals until the child has the default handlers of a new process.
    signals = TERMINATION_SIGNALS
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    process = os.fork()
    if process == 0:
        # A process group of its own, as in a shell: a terminal sends Ctrl-C to the whole group.
        os.setpgid(0, 0)
        for number in signals:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        execute(folder, writing, environment, run_command)
    with suppress(OSError):
        # Parent and child both set the group, since either may run first.
        os.setpgid(process, process)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    os.close(writing)
    return process, reading


def execute(folder: Path, writing: int, environment: dict[str, str], run_command: Callable[[], None]) -> NoReturn:
    """Turn the child of a fork into the command."""
    code = 70
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(writing, 1)
        os.dup2(writing, 2)
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
