"""Log of the samples of a task: a recording (.mcap), or a file of NI's format TDMS.

A marker is an entry of a recording about an interval of samples or an instant, for example an overload. A gap is a
sequence of samples that were lost.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.measurement.limits import FlaggedIntervals
from daq.core.recording.recorded_test import TestKind
from daq.core.signal_chain.channel import ChannelInfo
from daq.core.virtual_bench.bench import Bench
from daq.extras.importing.tdms import log_as_warning
from daq.extras.ni_device.engines.acquisition import Acquisition, InputPlan
from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_device.settings.properties import Properties
from daq.extras.ni_device.settings.task_settings import TaskSettings
from daq.extras.ni_device.values import LoggingMode, LoggingOperation
from rig.core.base.errors import RunError, ShotrigError
from rig.core.scene.scene import Scene


class MarkedRecording:
    """A recording in the format of `daq record` with markers at its overloads, without the simulated true motion.

    `rate` is in samples per second; `start_ns` is the time of the first sample in ns since 1970.
    """

    def __init__(
        self,
        path: Path,
        scene: Scene,
        channels: Sequence[ChannelInfo],
        rate: float,
        start_ns: int,
        overwrite: bool,
        test_kind: TestKind | None = None,
    ) -> None:
        from daq.core.recording.recorder import Recorder

        scene = scene.replace(recording=scene.recording.replace(truth=False))
        self._recorder = Recorder(path, scene, channels, rate, start_ns, overwrite, test_kind=test_kind)
        self._overloads = FlaggedIntervals("overload", channels, self.mark)
        self._outcome = "complete", ""

    def write(self, samples: NDArray[Any], overload: NDArray[np.bool_]) -> None:
        """Append converter samples and their overload flags, shape (channels, n)."""
        first = self._recorder.position
        self._recorder.write(samples)
        self._overloads.add(first, overload)

    def mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        """Add a marker of the samples `first` to `stop` - 1, unless writing has failed."""
        if self._recorder.accepts_samples:
            self._recorder.mark(kind, first, stop - 1, **fields)

    def gap(self, samples: int) -> None:
        """Append a gap of lost samples."""
        self._recorder.gap(samples)

    def trigger(self, sample: int) -> None:
        """Add a marker at the sample of the trigger."""
        self._recorder.mark("trigger", sample)

    def abort(self, reason: str) -> None:
        """Store that the acquisition ended early, after the last written sample."""
        self._recorder.mark("abort", self._recorder.position, reason=reason)
        self._outcome = "failed", reason

    def close(self) -> None:
        """Complete the file."""
        self._overloads.close()
        self._recorder.close(*self._outcome)

    def end_with(self, error: Exception) -> Exception:
        """Complete the file after an error as far as possible; return the error, which states what the file has."""
        try:
            with self._recorder:
                raise error
        except Exception as final:
            return final


class _Tdms:
    """A TDMS file with readings in the group `group`; lost samples are NaN.

    With `append`, the readings are added to an existing file, in a group with a new name. The methods are those of
    `MarkedRecording`.
    """

    def __init__(
        self,
        path: Path,
        group: str,
        names: Sequence[str],
        units: Sequence[str],
        plan: InputPlan,
        start_ns: int,
        append: bool,
    ) -> None:
        try:
            import nptdms
        except ImportError:
            raise DaqError(
                f"{path}: TDMS files require the package nptdms. Install it (pip install nptdms), or log to a "
                "recording with a name that ends in .mcap.",
                Code.UNKNOWN,
            ) from None
        if append and path.exists():
            with log_as_warning(path):
                existing = {existing_group.name for existing_group in nptdms.TdmsFile.read_metadata(path).groups()}
            requested, number = group, 1
            while group in existing:
                group, number = f"{requested} #{number}", number + 1
        self._nptdms, self._group, self._plan = nptdms, group, plan
        start = np.datetime64(start_ns, "ns").astype("datetime64[us]")
        self._properties = [
            {
                "NI_ChannelName": name,
                "unit_string": unit,
                "wf_start_time": start,
                "wf_start_offset": 0.0,
                "wf_increment": 1.0 / plan.rate,
            }
            for name, unit in zip(names, units, strict=True)
        ]
        self._path, self._writer = path, nptdms.TdmsWriter(str(path), mode="a" if append else "w")
        self._writer.open()

    def write(self, samples: NDArray[Any], overload: NDArray[np.bool_]) -> None:
        self._write_segment(np.stack([self._plan.to_units(channel, values) for channel, values in enumerate(samples)]))

    def gap(self, samples: int) -> None:
        self._write_segment(np.full((len(self._properties), samples), np.nan))

    def trigger(self, sample: int) -> None:
        for properties in self._properties:
            properties["wf_trigger_offset"] = sample * properties["wf_increment"]

    def abort(self, reason: str) -> None:
        for properties in self._properties:
            properties["error"] = reason

    def close(self) -> None:
        self._write_segment(np.zeros((len(self._properties), 0)))
        self._writer.close()

    def end_with(self, error: Exception) -> Exception:
        with suppress(OSError):
            self._writer.close()
        return RunError(
            f"{self._path}: {getattr(error, 'strerror', error)}; the file contains the samples up to this error"
        )

    def _write_segment(self, values: NDArray[np.float64]) -> None:
        """Append readings, shape (channels, n), with the current properties of the channels."""
        self._writer.write_segment(
            [
                self._nptdms.ChannelObject(self._group, properties["NI_ChannelName"], readings, properties)
                for properties, readings in zip(self._properties, values, strict=True)
            ]
        )


_File = MarkedRecording | _Tdms


class TaskLog:
    """The log of one run of a task.

    With `LOG_AND_READ`, samples are logged when the script reads, and at the end. Samples that are overwritten before
    they are read are a gap in the log. With `LOG`, samples are logged as they are acquired. While the log is paused,
    samples are omitted. If writing fails, the file is completed and the log ends.

    `open_file` opens a file by its path and the index of its first sample. `settings` contain the logging mode, the
    path, the samples per file, and whether the log is paused.
    """

    def __init__(self, open_file: Callable[[Path, int], _File], settings: Properties) -> None:
        self._open, self._settings = open_file, settings
        self.logs_only = self._settings["logging_mode"] == LoggingMode.LOG
        self._first_path, self._file_number = Path(self._settings["logging_file_path"]), 0
        self._file = open_file(self._first_path, 0)
        self._next: int | None = None  # index of the sample that is logged next
        self._samples_in_file = 0  # number of samples in the current file
        self._has_ended = False

    def start_new_file(self, path: Path, acquisition: Acquisition) -> None:
        """Complete the current file and continue in another file."""
        with self._ended_on_failure():
            self._write_new(acquisition)
            self._file.close()
            self._file, self._samples_in_file = self._open(path, self._next or 0), 0

    def write_new(self, acquisition: Acquisition) -> None:
        """Log the samples acquired since the last call; raise `DaqError` if writing fails, which ends the log."""
        if not self._has_ended:
            with self._ended_on_failure():
                self._write_new(acquisition)

    @contextmanager
    def _ended_on_failure(self) -> Iterator[None]:
        """Complete the file if the body fails, and end the log."""
        try:
            yield
        except DaqError:
            self._has_ended = True
            raise
        except (ShotrigError, OSError) as error:
            self._has_ended = True
            raise DaqError(f"the log has ended: {self._file.end_with(error)}", Code.UNKNOWN) from error

    def _write_new(self, acquisition: Acquisition) -> None:
        stop = acquisition.readable_end
        if stop == 0:
            return
        if self._next is None:
            self._next = acquisition.first_readable
            if acquisition.trigger_sample is not None:
                self._file.trigger(acquisition.trigger_sample - self._next)
        oldest = acquisition.ring.oldest
        if self._next < oldest:
            self._file.gap(oldest - self._next)
            self._next = oldest
        if self._settings["logging_pause"]:
            self._next = max(self._next, stop)
        max_samples = self._settings["logging_samps_per_file"] or math.inf
        while self._next < stop:
            if self._samples_in_file >= max_samples:
                self._file_number += 1
                self._file.close()
                name = f"{self._first_path.stem}_{self._file_number:04d}{self._first_path.suffix}"
                self._file, self._samples_in_file = self._open(self._first_path.with_name(name), self._next), 0
            first, count = self._next, int(min(stop - self._next, max_samples - self._samples_in_file))
            self._file.write(acquisition.ring.read(first, count), acquisition.overloads.read(first, count))
            self._next += count
            self._samples_in_file += count

    def close(self, acquisition: Acquisition) -> None:
        """Log the remaining samples and the reason of an early end, and complete the file."""
        if self._has_ended:
            return
        with self._ended_on_failure():
            self._write_new(acquisition)
            if acquisition.error is not None:
                self._file.abort(str(acquisition.error))
            self._file.close()


def open_log(name: str, task: TaskSettings, bench: Bench, plan: InputPlan, time_ns: Callable[[int], int]) -> TaskLog:
    """Open a log for a task at its start.

    `name` is the name of the task, `task` contains its settings. The suffix of the log's path, `.mcap` or `.tdms`,
    selects the format. `time_ns` returns the time of a sample [ns] from its number. Raises `DaqError` if the file
    cannot be opened with these settings.
    """
    settings = task.groups["read"]
    infos = [replace(bench.channels[bench_index], rate=plan.rate) for bench_index in plan.bench_indices]
    names = [channel.name for channel in task.channels]

    def open_file(path: Path, first: int) -> _File:
        start_ns, operation = time_ns(first), settings["logging_tdms_operation"]
        suffix, exists = path.suffix.lower(), path.exists()
        append = operation in (LoggingOperation.OPEN, LoggingOperation.OPEN_OR_CREATE) and exists
        problem = ""
        if suffix not in (".mcap", ".tdms"):
            problem = f"cannot log to {path}: unknown suffix. Give a name that ends in .mcap (a recording) or .tdms."
        elif operation == LoggingOperation.CREATE and exists:
            problem = f"{path}: the file exists. Choose another name, or LoggingOperation.CREATE_OR_REPLACE."
        elif operation == LoggingOperation.OPEN and not exists:
            problem = f"{path}: LoggingOperation.OPEN appends to a file, but the file does not exist. Use CREATE."
        elif not path.parent.is_dir():
            # NI's driver does not create folders either.
            problem = f"{path}: the folder {path.parent} does not exist. Create it first."
        elif suffix == ".mcap" and append:
            problem = (
                f"{path}: the recording exists and cannot be appended to. Use LoggingOperation.CREATE_OR_REPLACE, or "
                "another name."
            )
        if problem:
            raise DaqError(problem, Code.UNKNOWN)
        try:
            if suffix == ".tdms":
                group = settings["logging_tdms_group_name"] or name
                units = [channel.unit for channel in task.channels]
                return _Tdms(path, group, names, units, plan, start_ns, append)
            return MarkedRecording(path, bench.scene, _with_names(infos, names), plan.rate, start_ns, exists)
        except DaqError:
            raise
        except (ShotrigError, OSError) as error:
            raise DaqError(f"cannot log to {path}: {error}", Code.UNKNOWN) from error

    return TaskLog(open_file, settings)


def _with_names(channels: Sequence[ChannelInfo], names: Sequence[str]) -> list[ChannelInfo]:
    """Set the names of channels in a recording: the name in the script, otherwise the name on the bench.

    A channel without a name in the script has the name of its terminal, which contains a slash. If two modules read one
    sensor, the name of the device is added to the name on the bench.
    """
    named: list[ChannelInfo] = []
    for info, name in zip(channels, names, strict=True):
        if "/" in name:
            used_names = {*names, *(channel.name for channel in named)}
            device = name.partition("/")[0]
            name = info.name if info.name not in used_names else f"{info.name} on {device}"
        named.append(replace(info, name=name))
    return named
