"""What a command line prints: text that is shown and not obeyed, progress, and a word now and then in long work."""

from __future__ import annotations

import io
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import IO, Any, ClassVar

from rig.escaping import shown

# After so long without a word a command says that it is still at work, s.
SILENCE = 12.0
# What holds a command up again so soon is the same matter, s.
_AT_ONCE = 5.0


class Unwritable(OSError):
    """Standard output takes nothing: its disk is full."""


class _Shown(io.TextIOBase):
    """A stream on which text from files is shown, not obeyed.

    Parameters
    ----------
    terminal : text stream
        Where the text goes. A progress bar, which has to move the cursor, writes there.
    """

    last = time.monotonic()

    def __init__(self, terminal: IO[str]) -> None:
        self.terminal = terminal

    def write(self, text: str) -> int:
        """Write what can be shown."""
        if not isinstance(text, str):
            # By trying, click finds out whether a stream takes bytes.
            raise TypeError(f"text is written here, not {type(text).__name__}")
        _Shown.last = time.monotonic()
        encoding = self.encoding
        self._forward(self.terminal.write, shown(text).encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Write what waits."""
        self._forward(self.terminal.flush)

    def close(self) -> None:
        """Do nothing: the terminal is Python's, and may be closed before this goes, of which 3.13 would complain."""

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
        """Whether somebody looks at it."""
        return self.terminal.isatty()

    def fileno(self) -> int:
        """Give the number of the file below."""
        return self.terminal.fileno()


def take_streams(put_back: ExitStack) -> None:
    """Put our streams in place of Python's; a closed one becomes one that takes everything and keeps nothing."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # Otherwise the next file that is opened, a recording, would get the number that prints go to.
            os.open(os.devnull, os.O_RDWR)
        stream = getattr(sys, name)
        if number > 0:
            put_back.callback(setattr, sys, name, stream)
            setattr(sys, name, _Shown(stream or open(os.devnull, "w", encoding="utf-8")))  # noqa: PTH123, SIM115


class _Work:
    """What a command is doing, None while it waits for its user; and what holds it up even then, and from when to when.

    Function after function is compiled: what follows at once goes on from where that before it began.
    """

    doing: str | None = ""
    held_up: ClassVar[list[str]] = []
    since = until = float("-inf")


def say_now_and_then(put_back: ExitStack) -> None:
    """Say from time to time that a command is at work, until what is put back ends it."""
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
        if doing is not None and time.monotonic() - _Shown.last > SILENCE:
            with suppress(OSError, ValueError):
                doing = doing and f": {doing}"
                print(f"running for {time.monotonic() - since:.0f} s{doing}", file=to, flush=True)


def held_up(doing: str) -> None:
    """Say from time to time what everybody has to wait for, a script that was handed over to as well, until `go_on`."""
    now = time.monotonic()
    if not _Work.held_up and now - _Work.until > _AT_ONCE:
        _Work.since = now
    _Work.held_up.append(doing)


def go_on() -> None:
    """End what `held_up` began."""
    _Work.held_up.pop()
    _Work.until = time.monotonic()


@contextmanager
def waiting() -> Iterator[None]:
    """Say nothing while the body waits for its user."""
    before, _Work.doing = _Work.doing, None
    try:
        yield
    finally:
        _Work.doing = before


@contextmanager
def handed_over() -> Iterator[None]:
    """Give the terminal to a program of the user's, which may write on it what it likes."""
    ours = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (getattr(stream, "terminal", stream) for stream in ours)
    try:
        with waiting():
            yield
    finally:
        sys.stdout, sys.stderr = ours


@contextmanager
def progress(title: str) -> Iterator[Callable[[float, str], None]]:
    """Show how far the body is: ``report(fraction, message)``.

    A terminal shows a bar with the time left; other error outputs get a line now and then.
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
    with waiting(), Progress(*columns, console=Console(file=terminal), transient=True) as bar:
        task = bar.add_task(escape(shown(title)), total=1.0, message="")

        def move(fraction: float, message: str = "") -> None:
            bar.update(task, completed=fraction, message=escape(shown(message)))

        yield move


@contextmanager
def goes_on(kept: bool = True) -> Iterator[None]:
    """Add to an interruption of the body that the same command goes on where it stopped, if results are kept."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        if kept:
            interruption.add_note("what was computed is kept: the same command goes on where it stopped")
        raise


@contextmanager
def counting(title: str) -> Iterator[Callable[[int, int], None]]:
    """Show how many pieces of work are done: ``report(done, total)``."""
    with progress(title) as report:

        def count(done: int, total: int) -> None:
            # After the last piece come figures and files.
            report(done / total if total else 1.0, f"{done} of {total}{', writing' if done >= total else ''}")

        yield count


@contextmanager
def saying() -> Iterator[Callable[[str], None]]:
    """Show what the body is doing: ``report(message)``."""
    with progress("") as report:
        yield lambda message: report(0.0, message)
