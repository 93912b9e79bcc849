"""Entry point and error handling shared by the command lines of the three packages.

An error that a user can correct has its own message (`rig.core.base.errors`). An unexpected error shows its traceback.
"""

from __future__ import annotations

import gc
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from rig.core.base import console
from rig.core.base.ending_signals import TERMINATION_SIGNALS, received_signals
from rig.core.base.errors import RunError, ShotrigError, unexpected_text
from rig.core.base.output_files import ask_before_replacing
from rig.extras.grains.ranks import join

if TYPE_CHECKING:
    from rig.commands.command_help import Application

# Limit of numeric options in any unit; a larger number is a typing error.
MAX_OPTION_VALUE = 1e12
# Options whose names differ from those of the Python parameters in messages.
_OPTIONS_OF_PARAMETERS = {"certificates": "--certificate", "uncertain": "--damping-off", "path": "--output"}
# Form in which messages of functions name parameters.
_PARAMETER = re.compile(r"`([a-z_]+)`")
# Options of the running subcommand by the names of the parameters in Python.
_options: dict[str, str] = {}
# Number of allocations between runs of the cyclic garbage collector (Python default 700). An analysis with its imports
# allocates about 220 000 objects; with this limit the collector does not run.
_GC_THRESHOLD = 500_000
# Exit code after Ctrl-C: 128 plus the signal number.
_INTERRUPTED_CODE = 128 + signal.SIGINT


def create_application(help_text: str) -> Application:
    """Create a command-line application in the style of the project."""
    import typer

    from rig.commands.command_help import Application

    app = Application(help=help_text, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)

    def print_version(requested: bool) -> None:
        if requested:
            from importlib.metadata import version

            print(f"shotrig {version('shotrig')}")
            raise typer.Exit

    option = typer.Option(False, "--version", callback=print_version, is_eager=True, help="Print the version.")

    @app.callback()
    def common(version: bool = option) -> None:
        pass

    return app


def run_command(module: str) -> NoReturn:
    """Run the command line `app` of a module and end the process; an interrupted import of the module is reported."""
    # Imported objects are permanent, so they are not scanned for garbage, which would take a tenth of the start-up
    # time.
    gc.set_threshold(_GC_THRESHOLD)
    received_signals.clear()
    with ExitStack() as cleanup:
        try:
            _handle_signals(cleanup)
            console.replace_streams(cleanup)
            _report_warnings(cleanup)
            join()
            ask_before_replacing(console.ask_to_replace)
            code = _execute(module, sys.argv[1:])
            sys.stdout.flush()
            # From here on, also after an error, a signal ends the process immediately.
            _set_termination_handler(signal.SIG_DFL)
        except BaseException as error:
            _set_termination_handler(signal.SIG_DFL)
            code = _report(error)
    gc.freeze()
    sys.exit(128 + received_signals[0] if code == _INTERRUPTED_CODE and received_signals else code)


def _execute(module: str, arguments: Sequence[str]) -> int:
    """Run a command and return its exit code; errors are raised."""
    import typer

    try:
        Path.cwd()
    except OSError:
        raise RunError("the working folder no longer exists. Change to another folder.") from None
    command, program = typer.main.get_command(import_module(module).app), module.partition(".")[0]
    if f"_{program.upper()}_COMPLETE" in os.environ:
        # The shell requests completions of the typed arguments.
        command.main([], program)
    for subcommand in (command, *getattr(command, "commands", {}).values()):
        for option in subcommand.params:
            option.callback = option.callback or _check_option
    _options.clear()
    _options.update(_options_of(command, arguments))
    try:
        with command.make_context(program, list(arguments)) as context:
            command.invoke(context)
    except typer.Exit as end:
        return end.exit_code
    return 0


def _options_of(command: Any, arguments: Sequence[str]) -> dict[str, str]:
    """Return the options of the requested subcommand by the names of the parameters in Python."""
    subcommand = getattr(command, "commands", {}).get(next(iter(arguments), ""))
    if subcommand is None:
        return {}
    # The longest name of an option explains its meaning: --output instead of -o.
    options = {param.name: max(param.opts, key=len) for param in subcommand.params if param.param_type_name == "option"}
    options |= {option[2:].replace("-", "_"): option for option in options.values()}
    return options | {name: option for name, option in _OPTIONS_OF_PARAMETERS.items() if option in options.values()}


def _with_options(message: str) -> str:
    """Replace the parameters that a message of a function names by the options of the running subcommand."""
    return _PARAMETER.sub(lambda found: _options.get(found[1], found[0]), message)


def _check_option(context: Any, option: Any, value: Any) -> Any:
    """Reject an option that is empty, not a number or out of range, before any work."""
    import typer

    for number in value if isinstance(value, list | tuple) else [value]:
        if isinstance(number, str) and not number.strip():
            raise typer.BadParameter(f"got {number!r}; expected a value that is not empty", ctx=context, param=option)
        if isinstance(number, float) and not abs(number) <= MAX_OPTION_VALUE:
            raise typer.BadParameter(
                f"got {number}; expected a number from {-MAX_OPTION_VALUE:g} to {MAX_OPTION_VALUE:g}",
                ctx=context,
                param=option,
            )
    return value


def _report(error: BaseException) -> int:
    """Report why a command ended, and return its exit code."""
    code, text = _describe(error)
    with suppress(OSError):
        if text:
            print(_with_options(text), file=sys.stderr, flush=True)
    try:
        sys.stdout.flush()
    except OSError:
        # Standard output is broken: redirect it, so the flush at exit does not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return code


def _describe(error: BaseException) -> tuple[int, str]:
    """Return the exit code and the message for an exception that ended a command."""
    notes = getattr(error, "__notes__", ())
    match error:
        case SystemExit(code=int() | None):
            return int(error.code or 0), ""
        case KeyboardInterrupt():
            return _INTERRUPTED_CODE, "\n".join(["interrupted", *notes])
        case ShotrigError():
            return error.exit_code, "\n".join(f"error: {text}" for text in (error, *notes))
        case BrokenPipeError():
            # The reader of a pipe (head, less) has closed it; this is not an error.
            return 0, ""
        case console.Unwritable():
            return 1, f"error: standard output cannot be written: {error.strerror}. Redirect it to another disk."
        case MemoryError():
            return 1, f"error: not enough memory: {error or 'none is left'}. Close other programs."
        case OSError(filename=str() | bytes()):
            return 1, f"error: {os.fsdecode(error.filename)}: {error.strerror}. Check this path and its permissions."
        case OSError(strerror=str()):
            # An error of a full or failing disk contains no file name.
            return 1, f"error: the system reports: {error.strerror}. Check the free disk space."
    if hasattr(error, "format_message"):
        # typer rejected the arguments of the command.
        if type(error).__name__ == "NoArgsIsHelpError":
            return 2, error.format_message()
        context = getattr(error, "ctx", None)
        usage, message = "" if context is None else f"{context.get_usage()}\n", error.format_message()
        if re.fullmatch(r"No such command '[^']*'\.", message) and context is not None:
            # No command has a similar name.
            message += f" The commands are {', '.join(sorted(context.command.commands))}."
        return 2, f"{usage}error: {message}"
    # Extension modules may report an interrupt during loading as an unrelated failure.
    if received_signals:
        return _INTERRUPTED_CODE, "interrupted"
    return 1, f"error: {unexpected_text(error)}"


# -- signals ---------------------------------------------------------------------------------------------


def _handle_signals(cleanup: ExitStack) -> None:
    """Handle termination signals as Ctrl-C so that files are closed."""
    for number in TERMINATION_SIGNALS:
        previous = signal.getsignal(number)
        # The parent may have disabled the signal on purpose (nohup).
        if previous is not signal.SIG_IGN:
            cleanup.callback(signal.signal, number, previous)
            signal.signal(number, _interrupt)


def _set_termination_handler(handler: Any) -> None:
    for number in TERMINATION_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    received_signals.append(number)
    raise KeyboardInterrupt


# -- messages --------------------------------------------------------------------------------------------


def _report_warnings(cleanup: ExitStack) -> None:
    """Report warnings and log messages in one line each on stderr; repeat an interrupt that Python cannot raise."""
    for module, name, hook in ((warnings, "showwarning", _warn), (sys, "unraisablehook", _repeat_interrupt)):
        cleanup.callback(setattr, module, name, getattr(module, name))
        setattr(module, name, hook)
    import logging

    # Without a handler, Python prints warnings that other packages log.
    null_handler = logging.NullHandler()
    logging.getLogger().addHandler(null_handler)
    cleanup.callback(logging.getLogger().removeHandler, null_handler)
    log = logging.getLogger("shotrig")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    log.addHandler(handler)
    cleanup.callback(log.removeHandler, handler)
    cleanup.callback(log.setLevel, log.level)
    log.setLevel(logging.INFO)


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"warning: {_with_options(str(message))}", file=sys.stderr)


def _repeat_interrupt(unraisable: sys.UnraisableHookArgs) -> None:
    """Interrupt the command again if Ctrl-C arrived in a destructor, from which Python raises nothing."""
    if not isinstance(unraisable.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    timer = threading.Timer(0.01, _interrupt_again)
    timer.daemon = True
    timer.start()


def _interrupt_again() -> None:
    """Interrupt the command, unless it has ended in the meantime, with its own exit code and message."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_DFL:
        signal.raise_signal(signal.SIGINT)
