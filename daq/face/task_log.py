"""Logging of what a task acquires: into a recording (.mcap), or a TDMS file for scripts that expect one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from daq.face.constants import LoggingMode, LoggingOperation
from daq.instrument.errors import DaqError, DAQmxErrors
from daq.measurement.limits import Stretches
from rig.errors import ShotrigError

if TYPE_CHECKING:
    from daq.instrument.acquisition import Acquisition
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.scene import Scene


class _File(Protocol):
    """A file being logged into."""

    def write(self, samples: NDArray[Any], overload: NDArray[np.bool_]) -> None:
        """Append converter samples and their overload flags, shape (channels, n)."""

    def gap(self, samples: int) -> None:
        """Pass over samples that were lost."""

    def trigger(self, sample: int) -> None:
        """Note the sample the reference trigger was found at."""

    def abort(self, reason: str) -> None:
        """Note that the acquisition ended early, here."""

    def close(self) -> None:
        """Complete the file."""


class _Recording:
    """A recording, as `daq record` makes them."""

    def __init__(
        self, path: Path, scene: Scene, channels: Sequence[ChannelInfo], start_ns: int, overwrite: bool
    ) -> None:
        from daq.recording.recorder import Recorder

        # The truth of a scene belongs to a whole test; a task logs its channels.
        scene = scene.replace(recording=scene.recording.replace(truth=False))
        self._recorder = Recorder(path, scene, channels, channels[0].rate, start_ns, overwrite)
        self._overloads = Stretches("overload", channels, self._mark)
        self._outcome = "complete", ""

    def _mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        self._recorder.mark(kind, first, stop - 1, **fields)

    def write(self, samples: NDArray[Any], overload: NDArray[np.bool_]) -> None:
        first = self._recorder.position
        self._recorder.write(samples)
        self._overloads.add(first, overload)

    def gap(self, samples: int) -> None:
        self._recorder.gap(samples)

    def trigger(self, sample: int) -> None:
        self._recorder.mark("trigger", sample)

    def abort(self, reason: str) -> None:
        self._recorder.mark("abort", self._recorder.position, reason=reason)
        self._outcome = "failed", reason

    def close(self) -> None:
        self._overloads.close()
        self._recorder.close(*self._outcome)


class _Tdms:
    """A TDMS file with scaled samples; lost samples are NaN."""

    def __init__(
        self,
        path: Path,
        group: str,
        names: Sequence[str],
        units: Sequence[str],
        scale: NDArray[np.float64],
        rate: float,
        start_ns: int,
        append: bool,
    ) -> None:
        try:
            import nptdms
        except ImportError:
            raise DaqError(
                f"logging to {path} needs the package nptdms (pip install nptdms); or log to a recording: "
                "name the "
                "file .mcap",
                DAQmxErrors.UNKNOWN,
            ) from None
        if append and path.exists():
            taken = {each.name for each in nptdms.TdmsFile.read_metadata(path).groups()}
            wanted, number = group, 1
            while group in taken:
                group, number = f"{wanted} #{number}", number + 1
        self._nptdms, self._group, self._scale = nptdms, group, scale[:, None]
        start = np.datetime64(start_ns, "ns").astype("datetime64[us]")
        self._properties = [
            {
                "NI_ChannelName": name,
                "unit_string": unit,
                "wf_start_time": start,
                "wf_start_offset": 0.0,
                "wf_increment": 1.0 / rate,
            }
            for name, unit in zip(names, units, strict=True)
        ]
        self._writer = nptdms.TdmsWriter(str(path), mode="a" if append else "w")
        self._writer.open()

    def write(self, samples: NDArray[Any], overload: NDArray[np.bool_]) -> None:
        self._segment(samples * self._scale)

    def gap(self, samples: int) -> None:
        self._segment(np.full((len(self._properties), samples), np.nan))

    def trigger(self, sample: int) -> None:
        for properties in self._properties:
            properties["wf_trigger_offset"] = sample * properties["wf_increment"]

    def abort(self, reason: str) -> None:
        for properties in self._properties:
            properties["error"] = reason

    def close(self) -> None:
        self._segment(np.zeros((len(self._properties), 0)))
        self._writer.close()

    def _segment(self, values: NDArray[np.float64]) -> None:
        self._writer.write_segment(
            [
                self._nptdms.ChannelObject(self._group, properties["NI_ChannelName"], row, properties)
                for properties, row in zip(self._properties, values, strict=True)
            ]
        )


class TaskLog:
    """The log of one run of a task.

    While reads are allowed (`LOG_AND_READ`) it is written as the script reads, and at the end: samples
    overwritten before that are lost to the log too, and stand in it as a gap. With `LOG` alone it is
    written as samples come.

    Parameters
    ----------
    file : file
        Where to.
    mode : LoggingMode
        Whether the script reads too.
    """

    def __init__(self, file: _File, mode: LoggingMode) -> None:
        self._file, self.mode = file, mode
        self._logged: int | None = None

    def follow(self, acquisition: Acquisition) -> None:
        """Log what has come since the last time."""
        stop = acquisition.readable
        if stop == 0:
            return
        if self._logged is None:
            self._logged = acquisition.first_readable
            if acquisition.trigger is not None:
                self._file.trigger(acquisition.trigger - self._logged)
        oldest = acquisition.oldest
        if self._logged < oldest:
            self._file.gap(oldest - self._logged)
            self._logged = oldest
        if self._logged < stop:
            first, count = self._logged, stop - self._logged
            self._file.write(acquisition.ring.read(first, count), acquisition.overloads.read(first, count))
            self._logged = stop

    def close(self, acquisition: Acquisition) -> None:
        """Log the rest, and why there is no more if that was not meant, and complete the file."""
        try:
            self.follow(acquisition)
            if acquisition.error is not None:
                self._file.abort(acquisition.error.bare_message)
        finally:
            self._file.close()


def open_log(
    path: str | Path,
    mode: LoggingMode,
    operation: LoggingOperation,
    group: str,
    scene: Scene,
    channels: Sequence[ChannelInfo],
    names: Sequence[str],
    units: Sequence[str],
    scale: NDArray[np.float64],
    start_ns: int,
) -> TaskLog:
    """Open a log for a task.

    Parameters
    ----------
    path : str or Path
        Name of the file; its suffix says what it becomes, `.mcap` or `.tdms`.
    mode : LoggingMode
        Whether the script reads too.
    operation : LoggingOperation
        Whether the file is made, replaced or appended to; recordings cannot be appended to.
    group : str
        Name of the group in a TDMS file.
    scene : Scene
        Scene on the bench, kept in a recording.
    channels : sequence of ChannelInfo
        The channels as the bench has them.
    names, units : sequence of str
        The channels as the task has them.
    scale : ndarray, shape (channels,)
        Factor from converter samples to those units.
    start_ns : int
        Time of the first sample, ns.

    Raises
    ------
    DaqError
        If the file cannot be opened in that way; the message says what to do.
    """
    path = Path(path)
    suffix, exists = path.suffix.lower(), path.exists()
    if suffix not in (".mcap", ".tdms"):
        raise _refuse(f"cannot log to {path}: expected a name that ends in .mcap (a recording) or .tdms")
    if operation is LoggingOperation.CREATE and exists:
        raise _refuse(f"{path} exists: choose another name, or LoggingOperation.CREATE_OR_REPLACE")
    if operation is LoggingOperation.OPEN and not exists:
        raise _refuse(f"{path} does not exist: LoggingOperation.OPEN appends to a file; use CREATE")
    append = operation in (LoggingOperation.OPEN, LoggingOperation.OPEN_OR_CREATE) and exists
    if suffix == ".mcap" and append:
        raise _refuse(
            f"{path} exists, and a recording cannot be appended to: use LoggingOperation.CREATE_OR_REPLACE "
            "or "
            "another name"
        )
    file: _File
    try:
        if suffix == ".tdms":
            file = _Tdms(path, group, names, units, scale, channels[0].rate, start_ns, append)
        else:
            file = _Recording(path, scene, _named(channels, names), start_ns, overwrite=exists)
    except DaqError:
        raise
    except (ShotrigError, OSError) as error:
        raise _refuse(f"cannot log to {path}: {error}") from error
    return TaskLog(file, mode)


def _named(channels: Sequence[ChannelInfo], names: Sequence[str]) -> list[ChannelInfo]:
    """Give channels their names in a recording: those a script gave them, otherwise those on the bench.

    A channel that no script named goes by its terminal's name, which has a slash. Where its name on the bench
    is taken (two modules on one sensor), the module tells it apart.
    """
    named: list[ChannelInfo] = []
    for info, name in zip(channels, names, strict=True):
        if "/" in name:
            taken = {*names, *(each.name for each in named)}
            device = name.partition("/")[0]
            name = info.name if info.name not in taken else f"{info.name} on {device}"
        named.append(replace(info, name=name))
    return named


def _refuse(message: str) -> DaqError:
    return DaqError(message, DAQmxErrors.UNKNOWN)
