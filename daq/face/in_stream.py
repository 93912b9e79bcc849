"""Reading from a task: what is in its buffer, where to read, and logging."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.face import argument
from daq.face.constants import (
    READ_ALL_AVAILABLE,
    LoggingMode,
    LoggingOperation,
    OverwriteMode,
    ReadRelativeTo,
    WaitMode,
)
from daq.face.task_read import collect
from daq.instrument.errors import DaqError, DAQmxErrors, DaqReadError, unsupported
from daq.instrument.terminals import unflatten

if TYPE_CHECKING:
    from daq.face.task import Task
    from daq.face.virtual_channels import Channel
    from daq.instrument.acquisition import Acquisition

# Size of the buffer of a continuous task, by the rate up to which it holds.
_BUFFERS = ((100.0, 1000), (10_000.0, 10_000), (1_000_000.0, 100_000), (np.inf, 1_000_000))

_FROZEN = (
    *("overwrite", "logging_file_path", "logging_mode"),
    *("logging_tdms_group_name", "logging_tdms_operation"),
)
_FREE = (
    *("timeout", "auto_start", "read_all_avail_samp", "relative_to", "offset", "wait_mode", "sleep_time"),
    "waveform_attribute_mode",
)
_KINDS: dict[str, Any] = {
    "overwrite": OverwriteMode,
    "logging_mode": LoggingMode,
    "logging_tdms_operation": LoggingOperation,
    "relative_to": ReadRelativeTo,
    "wait_mode": WaitMode,
}


class InStream:
    """The input side of a task; properties have the driver's names.

    A sample is read once unless `relative_to` and `offset` say otherwise. `curr_read_pos` before a read is
    the number of the sample that comes first, counted from the start trigger: with the rate it is the time
    axis.

    Parameters
    ----------
    task : Task
        The task.
    """

    timeout: float
    auto_start: bool
    read_all_avail_samp: bool
    relative_to: ReadRelativeTo
    offset: int
    wait_mode: WaitMode
    sleep_time: float
    waveform_attribute_mode: Any
    overwrite: OverwriteMode
    logging_mode: LoggingMode
    logging_file_path: str | Path | None
    logging_tdms_group_name: str
    logging_tdms_operation: LoggingOperation

    def __init__(self, task: Task) -> None:
        self.__dict__.update(
            _task=task,
            timeout=10.0,
            auto_start=True,
            read_all_avail_samp=False,
            relative_to=ReadRelativeTo.CURRENT_READ_POSITION,
            offset=0,
            wait_mode=WaitMode.WAIT_FOR_INTERRUPT,
            sleep_time=0.001,
            waveform_attribute_mode=None,
            overwrite=OverwriteMode.OVERWRITE_UNREAD_SAMPLES,
            logging_mode=LoggingMode.OFF,
            logging_file_path=None,
            logging_tdms_group_name="",
            logging_tdms_operation=LoggingOperation.OPEN_OR_CREATE,
            _buffer=None,
            _chosen=None,
            _overloaded=None,
        )

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("input_buf_size", "channels_to_read"):
            object.__setattr__(self, name, value)
            return
        if name not in _FROZEN + _FREE:
            raise unsupported(f"setting in_stream.{name}")
        if name in _FROZEN:
            self._task.check_idle(f"in_stream.{name}")
        if name in _KINDS:
            value = argument.choice(_KINDS[name], value, f"in_stream.{name}")
        self.__dict__[name] = value

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise unsupported(f"in_stream.{name}")

    # What there is

    @property
    def num_chans(self) -> int:
        """Number of channels read."""
        return len(self.channels_to_read)

    @property
    def channels_to_read(self) -> Channel:
        """The channels that reads return; all unless set."""
        collection = self._task.ai_channels
        return collection.all if self._chosen is None else collection[",".join(self._chosen)]

    @channels_to_read.setter
    def channels_to_read(self, channels: Channel | str) -> None:
        names = unflatten(channels) if isinstance(channels, str) else channels.channel_names
        self._task.ai_channels.find(names)
        self.__dict__["_chosen"] = names or None

    @property
    def input_buf_size(self) -> int:
        """Samples per channel the buffer holds."""
        timing = self._task.timing
        if self._buffer is not None:
            return int(self._buffer)
        if not timing.clocked:
            return 0
        if timing.finite:
            return timing.samp_quant_samp_per_chan
        default = next(size for rate, size in _BUFFERS if timing.samp_clk_rate <= rate)
        return max(default, timing.samp_quant_samp_per_chan)

    @input_buf_size.setter
    def input_buf_size(self, size: int) -> None:
        self._task.check_idle("in_stream.input_buf_size")
        size = argument.whole(size, "in_stream.input_buf_size")
        if size < 1:
            raise DaqError(
                f"input_buf_size {size}: expected 1 sample at least",
                DAQmxErrors.INVALID_ATTRIBUTE_VALUE,
                self._task.name,
            )
        self.__dict__["_buffer"] = size

    @property
    def avail_samp_per_chan(self) -> int:
        """Samples per channel that could be read now."""
        self._task.run.look("avail_samp_per_chan")
        return self._available()

    def _available(self) -> int:
        run = self._task.run.acquisition
        return 0 if run is None else max(0, run.readable - run.position)

    @property
    def total_samp_per_chan_acquired(self) -> int:
        """Samples per channel acquired since the start."""
        self._task.run.look("total_samp_per_chan_acquired")
        run = self._task.run.acquisition
        return 0 if run is None else run.ring.written

    @property
    def curr_read_pos(self) -> int:
        """Number of the sample that is read next."""
        run = self._task.run.acquisition
        return 0 if run is None else run.position

    @property
    def overloaded_chans_exist(self) -> bool:
        """Whether any channel has been overloaded since this was last asked; asking clears the flags."""
        with self._task.chassis.changed:
            run = self._task.run.acquisition
            names = self._task.ai_channels.channel_names
            flags = [] if run is None else run.overloaded.tolist()
            self.__dict__["_overloaded"] = [name for name, flag in zip(names, flags, strict=False) if flag]
            if run is not None:
                run.overloaded[:] = False
            return bool(self._overloaded)

    @property
    def overloaded_chans(self) -> list[str]:
        """Names of the channels that were overloaded when `overloaded_chans_exist` was asked."""
        if self._overloaded is None:
            raise DaqError(
                "ask in_stream.overloaded_chans_exist first: it takes the flags that overloaded_chans names",
                DAQmxErrors.OVERLOADED_CHANS_EXIST_NOT_READ,
                self._task.name,
            )
        return list(self._overloaded)

    # Logging

    def configure_logging(
        self,
        file_path: str | Path,
        logging_mode: LoggingMode = LoggingMode.LOG_AND_READ,
        group_name: str = "",
        operation: LoggingOperation = LoggingOperation.OPEN_OR_CREATE,
    ) -> None:
        """Log what the task acquires, in its next runs.

        Parameters
        ----------
        file_path : str or Path
            A name ending in `.mcap` makes a recording, one in `.tdms` a TDMS file (with the package nptdms).
        logging_mode : LoggingMode
            LOG_AND_READ logs what the script reads, and what is left at the end; LOG logs by itself, and
            the script cannot read.
        group_name : str
            Group in a TDMS file; the task's name unless given.
        operation : LoggingOperation
            CREATE and CREATE_OR_REPLACE make a file, OPEN appends to a TDMS file; OPEN_OR_CREATE does either.
        """
        self.logging_file_path = file_path
        self.logging_mode, self.logging_tdms_operation = logging_mode, operation
        self.logging_tdms_group_name = group_name

    def start_new_file(self, file_path: str | Path) -> None:
        """Not available: a run of a task is logged into one file."""
        raise unsupported("in_stream.start_new_file", "Stop the task and configure logging anew.")

    # Reading

    def default_count(self) -> int:
        """Count what a read takes by default: all of a finite task, what is there of a continuous one."""
        task = self._task
        with task.chassis.changed:
            task.require_inputs()
            run = task.run.acquisition if task.is_running else None
            if task.timing.clocked and task.timing.finite and not self.read_all_avail_samp:
                samples = task.timing.samp_quant_samp_per_chan
                if run is None or run.plan.again:
                    return samples
                end = samples if run.trigger is None else run.first_readable + samples
                return max(end - run.position, 0) or samples
            if run is None:
                self._begin()
            if self._available() == 0 and task.is_running and not task.run.finished:
                task.chassis.clock.glance(task.chassis)
            return self._available()

    def fill(self, out: NDArray[Any], timeout: float, raw: bool = False) -> int:
        """Read samples into an array.

        Parameters
        ----------
        out : ndarray, shape (channels, n)
            Takes the samples; those that were read when an error occurs are there too.
        timeout : float
            Seconds to wait; 0 tries once, negative waits for ever.
        raw : bool
            Whether to give the converter's counts instead of readings in the channels' units.

        Returns
        -------
        int
            Samples per channel read, n.

        Raises
        ------
        DaqReadError
            With -200284 when time is up, -200279 when samples have been overwritten (reading goes on with
            the oldest left), -200278 beyond the end of a finite acquisition, or the reason why the
            acquisition stopped.
        """
        task = self._task
        chassis = task.chassis
        timeout = argument.seconds(timeout)
        with chassis.changed:
            task.require_inputs()
            if self.logging_mode is LoggingMode.LOG:
                raise DaqError(
                    "the task only logs (LoggingMode.LOG): to read as well, log with "
                    "LoggingMode.LOG_AND_READ",
                    DAQmxErrors.READ_NOT_SUPPORTED_FOR_LOGGING_MODE,
                    task.name,
                )
            if not task.timing.clocked:
                with task.reserved(), task.run.on_demand(out.shape[1]) as run:
                    return collect(task, run, self._rows(), out, timeout, raw)
            self._begin()
            assert task.run.acquisition is not None
            run = task.run.acquisition
            if timeout == 0:
                task.run.look("read")
            try:
                self._seek(run)
                return collect(task, run, self._rows(), out, timeout, raw)
            finally:
                task.after_read()

    def _begin(self) -> None:
        task = self._task
        if task.is_running or not task.timing.clocked:
            return
        if not self.auto_start:
            raise DaqError(
                "the task is not running, and in_stream.auto_start is off: call start() before reading",
                DAQmxErrors.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED,
                task.name,
            )
        task.start(automatic=True)

    def _seek(self, run: Acquisition) -> None:
        """Go to where reads begin, if the script has said so."""
        relative, position = self.relative_to, run.position
        if relative is ReadRelativeTo.CURRENT_READ_POSITION:
            position += self.offset
        elif relative is ReadRelativeTo.FIRST_SAMPLE:
            position = self.offset
        elif relative is ReadRelativeTo.MOST_RECENT_SAMPLE:
            position = max(0, run.ring.written + self.offset)
        elif run.plan.reference is None:
            raise DaqError(
                f"in_stream.relative_to is {relative.name}, but the task has no reference trigger",
                DAQmxErrors.NO_REF_TRIG_CONFIGURED,
                self._task.name,
            )
        elif run.trigger is not None:
            at_trigger = relative is ReadRelativeTo.REFERENCE_TRIGGER
            position = (run.trigger if at_trigger else run.first_readable) + self.offset
        if position < 0:
            raise DaqReadError(
                f"the read would begin {-position} samples before the first one: in_stream.relative_to is "
                f"{relative.name} and in_stream.offset {self.offset}",
                DAQmxErrors.NEGATIVE_READ_SAMPLE_NUMBER,
                0,
                self._task.name,
            )
        run.position = position

    def _rows(self) -> list[int]:
        collection = self._task.ai_channels
        chosen = collection.terminals if self._chosen is None else collection.find(self._chosen)
        return [collection.terminals.index(each) for each in chosen]

    def read(self, number_of_samples_per_channel: int = READ_ALL_AVAILABLE) -> NDArray[Any]:
        """Read converter counts, sample by sample: one array with all channels of a sample side by side."""
        count = number_of_samples_per_channel
        samples = self.default_count() if count == READ_ALL_AVAILABLE else count
        out = argument.room(self.num_chans, samples, np.int32)
        self.check_counts()
        got = self.fill(out, self.timeout, raw=True)
        return out[:, :got].T.ravel()

    def read_all(self) -> NDArray[Any]:
        """Read the converter counts of all that `read` takes by default."""
        return self.read()

    def check_counts(self) -> None:
        """Make sure that the converter gives counts.

        Raises
        ------
        DaqError
            With -200452, if the scene's converter is ideal.
        """
        if self._task.chassis.samples_dtype is not np.int32:
            raise unsupported(
                "an unscaled read",
                "The scene's converter has no counts: give it bits and a range, or read volts.",
            )
