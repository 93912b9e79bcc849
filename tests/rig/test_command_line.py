"""Every error in a command leads to a short message and the exit code of its kind."""

import ast
import errno
import os
import re
import signal
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import pytest
import typer

from rig.commands.command_line import create_application, run_command
from rig.core.base import console
from rig.core.base.ending_signals import TERMINATION_SIGNALS
from rig.core.base.errors import RunError, SceneError

# Name of a module that the fixture makes for a command.
MODULE = "rig.command_for_the_tests"


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Callable[[], object]], int]]:
    """Run a function as a command in this process; return the exit code."""
    monkeypatch.setattr(sys, "argv", ["rig", "act"])
    streams = sys.stdout, sys.stderr

    def run_act(act: Callable[[], object]) -> int:
        app = create_application("For the tests.")
        app.command("act")(act)
        app.command("other")(lambda: None)
        module = types.ModuleType(MODULE)
        module.app = app  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, MODULE, module)
        with pytest.raises(SystemExit) as end:
            run_command(MODULE)
        return int(end.value.code or 0)

    yield run_act
    assert (sys.stdout, sys.stderr) == streams


def raise_error(error: BaseException) -> Callable[[], object]:
    """Return a command that raises an error."""

    def act() -> object:
        raise error

    return act


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (SceneError("no such body"), 2, "error: no such body"),
        (RunError("the disk is full"), 1, "error: the disk is full"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError(), 1, "not enough memory"),
        (PermissionError(13, "Permission denied", "run.mcap"), 1, "error: run.mcap: Permission denied"),
        (BrokenPipeError(), 0, ""),
        (SystemExit(7), 7, ""),
    ],
)
def test_error_ends_a_command_with_one_line(command, capsys, error, code, message):
    assert command(raise_error(error)) == code
    reported = capsys.readouterr().err
    assert message in reported and reported.count("\n") == bool(message) and "Traceback" not in reported


def test_interrupt_prints_its_note(command, capsys) -> None:
    interrupt = KeyboardInterrupt()
    interrupt.add_note("run.npz.kept contains the state")
    assert command(raise_error(interrupt)) == 130
    assert capsys.readouterr().err == "interrupted\nrun.npz.kept contains the state\n"


def test_interrupted_study_reports_that_it_can_continue() -> None:
    with pytest.raises(KeyboardInterrupt) as resumable, console.resumable():
        raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt) as final, console.resumable(stored=False):
        raise KeyboardInterrupt
    assert "give the same command again" in resumable.value.__notes__[0] and not hasattr(final.value, "__notes__")


def test_interrupt_hidden_by_import_error_is_reported(command, capsys):
    def act() -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise ImportError("numba._devicearray failed to import")

    assert command(act) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_interrupt_of_a_destructor_interrupts_the_command(command, capsys):
    def act() -> None:
        sys.unraisablehook(SimpleNamespace(exc_value=KeyboardInterrupt()))
        while True:
            pass

    assert command(act) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_interrupt_of_a_destructor_is_not_repeated_after_the_end(command, capsys, monkeypatch):
    timers = []

    class Timer:
        def __init__(self, _: float, function: object) -> None:
            timers.append(function)

        def start(self) -> None:
            pass

    monkeypatch.setattr("threading.Timer", Timer)

    def act() -> None:
        sys.unraisablehook(SimpleNamespace(exc_value=KeyboardInterrupt()))
        raise KeyboardInterrupt

    assert command(act) == 130
    [interrupt_again] = timers
    monkeypatch.setattr(signal, "getsignal", lambda _: signal.SIG_DFL)
    interrupt_again()
    assert capsys.readouterr().err == "interrupted\n"


def test_unexpected_error_shows_its_traceback(command, capsys):
    assert command(raise_error(ZeroDivisionError("by \x1b[31m zero"))) == 1
    reported = capsys.readouterr().err
    assert reported.startswith(
        "error: unexpected error; this is a fault of shotrig. Report it with these lines:\nTraceback"
    )
    assert "ZeroDivisionError: by \\x1b[31m zero" in reported and "\x1b" not in reported


@pytest.mark.parametrize("words", ["--at nan", "--at=-inf", "--each 1 --each 1e300"])
def test_bad_number_of_an_option_is_rejected(command, capsys, monkeypatch, words):
    def act(at: float = 0.0, each: list[float] = []) -> None:  # noqa: B006
        raise AssertionError("not reached")

    monkeypatch.setattr(sys, "argv", ["rig", "act", *words.split()])
    assert command(act) == 2
    reported = capsys.readouterr().err
    option_name = words[:4]
    assert option_name in reported and "expected a number from -1e+12 to 1e+12" in reported


@pytest.mark.parametrize("words", [["--name", ""], ["--each", "x", "--each", " "], [""]])
def test_empty_option_is_rejected(command, capsys, monkeypatch, words):
    def act(what: Annotated[str, typer.Argument()] = "x", name: str = "x", each: list[str] = []) -> None:  # noqa: B006
        raise AssertionError("not reached")

    monkeypatch.setattr(sys, "argv", ["rig", "act", *words])
    assert command(act) == 2
    assert "expected a value that is not empty" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "hint"), [("list", "The commands are act, other."), ("othr", "Did you mean 'other'?")]
)
def test_unknown_command_lists_the_commands(command, capsys, monkeypatch, name, hint):
    monkeypatch.setattr(sys, "argv", ["rig", name])
    assert command(lambda: None) == 2
    assert f"error: No such command '{name}'. {hint}" in capsys.readouterr().err


def test_control_characters_are_escaped_in_a_terminal(command, capsys):
    assert command(lambda: print("red\x1b[31m\udcff \u202e")) == 0
    assert capsys.readouterr().out == "red\\x1b[31m\\udcff \\u202e\n"


@pytest.mark.parametrize("number", TERMINATION_SIGNALS)
def test_termination_signal_determines_the_exit_code(command, capsys, number):
    assert command(lambda: os.kill(os.getpid(), number)) == 128 + number
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="this system has no SIGHUP")
def test_command_continues_after_its_terminal_closes(command):
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert command(lambda: os.kill(os.getpid(), signal.SIGHUP)) == 0
    finally:
        signal.signal(signal.SIGHUP, previous)


def test_disk_failure_on_close_is_reported(command, capsys):
    def fail() -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    assert command(fail) == 1
    assert capsys.readouterr().err == "error: the system reports: Disk quota exceeded. Check the free disk space.\n"


def test_signal_during_cleanup_prints_no_traceback():
    script = """
import signal, sys
from rig.commands import command_line
from rig.core.base import console
original = console.replace_streams
def replace_streams(cleanup):
    cleanup.callback(signal.raise_signal, signal.SIGINT)
    original(cleanup)
console.replace_streams = replace_streams
sys.argv = ["rig", "scenes"]
command_line.run_command("rig.commands.cli")
"""
    completed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert completed.returncode == -signal.SIGINT and not completed.stderr


def test_progress_is_printed_without_a_terminal(command, capsys, monkeypatch):
    monkeypatch.setattr(console, "REPORT_INTERVAL_S", 0.0)

    def work() -> None:
        with console.progress("a long test") as report:
            report(0.5, "20 Hz")

    assert command(work) == 0
    assert capsys.readouterr().err == "a long test, 50 %, 20 Hz\n"


def run_rig(command: str, **options: object) -> tuple[int, str]:
    """Run a command of rig with options of `subprocess.run`; return the exit code and the text on standard error."""
    words = [sys.executable, "-m", "rig", *command.split()]
    completed = subprocess.run(words, stderr=subprocess.PIPE, text=True, **options)  # type: ignore[call-overload]
    return completed.returncode, completed.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has /dev/full")
def test_full_disk_while_printing_is_reported() -> None:
    with Path("/dev/full").open("w") as full_device:
        code, reported = run_rig("schema", stdout=full_device)
    assert code == 1 and "standard output cannot be written: No space left on device" in reported


def test_missing_working_folder_is_reported(tmp_path: Path) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    remove_and_run = "import os, sys; os.rmdir(os.getcwd()); os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    completed = subprocess.run(
        [sys.executable, "-c", remove_and_run, "-m", "rig", "scenes"], cwd=folder, capture_output=True, text=True
    )
    assert completed.returncode == 1 and "the working folder no longer exists" in completed.stderr


def test_help_and_version_are_plain_text(command, capsys, monkeypatch) -> None:
    for word, start in (("--help", "Usage: rig"), ("--version", "shotrig ")):
        monkeypatch.setattr(sys, "argv", ["rig", word])
        assert command(lambda: None) == 0
        assert capsys.readouterr().out.startswith(start)


def test_parameter_in_message_becomes_option(command, capsys):
    def act(from_s: Annotated[float, typer.Option("--from")] = 0.0) -> None:
        raise SceneError("`from_s` 2 s is too late; `channel` and `rig help` are no options")

    assert command(act) == 2
    assert capsys.readouterr().err == "error: --from 2 s is too late; `channel` and `rig help` are no options\n"


# Files of functions whose texts name options of other programs, options before a command, or whole commands.
TEXTS_WITH_COMMANDS = {
    *(
        "workers",
        "changes",
        "choice",
        "summary",
        "check_text",
        "grain_check",
        "overloads",
        "announcement",
        "plugin",
        "page",
    ),
    *("outputs", "rerun_viewer", "bed_claim"),
}


def test_messages_of_functions_name_no_options():
    files = [file for wing in ("core", "extras", "studies") for file in Path().glob(f"*/{wing}/**/*.py")]
    wrong = []
    for file in (file for file in files if file.stem not in TEXTS_WITH_COMMANDS):
        nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
        owners = [node for node in nodes if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)]
        documents = {ast.get_docstring(node, clean=False) for node in owners}
        texts = {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
        wrong += [f"{file}: {text}" for text in texts - documents if re.search(r"(?<![-\w])--[a-z]", text)]
    assert len(files) > 300 and wrong == []
