"""Whatever happens in a command, it ends in words and with its exit code."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import pytest
import typer

from rig import console
from rig.command_line import application, run
from rig.ending_signals import ENDINGS
from rig.errors import RunError, SceneError

MODULE = "rig.command_for_the_tests"


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Callable[[], object]], int]]:
    """Run a function as a command in this process; give the exit code."""
    monkeypatch.setattr(sys, "argv", ["rig", "act"])
    streams = sys.stdout, sys.stderr

    def carry_out(act: Callable[[], object]) -> int:
        app = application("For the tests.")
        app.command("act")(act)
        app.command("other")(lambda: None)
        module = types.ModuleType(MODULE)
        module.app = app  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, MODULE, module)
        with pytest.raises(SystemExit) as end:
            run(MODULE)
        return int(end.value.code or 0)

    yield carry_out
    assert (sys.stdout, sys.stderr) == streams


def raising(error: BaseException) -> Callable[[], object]:
    def act() -> object:
        raise error

    return act


def caused(error: Exception, cause: BaseException) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (SceneError("no such body"), 2, "error: no such body"),
        (RunError("the disk is full"), 1, "error: the disk is full"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (caused(RuntimeError("Error calling __set_name__"), KeyboardInterrupt()), 130, "interrupted"),
        (caused(ImportError("initialization failed"), KeyboardInterrupt()), 130, "interrupted"),
        (caused(TypeError(), caused(ImportError(), KeyboardInterrupt())), 130, "interrupted"),
        (caused(RunError("the disk is full"), KeyboardInterrupt()), 1, "error: the disk is full"),
        (MemoryError(), 1, "not enough memory"),
        (PermissionError(13, "Permission denied", "run.mcap"), 1, "error: run.mcap: Permission denied"),
        (BrokenPipeError(), 0, ""),
        (SystemExit(7), 7, ""),
    ],
)
def test_given_an_error_when_a_command_ends_in_it_then_it_says_so_in_a_line(
    command, capsys, error, code, said
):
    assert command(raising(error)) == code
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == bool(said) and "Traceback" not in told


def test_given_an_interrupt_with_a_note_when_a_command_ends_in_it_then_the_note_is_told(
    command, capsys
) -> None:
    interrupt = KeyboardInterrupt()
    interrupt.add_note("run.npz.kept holds the rest")
    assert command(raising(interrupt)) == 130
    assert capsys.readouterr().err == "interrupted\nrun.npz.kept holds the rest\n"


def test_interrupted_study_says_that_it_goes_on() -> None:
    with pytest.raises(KeyboardInterrupt) as kept, console.goes_on():
        raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt) as lost, console.goes_on(kept=False):
        raise KeyboardInterrupt
    assert "goes on where it stopped" in kept.value.__notes__[0] and not hasattr(lost.value, "__notes__")


def test_given_a_module_that_makes_an_interrupt_a_failure_of_its_own_when_loaded_then_the_command_is_interrupted(
    command, capsys
):
    def act() -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise ImportError("numba._devicearray failed to import")

    assert command(act) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_given_an_unexpected_error_when_a_command_ends_in_it_then_a_file_has_the_details(
    command, capsys, monkeypatch, tmp_path
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert command(raising(ZeroDivisionError("by \x1b[31m zero"))) == 1
    told = capsys.readouterr().err
    (details,) = tmp_path.iterdir()
    assert (
        "ZeroDivisionError" in told
        and str(details) in told
        and "\x1b" not in told
        and "Traceback" not in told
    )
    assert "Traceback" in details.read_text(encoding="utf-8") and "'act'" in details.read_text(
        encoding="utf-8"
    )


@pytest.mark.parametrize("words", ["--at nan", "--at=-inf", "--each 1 --each 1e300"])
def test_given_an_option_that_nothing_can_measure_when_a_command_gets_it_then_it_is_refused_by_name(
    command, capsys, monkeypatch, words
):
    def act(at: float = 0.0, each: list[float] = []) -> None:  # noqa: B006
        raise AssertionError("not reached")

    monkeypatch.setattr(sys, "argv", ["rig", "act", *words.split()])
    assert command(act) == 2
    told = capsys.readouterr().err
    assert words[:4] in told and "expected a number, at most 1e+12" in told


@pytest.mark.parametrize("words", [["--name", ""], ["--each", "x", "--each", " "], [""]])
def test_given_an_option_that_is_empty_when_a_command_gets_it_then_it_is_refused(
    command, capsys, monkeypatch, words
):
    def act(what: Annotated[str, typer.Argument()] = "x", name: str = "x", each: list[str] = []) -> None:  # noqa: B006
        raise AssertionError("not reached")

    monkeypatch.setattr(sys, "argv", ["rig", "act", *words])
    assert command(act) == 2
    assert "expected something" in capsys.readouterr().err


def test_given_text_of_a_file_when_printed_then_what_a_terminal_would_obey_is_shown(command, capsys):
    assert command(lambda: print("red\x1b[31m\udcff \u202e")) == 0
    assert capsys.readouterr().out == "red\\x1b[31m\\udcff \\u202e\n"


@pytest.mark.parametrize("ending", ENDINGS)
def test_signal_to_end_gives_its_exit_code(command, capsys, ending):
    assert command(lambda: os.kill(os.getpid(), ending)) == 128 + ending
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="the system knows no such signal")
def test_given_a_command_that_is_to_outlive_its_terminal_when_that_is_closed_then_it_goes_on(command):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert command(lambda: os.kill(os.getpid(), signal.SIGHUP)) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_given_a_disk_that_fails_while_a_file_is_closed_when_at_work_then_it_is_said(command, capsys):
    def fail() -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    assert command(fail) == 1
    assert capsys.readouterr().err == "error: the system reports: Disk quota exceeded\n"


def test_given_a_signal_while_a_command_puts_things_back_when_it_has_done_its_work_then_no_traceback_is_seen():
    late = """
import signal, sys
from rig import command_line, console
usual = console.say_now_and_then
def say_now_and_then(put_back):
    put_back.callback(signal.raise_signal, signal.SIGINT)
    usual(put_back)
console.say_now_and_then = say_now_and_then
sys.argv = ["rig", "scenes"]
command_line.run("rig.cli")
"""
    done = subprocess.run([sys.executable, "-c", late], capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGINT and not done.stderr


def test_given_long_silence_when_at_work_then_it_says_so(command, capsys, monkeypatch):
    monkeypatch.setattr(console, "SILENCE", -1.0)
    told = []

    def wait_for_a_word() -> None:
        with console.progress("a long test") as tell:
            tell(0.5, "20 Hz")
            while "running for" not in "".join(told):
                told.append(capsys.readouterr().err)

    assert command(wait_for_a_word) == 0
    assert "a long test, 50 %, 20 Hz" in "".join(told)


def test_given_a_compilation_when_a_script_has_the_terminal_then_it_is_said_until_it_is_over(
    command, capsys, monkeypatch
):
    from numba.core.event import trigger_event

    import rig.numerics.jit  # noqa: F401 - listens

    monkeypatch.setattr(console, "SILENCE", -1.0)
    told = []

    def wait_for_a_word() -> None:
        with console.handed_over(), suppress(ValueError), trigger_event("numba:compile"):
            while "s: compiling machine code" not in "".join(told):
                told.append(capsys.readouterr().err)
            raise ValueError

    assert command(wait_for_a_word) == 0
    assert "once" in "".join(told) and not console._Work.held_up


def outcome(code: str, **how: object) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "rig", *code.split()], stderr=subprocess.PIPE, text=True, **how
    )  # type: ignore[call-overload]
    return done.returncode, done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_given_a_full_disk_when_printing_then_the_command_fails_in_words() -> None:
    with Path("/dev/full").open("w") as full:
        code, told = outcome("schema", stdout=full)
    assert code == 1 and "standard output cannot be written: No space left on device" in told


def test_given_a_folder_that_is_gone_when_a_command_runs_in_it_then_it_says_so(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    code, told = outcome("scenes", stdout=subprocess.DEVNULL, cwd=gone, preexec_fn=gone.rmdir)
    assert code == 1 and "the working folder is not there any more" in told


def test_given_help_or_version_when_asked_for_then_it_is_plain_text(command, capsys, monkeypatch) -> None:
    for word, said in (("--help", "Usage: rig"), ("--version", "shotrig ")):
        monkeypatch.setattr(sys, "argv", ["rig", word])
        assert command(lambda: None) == 0
        assert capsys.readouterr().out.startswith(said)
