"""A command line run in a child of its own and watched: how it ended, what it said, when, and what it took."""

from __future__ import annotations

import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

# Without a word for this long, a command counts as hanging; and so long it may take at all, s.
SILENCE, LONGEST = 20.0, 60.0
# What no command may take, bytes.
MEMORY = 1 << 30


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes
    ----------
    command : tuple of str
        Its words.
    code : int
        Exit code; negative: the signal that ended it.
    output : str
        What it wrote to both streams.
    silence : float
        Longest time without a word, s.
    seconds : float
        Time from start to end.
    memory : int
        Most resident memory, bytes.
    """

    command: tuple[str, ...]
    code: int
    output: str
    silence: float
    seconds: float
    memory: int

    @property
    def faults(self) -> list[str]:
        """What it should not have done."""
        found = []
        if "Traceback (most recent call last)" in self.output or "Exception ignored" in self.output:
            found.append("traceback")
        if "this is a fault of shotrig" in self.output:
            found.append("unexpected")
        if self.silence > SILENCE:
            found.append("silence")
        if self.memory > MEMORY:
            found.append("memory")
        # Whoever still tells how far it is after so long was stopped here, and is not at fault.
        if self.code not in (0, 1, 2, 130, 143) and self.seconds < LONGEST:
            found.append(f"exit code {self.code}")
        if any(ord(letter) < 32 and letter not in "\n\t\r" for letter in self.output):
            found.append("control character")
        return found


def run(
    words: Sequence[str],
    folder: Path,
    end: Callable[[int, float], None] | None = None,
    environment: dict[str, str] | None = None,
    prepare: Callable[[], None] | None = None,
    longest: float = LONGEST,
) -> Ended:
    """Run `rig`, `daq` or `analysis` in a fork of this process, which has imported them already.

    Parameters
    ----------
    words : sequence of str
        The command.
    folder : Path
        Where it runs.
    end : callable, optional
        ``end(process, seconds)``, called again and again while it runs: whoever wants to kill it.
    environment : dict, optional
        Variables to set.
    prepare : callable, optional
        Called in the child before the command.
    longest : float
        Time after which it is killed, s.
    """
    reading, writing = os.pipe()
    started = time.monotonic()
    process = os.fork()
    if process == 0:
        _become(words, folder, writing, environment or {}, prepare)
    os.close(writing)
    heard, last, silence, said = bytearray(), started, 0.0, True
    while said:
        ready, _, _ = select.select([reading], [], [], 0.005 if end is not None else 0.2)
        now = time.monotonic()
        if ready:
            part = os.read(reading, 1 << 16)
            heard += part
            said = bool(part)
            silence, last = max(silence, now - last), now
        if end is not None:
            end(process, now - started)
        if now - started > longest:
            os.kill(process, signal.SIGKILL)
            break
    silence = max(silence, time.monotonic() - last)
    _, status, used = os.wait4(process, 0)
    os.close(reading)
    return Ended(
        tuple(words),
        os.waitstatus_to_exitcode(status),
        heard.decode(errors="replace"),
        silence,
        time.monotonic() - started,
        used.ru_maxrss * 1024,
    )


def _become(
    words: Sequence[str],
    folder: Path,
    writing: int,
    environment: dict[str, str],
    prepare: Callable[[], None] | None,
) -> None:
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
        resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
        if prepare is not None:
            prepare()
        sys.argv = list(words)
        from importlib import import_module

        code = 0
        import_module(f"{words[0]}.cli").main()
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
