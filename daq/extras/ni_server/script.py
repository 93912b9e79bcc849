"""Script for NI's client, run with the rig as its hardware: `daq run`."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from daq.extras.ni_device.connecting import connect_scene
from daq.extras.ni_server.bench_time import BenchTime
from daq.extras.ni_server.client_defaults import environment
from daq.extras.ni_server.service import Server
from daq.extras.ni_server.signal_forwarding import forward_signals
from daq.extras.ni_server.starter_script import report_missing_excitation
from rig.core.base.errors import SceneError
from rig.core.scene.scene import Scene

# Exit code of a process after Ctrl-C on Windows.
CTRL_C_EXIT = 0xC000013A


def run_script(
    path: str | Path, arguments: Sequence[str] = (), scene: Scene | str | None = None, clock: str | None = None
) -> int:
    """Run a Python script in a separate process, with the rig as its hardware.

    Parameters
    ----------
    path : str or Path
        The script.
    arguments : sequence of str
        Arguments in `sys.argv` after the name of the script.
    scene : Scene or str, optional
        Scene on the bench, see `daq.connect`.
    clock : str, optional
        Clock, see `daq.connect`. With the fast clock, `time.sleep` and `input` let bench time pass; `input` then
        returns an empty line.

    Returns
    -------
    int
        Exit code of the script; 1 if it raised an exception, whose traceback is then on stderr; 128 + n if signal n
        ended it, even if this process forwarded the signal.

    Raises
    ------
    SceneError
        If the script does not exist, or the scene cannot be used.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: the script does not exist. Give the path of a Python file.")
    chassis = connect_scene(scene, clock)
    report_missing_excitation(chassis)
    server = Server(chassis, other_handlers=(BenchTime(chassis),))
    try:
        code = _run([str(path), *arguments], server.port, chassis.clock.is_free_running)
    finally:
        server.close()
    if chassis.was_read_without_drive:
        print(
            "note: nothing drove the bench while the script read its inputs. Write to an output "
            "(daq/examples/live_control.py), or add a test to the scene (rig help test).",
            file=sys.stderr,
        )
    return code


# Public as `daq.run`, like the command.
run = run_script


def _run(command: list[str], port: int, follows_wall_clock: bool) -> int:
    """Run a Python command as a client of the server at a port; return the exit code of `run_script`."""
    variables = os.environ | environment(f"127.0.0.1:{port}", follows_wall_clock)
    process = subprocess.Popen([sys.executable, *command], env=variables)
    with forward_signals(process):
        code = process.wait()
    if code in (-signal.SIGINT, CTRL_C_EXIT):
        return 130
    return code if code >= 0 else 128 - code
