"""The test of a scene, run on its bench and recorded: `daq.record`."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.excitation import Excitation, Station, excitation
from daq.core.measurement.bench_loop import BenchLoop
from daq.core.measurement.estimate import check_resources, estimate
from daq.core.measurement.limits import DriveInput, FlaggedIntervals
from daq.core.recording.committed_file import DiskError
from daq.core.recording.recorded_test import SceneOutline, TestKind, kind_of_settings
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo
from daq.core.virtual_bench.bench import Block
from rig.core.base.arrays import Array
from rig.core.base.ending_signals import interrupt_flag
from rig.core.base.errors import RunError, SceneError, ShotrigError
from rig.core.base.errors import RunWarning as RunWarning  # public as daq.RunWarning
from rig.core.base.input_files import as_path
from rig.core.base.progress import FractionProgress
from rig.core.numerics.runs import runs_of
from rig.core.scene.loading import SceneLike, load
from rig.core.scene.scene import Scene

# The size of the recording is extrapolated after this fraction of the test; before, the estimate is too uncertain.
_MIN_FRACTION = 0.02


def record(
    scene: SceneLike,
    path: str | Path,
    *,
    block: int | None = None,
    overwrite: bool = False,
    progress: FractionProgress | None = None,
) -> Path:
    """Run the complete test of a scene, as on real hardware, and record it.

    The same scene and seed result in the same bytes, independent of the block size.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        Scene, name of a bundled scene, or path of a scene file.
    path : str or Path
        Recording to write (MCAP); missing folders are created.
    block : int, optional
        Maximum number of samples per block; by default, a block lasts at most 0.5 s.
    overwrite : bool
        Whether an existing file may be replaced.
    progress : callable, optional
        ``progress(fraction, message)``, called during the test.

    Returns
    -------
    Path
        The recording.

    Raises
    ------
    SceneError
        If the scene or its test cannot be run; no file is left.
    RecordingError
        If the recording cannot be created at this path, or exists already.
    RunError
        If the run failed or a channel exceeded its abort limit; the recording up to this time is closed and marked as
        incomplete.
    KeyboardInterrupt
        If the user pressed Ctrl-C; the recording up to this time is closed and marked as incomplete.

    Warns
    -----
    RunWarning
        If points did not settle or a level was not reached; before the test, if no channel measures the force.

    Examples
    --------
    >>> import tempfile, daq, rig
    >>> scene = rig.load("fig10b-no-damper")
    >>> scene = scene.replace(test=scene.test.replace(repeats=1, interval="0.5 s"))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     recording = daq.open(record(scene, Path(folder) / "hit.mcap"))
    ...     recording.markers[-1].kind
    'hit'
    """
    if block is not None and block < 1:
        raise SceneError(f"block: got {block} samples; expected 1 or more.")
    loaded = load(scene)
    target = as_path(path)
    check_resources(estimate(loaded), target)
    return MeasurementRun(loaded, target, block, progress).run(overwrite)


class MeasurementRun(BenchLoop):
    """One run of a test, with its recording.

    `excite` creates the excitation of the test. `listener` is called with each block and the readings of its channels.
    `kind` is the kind of test that the recording states; by default, the kind in the scene. A manual test states its
    own kind.
    """

    def __init__(
        self,
        scene: Scene,
        path: Path,
        block: int | None = None,
        progress: FractionProgress | None = None,
        excite: Callable[[Station], Excitation] = excitation,
        listener: Callable[[Block, Array], None] = lambda block, readings: None,
        kind: TestKind | None = None,
    ) -> None:
        super().__init__(scene, block)
        self._path = path
        self._kind = kind_of_settings(scene.test) if kind is None else kind
        self._excite, self._listener, self._progress = excite, listener, progress
        self._recorder: Recorder | None = None
        self._interrupted: Callable[[], bool] = lambda: False
        self._lost = 0  # samples lost since the last recorded sample
        self._overloads = FlaggedIntervals("overload", self.bench.channels, self.mark)
        inputs = [DriveInput(name, self.bench.rate) for name in self.bench.inputs]
        self._clipped_drive = FlaggedIntervals("clipped", inputs, self.mark)

    def run(self, overwrite: bool) -> Path:
        """Run the test to its end, close the recording and return its path; for errors see `record`."""
        # Errors of the test are reported before a file is created.
        test = self._excite(self.station)
        drive = next(test)
        bench, path = self.bench, self._path
        warning = missing_force_reference(bench.scene, bench.channels)
        if warning is not None:
            warnings.warn(warning, RunWarning, stacklevel=4)
        try:
            # An interrupt is deferred while the file is created or completed, so the file is always valid.
            with (
                interrupt_flag() as self._interrupted,
                Recorder(
                    path, bench.scene, bench.channels, bench.rate, overwrite=overwrite, test_kind=self._kind
                ) as recorder,
            ):
                self._recorder = recorder
                try:
                    # Closing the test writes its last markers, so the recorder must still be open.
                    with closing(test):
                        self.run_test(test, drive)
                except (ShotrigError, _Stopped) as error:
                    end = self.last_sample if self.limit_sample is None else self.limit_sample
                    self.mark("abort", end, end + 1, reason=str(error))
                    raise
                finally:
                    self._record_gap()
                    self._limits.close()
                    self._overloads.close()
                    self._clipped_drive.close()
            if self._interrupted():
                raise KeyboardInterrupt(self._recorded_duration())
        except _Stopped as stopped:
            raise KeyboardInterrupt(self._recorded_duration()) from stopped
        except DiskError:
            # The message of the recorder's error already describes the content of the file.
            raise
        except ShotrigError as error:
            if self._recorder is None:
                raise
            raise type(error)(f"{str(error).rstrip('.')}. {self._recorded_duration()}") from error
        for message in dict.fromkeys(self.warnings):
            warnings.warn(message, RunWarning, stacklevel=4)
        return path

    def ending_error(self, readings: Array) -> BaseException | None:
        """Return the error that ends the test (an exceeded limit, or Ctrl-C); None if the test continues."""
        error = super().ending_error(readings)
        if error is not None:
            return RunError(f"test aborted: {error}")
        return _Stopped("interrupted") if self._interrupted() else None

    def on_block(self, block: Block, readings: Array) -> None:
        """Record a block without the samples that are lost between converter and recording."""
        assert self._recorder is not None
        if self.bench.scene.recording.truth:
            self._recorder.write_truth(block.motion)
        if self.bench.lost:
            self._write_acquired(block)
        else:
            self._recorder.write(block.samples)
        self._listener(block, readings)

    def _write_acquired(self, block: Block) -> None:
        """Write the samples of a block that are not lost between converter and recording."""
        assert self._recorder is not None
        recorded = np.ones(block.samples.shape[1], dtype=bool)
        for begin, end in self.bench.lost:
            recorded[max(0, begin - block.first) : max(0, end + 1 - block.first)] = False
        for start, stop in sorted(runs_of(recorded) + runs_of(~recorded)):
            if not recorded[start]:
                self._lost += stop - start
                continue
            self._record_gap()
            self._recorder.write(block.samples[:, start:stop])

    def on_window(self, first: int, drive: Array, overload: NDArray[np.bool_]) -> None:
        """Mark the overloads of a window, and the intervals in which an amplifier clips the drive."""
        self._overloads.add(first - self.bench.latency, overload)
        self._clipped_drive.add(first, abs(drive) > self.bench.drive_limit[:, None])

    def _record_gap(self) -> None:
        """Record the samples lost since the last recorded sample as a gap."""
        if self._lost and self._recorder is not None and self._recorder.accepts_samples:
            self._recorder.gap(self._lost)
            self._lost = 0

    def mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        """Write a marker."""
        assert self._recorder is not None
        # No marker is written on a full disk: its error would hide the message that the disk is full.
        if self._recorder.accepts_samples:
            self._recorder.mark(kind, first, stop - 1, **fields)

    def report(self, fraction: float, message: str) -> None:
        """Report progress, with a warning if the disk will be full.

        The estimate before the test does not include the waits for steady states.
        """
        if self._progress is None:
            return
        if self._recorder is not None and fraction > _MIN_FRACTION:
            remaining, free = self._recorder.size * (1.0 / fraction - 1.0), self._recorder.free
            if remaining > free:
                sizes = f"{remaining / 1e6:.3g} MB required, {free / 1e6:.3g} MB free"
                message += f"; the disk will be full before the end: {sizes}"
        self._progress(fraction, message)

    def _recorded_duration(self) -> str:
        """Return a sentence with the recorded duration, for messages."""
        path = self._path if self._recorder is None else self._recorder.current_path
        return f"{path} contains the first {self.station.now / self.bench.rate:.2f} s."


def missing_force_reference(scene: Scene, channels: Sequence[ChannelInfo]) -> str | None:
    """Return a warning that names the channels that are missing to measure the shaker's force; None if all exist.

    >>> import rig
    >>> from daq.core.virtual_bench.bench import Bench
    >>> bench = Bench(rig.load("bare-structure"))
    >>> missing_force_reference(bench.scene, bench.channels) is None
    True
    """
    places = SceneOutline.of(scene).missing_force_points(channels)
    if not places:
        return None
    names = ["force" if place.startswith("shaker") else place.replace(" ", "") for place in places]
    missing = " and ".join(f"{{name: {name}, at: {place}}}" for name, place in zip(names, places, strict=True))
    return (
        "no channel measures the force on the structure, so `analysis frf` has no reference. "
        f"Add {missing} to the scene's channels."
    )


class _Stopped(KeyboardInterrupt):
    """The user pressed Ctrl-C, and the drive has been ramped to zero."""
