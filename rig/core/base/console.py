"""Console output of the commands: escaped text and progress."""

from __future__ import annotations

import io
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING

from rig.core.base.escaping import escape_terminal
from rig.core.base.progress import CountProgress, FractionProgress

if TYPE_CHECKING:
    from rich.progress import Progress

_LOG = logging.getLogger("shotrig.compiling")
# Without a terminal, progress is reported in lines at this interval.
REPORT_INTERVAL_S = 12.0
# Progress bars on the terminal, which are suspended during a question.
_bars: list[Progress] = []


@cache
def warn_of_compilation(text: str) -> None:
    """Log a warning about machine code, once in a process."""
    _LOG.warning(text)


class Unwritable(OSError):
    """Standard output cannot be written because its disk is full."""


class _EscapingStream(io.TextIOBase):
    """A stream that escapes control characters of text; a progress bar writes to `unescaped` directly."""

    def __init__(self, unescaped: IO[str]) -> None:
        self.unescaped = unescaped

    def write(self, text: str) -> int:
        """Write text with control characters escaped."""
        if not isinstance(text, str):
            # click writes bytes to test whether a stream accepts them.
            raise TypeError(f"this stream accepts text, not {type(text).__name__}")
        encoding = self.encoding
        self._forward(self.unescaped.write, escape_terminal(text).encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        self._forward(self.unescaped.flush)

    def close(self) -> None:
        """Do nothing: Python owns the unescaped stream, and closing it twice is an error in Python 3.13."""

    def _forward(self, operation: Callable[..., object], *arguments: str) -> None:
        """Call an operation of the unescaped stream; a full disk raises `Unwritable`."""
        try:
            operation(*arguments)
        except BrokenPipeError:
            raise
        except OSError as error:
            raise Unwritable(error.errno, error.strerror) from None

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self.unescaped, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        return self.unescaped.isatty()

    def fileno(self) -> int:
        return self.unescaped.fileno()


def replace_streams(cleanup: ExitStack) -> None:
    """Replace the standard streams of Python; a closed stream is replaced with a null device."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # Otherwise the next opened file, such as a recording, would get the descriptor of standard output.
            os.open(os.devnull, os.O_RDWR)
        stream = getattr(sys, name)
        if number > 0:
            cleanup.callback(setattr, sys, name, stream)
            setattr(sys, name, _EscapingStream(stream or open(os.devnull, "w", encoding="utf-8")))  # noqa: PTH123, SIM115


def report_written(*files: Path) -> None:
    """Print the names of the files that a command wrote, one per line."""
    for file in files:
        print(f"wrote {file}")


def ask_to_replace(files: Sequence[Path]) -> bool:
    """Ask on the terminal whether existing files may be replaced; without a terminal, they may not."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    for bar in _bars:
        bar.stop()
    verb, pronoun = ("exists", "it") if len(files) == 1 else ("exist", "them")
    print(f"{', '.join(map(str, files))} {verb}. Replace {pronoun}? [y/N]", end=" ", file=sys.stderr, flush=True)
    answer = sys.stdin.readline().strip().lower()
    for bar in _bars:
        bar.start()
    return answer in {"y", "yes"}


@contextmanager
def user_terminal() -> Iterator[None]:
    """Release the terminal to a program of the user, whose output is not escaped."""
    escaping_streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (getattr(stream, "unescaped", stream) for stream in escaping_streams)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = escaping_streams


@contextmanager
def progress(title: str) -> Iterator[FractionProgress]:
    """Show the progress of the `with` block, which calls ``report(fraction, message)``.

    A terminal shows a bar with the remaining time; if standard error is not a terminal, a line is printed at intervals.
    """
    if not sys.stderr.isatty():
        reported_s = time.monotonic()

        def report(fraction: float, message: str = "") -> None:
            nonlocal reported_s
            if time.monotonic() - reported_s >= REPORT_INTERVAL_S:
                reported_s = time.monotonic()
                parts = (title, title and f"{100 * fraction:.0f} %", message)
                print(", ".join(filter(None, parts)), file=sys.stderr, flush=True)

        yield report
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
    terminal = getattr(sys.stderr, "unescaped", sys.stderr)
    with Progress(*columns, console=Console(file=terminal), transient=True) as bar:
        _bars.append(bar)
        task = bar.add_task(escape(escape_terminal(title)), total=1.0, message="")

        def update_bar(fraction: float, message: str = "") -> None:
            bar.update(task, completed=fraction, message=escape(escape_terminal(message)))

        try:
            yield update_bar
        finally:
            _bars.remove(bar)


@contextmanager
def resumable(stored: bool = True) -> Iterator[None]:
    """Add to an interrupt message that the same command continues the work, if results are stored."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        if stored:
            interruption.add_note("completed results are stored. To continue from them, give the same command again.")
        raise


@contextmanager
def count_progress(title: str) -> Iterator[CountProgress]:
    """Show the number of completed steps of the `with` block, which calls ``report(n_completed, total)``."""
    with progress(title) as report:

        def count(n_completed: int, total: int) -> None:
            # Figures and files are written after the last step.
            report(
                n_completed / total if total else 1.0,
                f"{n_completed} of {total}{', writing' if n_completed >= total else ''}",
            )

        yield count


@contextmanager
def show_activity() -> Iterator[Callable[[str], None]]:
    """Show the current activity of the `with` block, which calls ``report(message)``."""
    with progress("") as report:
        yield lambda message: report(0.0, message)
