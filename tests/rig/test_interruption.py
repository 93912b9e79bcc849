"""A command that is interrupted while it is imported ends, and says nothing or a word."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

# As pip's scripts begin, with Ctrl-C when a module is looked for.
COMMAND = """
import os, sys
program, moment = sys.argv[1:]
class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == moment:
            os.kill(os.getpid(), 2)
sys.meta_path.insert(0, CtrlC())
sys.argv = ["/usr/bin/" + program, "--help"]
if program == "rig":
    from rig.__main__ import main
elif program == "daq":
    from daq.__main__ import main
else:
    from analysis.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize("program", ["rig", "daq", "analysis"])
@pytest.mark.parametrize("moment", ["rig.interruption", "signal", "lazy_loader", "rig.command_line", "typer"])
def test_given_ctrl_c_at_an_import_when_a_command_begins_then_it_ends_without_a_traceback(program, moment):
    # -S: nothing else has imported `signal` or `lazy_loader` before; so the path is handed over.
    begin = f"import sys; sys.path[:] = {sys.path!r}\n"
    words = [sys.executable, "-S", "-c", begin + COMMAND, program, moment]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode in (130, -signal.SIGINT)
    assert done.stderr in ("", "interrupted\n") and not done.stdout


def test_given_a_script_when_it_imports_the_packages_then_it_answers_ctrl_c_as_before():
    script = "import signal, rig, daq, analysis; print(signal.getsignal(signal.SIGINT).__name__)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "default_int_handler\n"
