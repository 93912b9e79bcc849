"""The live scope: a bench in real time whose drive the operator controls, and which is recorded."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.excitation.manual_tone import ManualTone, ToneControls, ToneEstimate
from daq.live_scope.screen import Screen, tone_line
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

# Duration of a block, s.
_BLOCK_S = 0.04
# The bench catches up a delay of at most this time, s; a longer delay is reported.
_MAX_DELAY_S = 0.5
# Minimum number of samples per period of the drive.
_MIN_SAMPLES_PER_PERIOD = 10.0


class RealTimePace:
    """Synchronizes samples with the wall clock.

    `report` is called once if the computer is too slow. `skipped_s` is the total delay that was not caught up, s.
    """

    def __init__(self, rate: float, report: Callable[[str], None]) -> None:
        self._rate, self._report = rate, report
        self._origin: float | None = None
        self.skipped_s = 0.0

    def wait_until_due(self, position: int) -> None:
        """Wait until the sample at `position` is due."""
        now = time.monotonic()
        if self._origin is None:
            # Time starts with the first block, because the simulation may have been compiled before it.
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
    controls: ToneControls,
    report: Callable[[str], None],
    wait_until_due: Callable[[int], None],
    overwrite: bool = False,
) -> Path:
    """Run and record a bench that an operator controls, until the operator quits; return the recording.

    The test of `scene` is not run. `stream` leads to the live view. `controls` are the operator's frequency and force,
    which another thread changes. `report` is called with a line of text when both are reached in steady state.
    `wait_until_due` is called after every block with the number of samples so far, and waits until they are due.

    Raises `SceneError` if the rig has no shaker, or the channels do not measure the spring force; `RunError` if a
    channel exceeds its abort limit, or the recording cannot be written; `KeyboardInterrupt` at Ctrl-C, after the
    recording was completed.
    """
    # Frequency (Hz) and level (N) of the previous estimate, and whether it was steady.
    last_state = (0.0, 0.0, False)

    def on_estimate(estimate: ToneEstimate) -> None:
        nonlocal last_state
        screen.show_tone(estimate)
        state = estimate.frequency, estimate.level, estimate.is_settled
        if estimate.is_settled and state != last_state:
            report(tone_line(estimate))
        last_state = state

    def listener(block: Block, readings: NDArray[np.float64]) -> None:
        screen.show_block(block, readings)
        wait_until_due(block.motion.first + block.motion.displacement.shape[1])

    rate = float(scene.converter.sample_rate)
    block = max(1, round(_BLOCK_S * rate))
    run = MeasurementRun(
        scene, path, block, excite=ManualTone(controls, on_estimate).excite, listener=listener, kind=TestKind.TONES
    )
    screen = Screen(stream, scene, run.bench.channels, run.bench.rate)
    return run.run(overwrite)


def initial_controls(scene: Scene, frequency: float | None, force: float) -> ToneControls:
    """Return the initial controls, at this frequency in Hz, by default the frequency of the test or the lowest mode.

    `force`: amplitude, N.
    """
    from rig.system.structural_model import structural_model

    if frequency is None:
        frequency = getattr(scene.test, "frequency", None) or getattr(scene.test, "from_", None)
    if frequency is None:
        frequency = max(1.0, float(structural_model(scene).modes.frequency[0]))
    return ToneControls(frequency, force, highest=float(scene.converter.sample_rate) / _MIN_SAMPLES_PER_PERIOD)


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
        Initial drive frequency, Hz; by default the frequency of the scene's test, or of the lowest mode.
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
    controls = initial_controls(loaded_scene, frequency, force)

    def read_commands() -> None:
        # Commands such as "f 34.8" are typed on standard input.
        for line in sys.stdin:
            try:
                controls.execute(line)
            except SceneError as error:
                print_line(str(error))
            if controls.quit:
                return
        controls.quit = True

    viewer_context = server(print_line) if web else window("Use --web to show the rig in a browser.")
    bench = Bench(loaded_scene)
    # The kernels are compiled before real time starts; the run uses a new bench.
    bench.acquire(np.zeros((len(bench.inputs), 64)))
    with viewer_context as viewer, recording_stream() as stream:
        stream.connect_grpc(viewer.url)
        pace = RealTimePace(float(loaded_scene.converter.sample_rate), print_line)

        def wait_until_due(position: int) -> None:
            pace.wait_until_due(position)
            if viewer.process.poll() is not None:
                controls.quit = True

        print_line(f"Commands: {ToneControls.HELP}. Recording to {recording_path}")
        # A daemon thread: it may wait for input when the program ends.
        threading.Thread(target=read_commands, name="operator", daemon=True).start()
        try:
            record_live(loaded_scene, recording_path, stream, controls, print_line, wait_until_due, overwrite)
        except KeyboardInterrupt as interrupt:
            # Ctrl-C is not an error here, because the recording has been closed.
            if not interrupt.args:
                raise
        if pace.skipped_s:
            print_line(f"the bench ran {pace.skipped_s:.1f} s behind the wall clock; the recording is complete")
    return recording_path


def print_line(text: str) -> None:
    """Print a line to the operator."""
    print(text, file=sys.stderr, flush=True)
