"""A command that is interrupted during its imports ends with at most a short message."""

from __future__ import annotations

import subprocess
import sys

import pytest

from rig.ending_signals import TERMINATION_SIGNALS

# Like a script of pip, but with a signal at the import of a module.
COMMAND = """
import os, sys
program, moment, number = sys.argv[1:]
class Signal:
    def find_spec(self, name, path=None, target=None):
        if name == moment:
            os.kill(os.getpid(), int(number))
sys.meta_path.insert(0, Signal())
sys.argv = ["/usr/bin/" + program, "--help"]
if program == "rig":
    from rig.__main__ import main
elif program == "daq":
    from daq.__main__ import main
else:
    from analysis.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize("ending", TERMINATION_SIGNALS)
@pytest.mark.parametrize("program", ["rig", "daq", "analysis"])
@pytest.mark.parametrize("moment", ["rig.interruption", "signal", "lazy_loader", "rig.command_line", "typer"])
def test_signal_at_import_ends_without_traceback(program, moment, ending):
    # With -S, `signal` and `lazy_loader` are not yet imported; the module search path must be set.
    begin = f"import sys; sys.path[:] = {sys.path!r}\n"
    words = [sys.executable, "-S", "-c", begin + COMMAND, program, moment, str(int(ending))]
    completed = subprocess.run(words, capture_output=True, text=True, check=False)
    # Shells report a signal that ends a process as 128 and its number.
    assert completed.returncode in (128 + ending, -ending)
    assert completed.stderr in ("", "interrupted\n") and not completed.stdout


def test_script_keeps_its_ctrl_c_handler():
    script = "import signal, rig, daq, analysis; print(signal.getsignal(signal.SIGINT).__name__)"
    completed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert completed.stdout == "default_int_handler\n"
