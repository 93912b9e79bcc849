"""What the command lines of the three packages share: one way in, and one way out whatever happens.

No command ends in a traceback, or is silent for long. What a user can mend is an error with words of its own
(`rig.errors`); what nobody has thought of ends in a short message and a file with the details.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import IO, TYPE_CHECKING, Any, NoReturn

from rig.errors import RunError, ShotrigError
from rig.escaping import shown

if TYPE_CHECKING:
    import typer

# After so long without a word a command says that it is still at work, s.
SILENCE = 12.0
# What may end a command: Ctrl-C, and what a machine that goes down sends.
ENDINGS = (signal.SIGINT, signal.SIGTERM)


def application(help_text: str) -> typer.Typer:
    """Make a command-line application in the style of the project."""
    import typer

    app = typer.Typer(
        help=f"{help_text} With --debug before the command an unexpected error shows where it comes from.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    def tell_version(asked: bool) -> None:
        if asked:
            print(f"shotrig {version('shotrig')}")
            raise typer.Exit

    told = typer.Option(
        False, "--version", callback=tell_version, is_eager=True, help="Say which version it is."
    )

    @app.callback()
    def common(version: bool = told) -> None:
        pass

    return app


def run(module: str) -> NoReturn:
    """Run the command line `app` of a module and end the process.

    Parameters
    ----------
    module : str
        Imported here, so that even an interrupted import ends in words.
    """
    words = sys.argv[1:]
    debug = words[:1] == ["--debug"]
    with ExitStack() as put_back:
        try:
            _answer_signals(put_back)
            _take_streams(put_back)
            _take_hooks(put_back)
            code = _carry_out(module, words[debug:])
            sys.stdout.flush()
        except BaseException as error:
            # From here on another signal ends the process at once.
            _set_signals(signal.SIG_DFL)
            code = _tell(error, debug)
    sys.exit(code)


def _carry_out(module: str, words: Sequence[str]) -> int:
    """Run a command and give its exit code; what goes wrong is raised."""
    import typer

    try:
        Path.cwd()
    except OSError:
        raise RunError("the working folder is not there any more; change to another one") from None
    command, program = typer.main.get_command(import_module(module).app), module.partition(".")[0]
    if f"_{program.upper()}_COMPLETE" in os.environ:
        # The shell asks for words that complete what has been typed.
        command.main([], program)
    try:
        with command.make_context(program, list(words)) as context:
            command.invoke(context)
    except typer.Exit as end:
        return end.exit_code
    return 0


def _tell(error: BaseException, debug: bool) -> int:
    """Say why a command ended, and give its exit code."""
    code, text = _in_words(error)
    with suppress(OSError):
        if debug and not isinstance(error, SystemExit):
            import traceback

            traceback.print_exception(error)
        if text:
            print(text, file=sys.stderr, flush=True)
    try:
        sys.stdout.flush()
    except OSError:
        # What Python would flush at its end has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return code


def _in_words(error: BaseException) -> tuple[int, str]:
    """Give the exit code and the message for what ended a command."""
    match error:
        case SystemExit(code=int() | None):
            return int(error.code or 0), ""
        # Python 3.11 wraps what interrupts it while it makes a class, as in an import.
        case KeyboardInterrupt() | RuntimeError(__cause__=KeyboardInterrupt()):
            return 130, "interrupted"
        case ShotrigError():
            notes = getattr(error, "__notes__", ())
            return error.exit_code, "\n".join(f"error: {text}" for text in (error, *notes))
        case BrokenPipeError():
            # The reader of a pipe (head, less) has left, which is its right.
            return 0, ""
        case _Unwritable():
            return 1, f"error: standard output cannot be written: {error.strerror}"
        case MemoryError():
            return 1, f"error: there is not enough memory for this: {error or 'none is left'}"
        case OSError(filename=str() | bytes()):
            return 1, f"error: {os.fsdecode(error.filename)}: {error.strerror}"
    if hasattr(error, "format_message"):
        # typer found something wrong with the words of the command.
        if type(error).__name__ == "NoArgsIsHelpError":
            return 2, error.format_message()
        context = getattr(error, "ctx", None)
        usage = "" if context is None else f"{context.get_usage()}\n"
        return 2, f"{usage}error: {error.format_message()}"
    return 1, _unexpected(error)


def _unexpected(error: BaseException) -> str:
    """Describe an error that nobody has thought of, and keep what is needed to find its cause."""
    import platform
    import tempfile
    import traceback

    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    begin = f"error: something unexpected happened ({what[:300]}); this is a fault of shotrig"
    details = "\n".join(
        [
            f"shotrig {version('shotrig')}, Python {platform.python_version()}, {platform.platform()}",
            f"command: {sys.argv}",
            "".join(traceback.format_exception(error)),
        ]
    )
    try:
        number, name = tempfile.mkstemp(prefix="shotrig-error-", suffix=".txt")
        with open(number, "w", encoding="utf-8", errors="backslashreplace") as file:  # noqa: PTH123
            file.write(details)
    except OSError:
        return f"{begin}: please report it, with what the command says with --debug before its first word"
    return f"{begin}: please report it, with the details in {name}"


# -- signals ---------------------------------------------------------------------------------------------


def _answer_signals(put_back: ExitStack) -> None:
    """Let what ends a process end it as Ctrl-C does, so that files are closed."""
    for number in ENDINGS:
        before = signal.getsignal(number)
        # Whoever started the process may want it to go on (nohup).
        if before is not signal.SIG_IGN:
            put_back.callback(signal.signal, number, before)
            signal.signal(number, _interrupt)


def _set_signals(answer: Any) -> None:
    for number in ENDINGS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, answer)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


# -- what is said ----------------------------------------------------------------------------------------


class _Unwritable(OSError):
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
            raise _Unwritable(error.errno, error.strerror) from None

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


def _take_streams(put_back: ExitStack) -> None:
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


def _take_hooks(put_back: ExitStack) -> None:
    """Say in a line what Python would say in a traceback; say now and then that work goes on."""
    for module, name, ours in (
        (warnings, "showwarning", _warn),
        (sys, "unraisablehook", _passed_over),
        (threading, "excepthook", _thread_failed),
    ):
        put_back.callback(setattr, module, name, getattr(module, name))
        setattr(module, name, ours)
    import logging

    log = logging.getLogger("shotrig")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    log.addHandler(handler)
    put_back.callback(log.removeHandler, handler)
    put_back.callback(log.setLevel, log.level)
    log.setLevel(logging.INFO)
    over = threading.Event()
    put_back.callback(over.set)
    _Work.doing = ""
    threading.Thread(target=_say_now_and_then, args=(over, sys.stderr), name="words", daemon=True).start()


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"warning: {message}", file=sys.stderr)


def _passed_over(what: sys.UnraisableHookArgs) -> None:
    """Take an error that came where none can be raised, such as in a destructor."""
    if isinstance(what.exc_value, KeyboardInterrupt):
        # Ctrl-C came at that moment; it is meant for the command.
        threading.Timer(0.01, signal.raise_signal, [signal.SIGINT]).start()
    else:
        print(f"warning: something unexpected was passed over ({what.exc_value!r})", file=sys.stderr)


def _thread_failed(what: threading.ExceptHookArgs) -> None:
    if what.exc_value is not None:
        print(_unexpected(what.exc_value), file=sys.stderr)


class _Work:
    """What a command is doing; None while it waits for its user."""

    doing: str | None = ""


def _say_now_and_then(over: threading.Event, to: Any) -> None:
    start = time.monotonic()
    _Shown.last = start
    while not over.wait(1.0):
        if _Work.doing is not None and time.monotonic() - _Shown.last > SILENCE:
            with suppress(OSError, ValueError):
                doing = _Work.doing and f": {_Work.doing}"
                print(f"at work for {time.monotonic() - start:.0f} s{doing}", file=to, flush=True)


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
    """Show how far the body is: ``tell(fraction, message)``.

    A terminal shows a bar with the time left; other error outputs get a line now and then.
    """
    if not sys.stderr.isatty():

        def tell(fraction: float, message: str = "") -> None:
            _Work.doing = f"{title}, {100 * fraction:.0f} %{message and ', '}{message}"

        yield tell
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
def counting(title: str) -> Iterator[Callable[[int, int], None]]:
    """Show how many pieces of work are done: ``tell(done, total)``."""
    with progress(title) as tell:
        yield lambda done, total: tell(done / total if total else 1.0, f"{done} of {total}")


@contextmanager
def saying() -> Iterator[Callable[[str], None]]:
    """Show what the body is doing: ``tell(message)``."""
    with progress("") as tell:
        yield lambda message: tell(0.0, message)
