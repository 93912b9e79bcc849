"""Console output of the commands: escaped text, progress, and status messages during long work."""

from __future__ import annotations

import io
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any, ClassVar

from rig.escaping import escape_terminal

# Time without output after which a command reports that it is still running, s.
MAX_SILENCE_S = 12.0
# Delays separated by less than this, s, count as one delay.
_AT_ONCE = 5.0


class Unwritable(OSError):
    """Standard output cannot be written because its disk is full."""


class _Shown(io.TextIOBase):
    """A stream that escapes control characters of text; a progress bar writes to `terminal` directly."""

    last = time.monotonic()

    def __init__(self, terminal: IO[str]) -> None:
        self.terminal = terminal

    def write(self, text: str) -> int:
        """Write text with control characters escaped."""
        if not isinstance(text, str):
            # click tests by a write whether a stream accepts bytes.
            raise TypeError(f"text is written here, not {type(text).__name__}")
        _Shown.last = time.monotonic()
        encoding = self.encoding
        self._forward(
            self.terminal.write, escape_terminal(text).encode(encoding, "backslashreplace").decode(encoding)
        )
        return len(text)

    def flush(self) -> None:
        """Flush the terminal."""
        self._forward(self.terminal.flush)

    def close(self) -> None:
        """Do nothing: Python owns the terminal and may close it first, which is an error in Python 3.13."""

    def _forward(self, act: Callable[..., object], *given: str) -> None:
        try:
            act(*given)
        except BrokenPipeError:
            raise
        except OSError as error:
            raise Unwritable(error.errno, error.strerror) from None

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Encoding of the terminal."""
        return getattr(self.terminal, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        """Whether the stream is a terminal."""
        return self.terminal.isatty()

    def fileno(self) -> int:
        """Return the file descriptor of the terminal."""
        return self.terminal.fileno()


def replace_streams(put_back: ExitStack) -> None:
    """Replace the standard streams of Python; a closed stream is replaced by a null device."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # Otherwise the next opened file, such as a recording, would get the descriptor of standard output.
            os.open(os.devnull, os.O_RDWR)
        stream = getattr(sys, name)
        if number > 0:
            put_back.callback(setattr, sys, name, stream)
            setattr(sys, name, _Shown(stream or open(os.devnull, "w", encoding="utf-8")))  # noqa: PTH123, SIM115


class _Work:
    """Current activity of a command, None while it waits for input; and the current delay with its start and end."""

    doing: str | None = ""
    held_up: ClassVar[list[str]] = []
    since = until = float("-inf")


def report_activity(put_back: ExitStack) -> None:
    """Report from time to time that a command is running, until the exit stack is closed."""
    over = threading.Event()
    put_back.callback(over.set)
    _Work.doing = ""
    threading.Thread(target=_speak, args=(over, sys.stderr), name="words", daemon=True).start()


def _speak(over: threading.Event, to: Any) -> None:
    start = time.monotonic()
    _Shown.last = start
    while not over.wait(1.0):
        holding = next(iter(_Work.held_up), None)
        since, doing = (start, _Work.doing) if holding is None else (_Work.since, holding)
        if doing is not None and time.monotonic() - _Shown.last > MAX_SILENCE_S:
            with suppress(OSError, ValueError):
                doing = doing and f": {doing}"
                print(f"running for {time.monotonic() - since:.0f} s{doing}", file=to, flush=True)


def report_written(*files: Path) -> None:
    """Print the names of the files that a command wrote, one a line."""
    for file in files:
        print(f"wrote {file}")


def held_up(doing: str) -> None:
    """Report a delay from time to time until `go_on`, also while a user program runs."""
    now = time.monotonic()
    if not _Work.held_up and now - _Work.until > _AT_ONCE:
        _Work.since = now
    _Work.held_up.append(doing)


def go_on() -> None:
    """End the delay that `held_up` began."""
    _Work.held_up.pop()
    _Work.until = time.monotonic()


@contextmanager
def pause_reports() -> Iterator[None]:
    """Suppress reports while the body waits for user input."""
    before, _Work.doing = _Work.doing, None
    try:
        yield
    finally:
        _Work.doing = before


@contextmanager
def user_terminal() -> Iterator[None]:
    """Release the terminal to a program of the user, whose output is not escaped."""
    ours = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (getattr(stream, "terminal", stream) for stream in ours)
    try:
        with pause_reports():
            yield
    finally:
        sys.stdout, sys.stderr = ours


@contextmanager
def progress(title: str) -> Iterator[Callable[[float, str], None]]:
    """Show the progress of the body: ``report(fraction, message)``.

    A terminal shows a bar with the remaining time; other error outputs get a line at intervals.
    """
    if not sys.stderr.isatty():

        def report(fraction: float, message: str = "") -> None:
            parts = (title, title and f"{100 * fraction:.0f} %", message)
            _Work.doing = ", ".join(filter(None, parts))

        yield report
        _Work.doing = ""
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[message]}"),
    )
    terminal = getattr(sys.stderr, "terminal", sys.stderr)
    with pause_reports(), Progress(*columns, console=Console(file=terminal), transient=True) as bar:
        task = bar.add_task(escape(escape_terminal(title)), total=1.0, message="")

        def move(fraction: float, message: str = "") -> None:
            bar.update(task, completed=fraction, message=escape(escape_terminal(message)))

        yield move


@contextmanager
def resumable(kept: bool = True) -> Iterator[None]:
    """Add to an interrupt message that the same command continues the work, if results are stored."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        if kept:
            interruption.add_note("completed results are stored: the same command continues from there")
        raise


@contextmanager
def count_progress(title: str) -> Iterator[Callable[[int, int], None]]:
    """Show the number of finished pieces: ``report(done, total)``."""
    with progress(title) as report:

        def count(done: int, total: int) -> None:
            # Figures and files are written after the last piece.
            report(done / total if total else 1.0, f"{done} of {total}{', writing' if done >= total else ''}")

        yield count


@contextmanager
def show_activity() -> Iterator[Callable[[str], None]]:
    """Show the activity of the body: ``report(message)``."""
    with progress("") as report:
        yield lambda message: report(0.0, message)
