"""The live scope: a bench in real time, a drive controlled by the operator, and a simultaneous recording."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.excitation.manual_tone import Knobs, ManualTone, ToneReading
from daq.live_scope.screen import Screen, sentence
from daq.measurement.run import MeasurementRun
from daq.recording.recorded_test import TestKind
from daq.viewing.outputs import recording_stream, server, window
from daq.virtual_bench.bench import Bench
from rig.errors import SceneError
from rig.input_files import as_path
from rig.scene.loading import SceneLike, load

if TYPE_CHECKING:
    import rerun as rr

    from daq.virtual_bench.bench import Block
    from rig.scene.scene import Scene

_BLOCK_S = 0.04
# A longer delay, s, is reported and skipped: the bench then continues without catching up.
_MAX_DELAY_S = 0.5
# Minimum number of samples per period of the drive.
_MIN_SAMPLES_PER_PERIOD = 10.0


class Pace:
    """Synchronizes samples with the wall clock.

    `report`: called once if the computer is too slow; `skipped_s`: total skipped wall-clock time, s.
    """

    def __init__(self, rate: float, report: Callable[[str], None]) -> None:
        self._rate, self._report = rate, report
        self._origin: float | None = None
        self.skipped_s = 0.0

    def keep(self, position: int) -> None:
        """Wait until the sample at `position` is due."""
        now = time.monotonic()
        if self._origin is None:
            # The simulation may have been compiled before the first block; time starts now.
            self._origin = now - position / self._rate
        lead_s = self._origin + position / self._rate - now
        if lead_s > 0:
            time.sleep(lead_s)
        elif lead_s < -_MAX_DELAY_S:
            self._origin -= lead_s
            if not self.skipped_s:
                self._report("the machine is too slow for real time. The display runs slower than real time.")
            self.skipped_s -= lead_s


def record_live(
    scene: Scene,
    path: Path,
    stream: rr.RecordingStream,
    knobs: Knobs,
    report: Callable[[str], None],
    keep: Callable[[int], None],
    overwrite: bool = False,
) -> Path:
    """Run and record a bench controlled by an operator, until the knobs are turned off.

    `scene`: scene of the bench; its test is not run; `stream`: stream of the live view; `knobs`: settings, which
    another thread changes; `report`: called with a line of text when a setting has been reached; `keep`: called
    after every block with the number of samples that have passed; it waits for real time; `overwrite`: whether an
    existing file may be replaced. Raises `SceneError` if the rig has no shaker, or the channels do not measure the
    spring force. Raises `RunError` if a channel exceeded its abort limit, or the recording could not be written.
    Raises `KeyboardInterrupt` if the operator pressed Ctrl-C; the recording up to this time is closed.
    """
    last: list[tuple[float, float, bool]] = [(0.0, 0.0, False)]

    def read(reading: ToneReading) -> None:
        screen.read(reading)
        state = reading.frequency, reading.level, reading.is_settled
        if reading.is_settled and state != last[0]:
            report(sentence(reading))
        last[0] = state

    def listener(block: Block, readings: NDArray[np.float64]) -> None:
        screen.show(block, readings)
        keep(block.motion.first + block.motion.displacement.shape[1])

    rate = float(scene.converter.sample_rate)
    block = max(1, round(_BLOCK_S * rate))
    run = MeasurementRun(
        scene, path, block, excite=ManualTone(knobs, read).excite, listener=listener, kind=TestKind.TONES
    )
    screen = Screen(stream, scene, run.bench.channels, run.bench.rate)
    return run.run(overwrite)


def knobs_for(scene: Scene, frequency: float | None, force: float) -> Knobs:
    """Return the initial knobs: at the given frequency, that of the scene's test, or that of the lowest mode."""
    from rig.system.structural_model import structural_model

    if frequency is None:
        frequency = getattr(scene.test, "frequency", None) or getattr(scene.test, "from_", None)
    if frequency is None:
        frequency = max(1.0, float(structural_model(scene).modes.frequency[0]))
    return Knobs(frequency, force, highest=float(scene.converter.sample_rate) / _MIN_SAMPLES_PER_PERIOD)


def scope(
    scene: SceneLike,
    path: str | Path,
    *,
    frequency: float | None = None,
    force: float = 0.0,
    web: bool = False,
    overwrite: bool = False,
) -> Path:
    """Run and record a rig in real time, controlled by an operator, with a viewer.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        The rig; its test is not run.
    path : str or Path
        Recording to write (MCAP).
    frequency : float, optional
        Initial drive frequency, Hz; by default that of the scene's test, or that of the lowest mode.
    force : float
        Initial force amplitude, N.
    web : bool
        Whether to show the viewer in a browser on this computer instead of a window.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    Path
        The recording. It ends when the viewer is closed, at Ctrl-C, or when standard input ends.

    Raises
    ------
    SceneError
        If the rig has no shaker, or the channels do not measure the spring force.
    RunError
        If there is no display, a channel exceeds its abort limit, or the recording cannot be written.
    """
    loaded_scene, recording_path = load(scene), as_path(path)
    knobs = knobs_for(loaded_scene, frequency, force)

    def read_commands() -> None:
        for line in sys.stdin:
            try:
                knobs.execute(line)
            except SceneError as error:
                say(str(error))
            if knobs.quit:
                return
        knobs.quit = True

    viewing = server(say) if web else window("Use --web for a browser.")
    bench = Bench(loaded_scene)
    # The kernels are compiled before real time starts; the run uses a new bench.
    bench.acquire(np.zeros((len(bench.inputs), 64)))
    with viewing as viewer, recording_stream() as stream:
        stream.connect_grpc(viewer.url)
        pace = Pace(float(loaded_scene.converter.sample_rate), say)

        def keep(position: int) -> None:
            pace.keep(position)
            if viewer.process.poll() is not None:
                knobs.quit = True

        say(f"{Knobs.HELP}; recording to {recording_path}")
        # A daemon thread: it may wait for input when the program ends.
        threading.Thread(target=read_commands, name="operator", daemon=True).start()
        try:
            record_live(loaded_scene, recording_path, stream, knobs, say, keep, overwrite)
        except KeyboardInterrupt as interrupt:
            # Ctrl-C is a regular end, because the recording has been closed.
            if not interrupt.args:
                raise
        if pace.skipped_s:
            say(f"the bench ran {pace.skipped_s:.1f} s behind the wall clock; the recording is complete")
    return recording_path


def say(text: str) -> None:
    """Print a line to the operator."""
    print(text, file=sys.stderr, flush=True)
