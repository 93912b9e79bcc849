"""Running a script for NI's client with the rig as its hardware: `daq run`."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from daq.instrument.connecting import connect_scene
from daq.server.bench_time import BenchTime, TimeLimit
from daq.server.client_defaults import FAST, LIMITED, SERVER
from daq.server.passed_signals import signals_passed_on
from daq.server.service import Server
from daq.server.unfed_sensors import tell_unfed_sensors
from rig.errors import SceneError
from rig.scene.scene import Scene

#: How a process ends of Ctrl-C on Windows.
CTRL_C_EXIT = 0xC000013A
STARTUP = Path(__file__).resolve().parent / "startup"


def run_script(
    path: str | Path,
    arguments: Sequence[str] = (),
    scene: Scene | str | None = None,
    clock: str | None = None,
    seconds: float | None = None,
) -> int:
    """Run a script as Python would, in a process of its own, with the rig as its hardware.

    Parameters
    ----------
    path : str or Path
        The script.
    arguments : sequence of str
        What it finds in `sys.argv` after its name.
    scene : Scene or str, optional
        What is on the bench, see `daq.connect`.
    clock : str, optional
        Clock, see `daq.connect`. On the fast one `time.sleep` lets bench time pass, and so does `input`,
        which then returns an empty line.
    seconds : float, optional
        Bench time after which the script gets a Ctrl-C; if it waits for Enter then, it gets that instead.

    Returns
    -------
    int
        Exit code: the script's own; 1 if it raised an exception, whose traceback is then on stderr; 128 + n if signal
        n ended it, which may have come to this process.

    Raises
    ------
    SceneError
        If there is no such script, the scene cannot be used, or `seconds` is no time.
    """
    path = Path(path)
    if seconds is not None and not 0 < seconds < math.inf:
        raise SceneError(f"seconds {seconds:g}: expected a time above 0; leave it out for no limit")
    if not path.is_file():
        raise SceneError(f"there is no script {path}: give the path of a Python file")
    chassis = connect_scene(scene, clock)
    tell_unfed_sensors(chassis)
    limit = TimeLimit(chassis, seconds)
    server = Server(chassis, further=(BenchTime(chassis, limit),))
    try:
        code = _run([str(path), *arguments], server.port, chassis.clock.runs_free, limit)
    finally:
        server.close()
    if chassis.read_at_rest:
        print(
            "note: nothing drove the bench while the script read its inputs: it wrote to no output, and the scene "
            "plays no test; write to an output (daq/examples/live_control.py), or give it a test (rig help test)",
            file=sys.stderr,
        )
    return code


#: The call by the name of the command, `daq.run`.
run = run_script


def _run(command: list[str], port: int, real: bool, limit: TimeLimit) -> int:
    paths = [str(STARTUP), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {SERVER: f"127.0.0.1:{port}", "PYTHONPATH": os.pathsep.join(paths)}
    # Forked children make connections of their own, which grpc allows only if this is set before the fork.
    environment |= {"GRPC_ENABLE_FORK_SUPPORT": "1"}
    environment |= ({} if real else {FAST: "1"}) | ({} if limit.endless else {LIMITED: "1"})
    process = subprocess.Popen([sys.executable, *command], env=environment)
    limit.process = process.pid
    with signals_passed_on(process):
        code = process.wait()
    if code in (-signal.SIGINT, CTRL_C_EXIT):
        return 0 if limit.reached else 130
    return code if code >= 0 else 128 - code
