"""A command that is interrupted during its imports ends with at most a short message."""

import subprocess
import sys

import pytest

from rig.core.base.ending_signals import TERMINATION_SIGNALS

# Like the script that pip installs, but it sends itself a signal at the import of a module.
COMMAND = """
import os, sys
program, module, number = sys.argv[1:]
class SignalAtImport:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            os.kill(os.getpid(), int(number))
sys.meta_path.insert(0, SignalAtImport())
sys.argv = ["/usr/bin/" + program, "--help"]
if program == "rig":
    from rig.__main__ import main
elif program == "daq":
    from daq.__main__ import main
else:
    from analysis.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize("number", TERMINATION_SIGNALS)
@pytest.mark.parametrize("program", ["rig", "daq", "analysis"])
@pytest.mark.parametrize(
    "module", ["rig.core.base.interruption", "signal", "lazy_loader", "rig.commands.command_line", "typer"]
)
def test_signal_at_import_ends_without_traceback(program, module, number):
    # With -S, `signal` and `lazy_loader` are not yet imported; the module search path must be set.
    prepare = f"import sys; sys.path[:] = {sys.path!r}\n"
    arguments = [sys.executable, "-S", "-c", prepare + COMMAND, program, module, str(int(number))]
    completed = subprocess.run(arguments, capture_output=True, text=True, check=False)
    # A shell reports 128 plus the number of the signal that ended a process.
    assert completed.returncode in (128 + number, -number)
    assert completed.stderr in ("", "interrupted\n") and not completed.stdout


def test_script_keeps_its_ctrl_c_handler():
    script = "import signal, rig, daq, analysis; print(signal.getsignal(signal.SIGINT).__name__)"
    completed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert completed.stdout == "default_int_handler\n"
