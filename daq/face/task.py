"""Tasks: channels, timing and triggers that run together, as nidaqmx has them: its calls, defaults, errors.

One difference to hardware is meant: a task that runs refuses changes of its settings (-200479) instead of
taking some of them at some later time.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

from numpy.typing import ArrayLike

from daq.face import argument
from daq.face.channel_collections import AIChannelCollection, AOChannelCollection
from daq.face.constants import READ_ALL_AVAILABLE, EveryNSamplesEventType, TaskMode
from daq.face.events import Events
from daq.face.in_stream import InStream
from daq.face.out_stream import OutStream
from daq.face.task_run import TaskRun
from daq.face.timing import Timing
from daq.face.triggers import Triggers
from daq.face.virtual_channels import Channel
from daq.face.waveform import AnalogWaveform, waveforms
from daq.instrument.chassis import Chassis
from daq.instrument.connection import connected
from daq.instrument.errors import (
    DaqError,
    DAQmxErrors,
    DAQmxWarnings,
    DaqResourceWarning,
    DaqWarning,
    unsupported,
)

NUM_SAMPLES_UNSET: Any = object()
AUTO_START_UNSET: Any = object()

_handles = itertools.count(1)


class Task:
    """A task on the chassis.

    Parameters
    ----------
    new_task_name : str
        Name; one is made up if it is empty.
    chassis : Chassis, optional
        Where it runs; by default the one connected last (see `daq.connect`).
    """

    def __init__(self, new_task_name: str = "", *, chassis: Chassis | None = None) -> None:
        self.is_closed = True
        self.chassis = chassis if chassis is not None else connected()
        self.handle = next(_handles)
        self.name = self.chassis.admit(self, new_task_name)
        self.is_closed = self.is_running = False
        self.run = TaskRun(self)
        # The class of the warnings given: the real package's, where that is the face of this task.
        self.warning_type: Any = DaqWarning
        self._automatic = self._committed = False
        self.events = Events(self)
        self.ai_channels, self.ao_channels = AIChannelCollection(self), AOChannelCollection(self)
        self.timing, self.triggers = Timing(self), Triggers(self)
        self.in_stream, self.out_stream = InStream(self), OutStream(self)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise unsupported(f"Task.{name}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self.is_closed:
            self.close()

    def __del__(self) -> None:
        if not self.is_closed:
            warnings.warn(
                f"task {self.name!r} was not closed before it was lost; its modules may stay reserved. Use "
                "`with Task() as task:` or call close()",
                DaqResourceWarning,
                stacklevel=2,
            )

    # What it is

    @property
    def kind(self) -> str:
        """Direction of the task: "ai", "ao", or "" as long as it has no channels."""
        return "ai" if len(self.ai_channels) else "ao" if len(self.ao_channels) else ""

    @property
    def channels(self) -> Channel:
        """All channels, as one."""
        return self.ao_channels.all if self.kind == "ao" else self.ai_channels.all

    @property
    def channel_names(self) -> list[str]:
        """Names of the channels."""
        return self.channels.channel_names

    @property
    def number_of_channels(self) -> int:
        """Number of channels."""
        return len(self.channels)

    @property
    def devices(self) -> list[Any]:
        """The devices in use."""
        from daq.face.devices import Device

        return [Device(name, self.chassis) for name in self.channels.device_names]

    @property
    def number_of_devices(self) -> int:
        """Number of devices in use."""
        return len(self.channels.device_names)

    @property
    def device(self) -> str:
        """Name of the first device in use."""
        return next(iter(self.channels.device_names), "")

    def _require(self, code: DAQmxErrors, message: str, given: bool) -> None:
        if self.is_closed:
            raise DaqError(
                f"task {self.name!r} has been closed: make a new one", DAQmxErrors.INVALID_TASK, self.name
            )
        if not given:
            raise DaqError(message, code, self.name)

    def require_inputs(self) -> None:
        """Make sure that there is something to read (-200460)."""
        message = "the task has no input channels: add some with ai_channels.add_..."
        self._require(DAQmxErrors.READ_NO_INPUT_CHANS_IN_TASK, message, self.kind == "ai")

    def require_outputs(self) -> None:
        """Make sure that there is something to write to (-200459)."""
        message = "the task has no output channels: add one with ao_channels.add_ao_voltage_chan"
        self._require(DAQmxErrors.WRITE_NO_OUTPUT_CHANS_IN_TASK, message, self.kind == "ao")

    def check_idle(self, what: str) -> None:
        """Make sure that settings may be changed.

        Raises
        ------
        DaqError
            With -200479 while the task runs, -200088 when it has been closed.
        """
        self._require(
            DAQmxErrors.CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING,
            f"{what}: not while the task is running; call stop() first",
            not self.__dict__.get("is_running", False),
        )

    # Life

    def start(self, *, automatic: bool = False) -> None:
        """Start the task; its triggers are armed and its time passes from now on."""
        self.check_idle("start")
        message = "the task has no channels: add some before starting it"
        self._require(DAQmxErrors.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK, message, bool(self.kind))
        with self.chassis.changed:
            self._reserve()
            try:
                self.run.begin()
            except BaseException:
                self._end()
                raise
            self._automatic, self.is_running = automatic, True
            self.chassis.wake(self)
        self.events.begin()

    def _reserve(self) -> None:
        modules = tuple(f"{name}/ai" for name in self.channels.device_names)
        rate = self.timing.samp_clk_rate if self.timing.clocked else None
        self.chassis.reserve(self, ("ao0",) if self.kind == "ao" else modules, rate)

    def stop(self) -> None:
        """Stop the task; a finite one that is not done yet gives a DaqWarning (200010).

        Raises
        ------
        DaqError
            If the task had ended early and nobody has been told why.
        """
        self._require(DAQmxErrors.INVALID_TASK, "", True)
        if not self.is_running:
            return
        early = not self.run.endless and not self.run.finished
        failure = self.run.untold_failure
        self._stop()
        if early:
            warnings.warn(
                self.warning_type(
                    "a finite acquisition or generation was stopped before it was complete",
                    DAQmxWarnings.STOPPED_BEFORE_DONE,
                ),
                stacklevel=2,
            )
        if failure is not None:
            raise DaqError(failure.bare_message, failure.error_code, self.name)

    def _stop(self) -> None:
        # Callbacks end first, while what they read still comes.
        self.events.end()
        with self.chassis.changed:
            self._end()

    def _end(self) -> None:
        self.is_running = False
        if self._committed:
            self.chassis.running_inputs.pop(self, None)
            self.chassis.running_outputs.pop(self, None)
        else:
            self.chassis.release(self)
        self.run.end()

    def close(self) -> None:
        """Stop the task and give everything back; it cannot be used again."""
        if self.is_closed:
            return warnings.warn(f"task {self.name!r} was closed already", DaqResourceWarning, stacklevel=2)
        try:
            self._stop()
        finally:
            self.is_closed = True
            self.chassis.dismiss(self)

    clear = close

    def control(self, action: TaskMode) -> None:
        """Take a step of the task's life; COMMIT and RESERVE keep its modules until UNRESERVE or close."""
        action = argument.choice(TaskMode, action, "action")
        if action is TaskMode.TASK_START:
            self.start()
        elif action is TaskMode.TASK_STOP:
            self.stop()
        elif action is TaskMode.TASK_VERIFY:
            self.run.sources()
        elif action in (TaskMode.TASK_COMMIT, TaskMode.TASK_RESERVE):
            self.run.sources()
            self._reserve()
            self._committed = True
        else:
            self._committed = False
            self._stop()

    def is_task_done(self) -> bool:
        """Whether the task is done, or not running."""
        self._require(DAQmxErrors.INVALID_TASK, "", True)
        with self.chassis.changed:
            self.run.look("is_task_done")
            self.run.raise_failure()
            return not self.is_running or self.run.finished

    def wait_until_done(self, timeout: float = 10.0) -> None:
        """Wait until a finite task is done.

        Raises
        ------
        DaqError
            With -200560, if it is not done in time.
        """
        self._require(DAQmxErrors.INVALID_TASK, "", True)
        timeout = argument.seconds(timeout)
        with self.chassis.changed:
            done = not self.is_running or self.chassis.clock.wait(
                self.chassis, lambda: self.run.finished or not self.is_running, self.run.missing, timeout
            )
            self.run.raise_failure()
        if not done:
            raise DaqError(
                f"the task is not done after {timeout:g} s"
                + ("" if self.timing.finite else "; a continuous task never is: stop it")
                + ". Wait longer, or check that it is triggered",
                DAQmxErrors.WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE,
                self.name,
            )

    # Samples

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Have the modules for a moment, for input and output on demand."""
        with self.chassis.changed:
            self._reserve()
            self.chassis.wake(self)
            try:
                yield
            finally:
                if not (self.is_running or self._committed):
                    self.chassis.release(self)

    def read(self, number_of_samples_per_channel: int = NUM_SAMPLES_UNSET, timeout: float = 10.0) -> Any:
        """Read samples, starting the task if need be.

        Parameters
        ----------
        number_of_samples_per_channel : int, optional
            Samples per channel; READ_ALL_AVAILABLE (-1) takes all of a finite task, what is there of a
            continuous one.
        timeout : float
            Seconds to wait; 0 tries once, negative waits for ever.

        Returns
        -------
        float or list
            Without a number: a scalar, or one per channel. With a number: a list of samples, or one such
            list per channel. For arrays, use `daq.nidaqmx.stream_readers`.

        Raises
        ------
        DaqReadError
            See `InStream.fill`.
        """
        unset, count = number_of_samples_per_channel is NUM_SAMPLES_UNSET, number_of_samples_per_channel
        self.require_inputs()
        if unset:
            count = 1
        elif count == READ_ALL_AVAILABLE:
            count = self.in_stream.default_count()
        out = argument.room(self.in_stream.num_chans, count)
        self.in_stream.fill(out, timeout)
        data = (out[:, 0] if unset else out).tolist()
        return data[0] if len(data) == 1 else data

    def read_waveform(
        self, number_of_samples_per_channel: int = READ_ALL_AVAILABLE, timeout: float = 10.0
    ) -> AnalogWaveform | list[AnalogWaveform]:
        """Read samples with their times; one waveform, or one per channel."""
        self.require_inputs()
        every = number_of_samples_per_channel == READ_ALL_AVAILABLE
        count = self.in_stream.default_count() if every else number_of_samples_per_channel
        out = argument.room(self.in_stream.num_chans, count)
        self.in_stream.fill(out, timeout)
        found = waveforms(out, self)
        return found[0] if len(found) == 1 else found

    def write(self, data: ArrayLike, auto_start: bool = AUTO_START_UNSET, timeout: float = 10.0) -> int:
        """Write volts to the output.

        Parameters
        ----------
        data : float or array_like
            One sample, or samples of shape (n,), or (channels, n).
        auto_start : bool, optional
            Whether to start the task; by default for a single sample only.
        timeout : float
            Seconds to wait for room in the buffer; see `OutStream.put` for the errors.

        Returns
        -------
        int
            Samples per channel written.
        """
        self.require_outputs()
        samples = argument.table(getattr(data, "scaled_data", data), "data")
        channels = len(self.ao_channels)
        if samples.ndim < 2:
            samples = samples.reshape(channels, -1) if channels == 1 else samples.reshape(-1, 1)
        start = samples.shape[1] == 1 if auto_start is AUTO_START_UNSET else bool(auto_start)
        return self.out_stream.put(samples, start, timeout)

    def after_read(self) -> None:
        """Stop a finite task that a read has started and emptied."""
        run = self.run.acquisition
        if (
            self._automatic
            and self.is_running
            and run is not None
            and run.done
            and run.position >= run.readable
        ):
            self._stop()

    # Events

    def register_every_n_samples_acquired_into_buffer_event(
        self, sample_interval: int, callback_method: Callable[..., Any] | None
    ) -> None:
        """Call ``callback(task_handle, event_type, samples, data)`` whenever so many samples have come.

        See `daq.face.events` for the thread it is called on; None unregisters.
        """
        self.events.register_every(
            EveryNSamplesEventType.ACQUIRED_INTO_BUFFER, sample_interval, callback_method
        )

    def register_every_n_samples_transferred_from_buffer_event(
        self, sample_interval: int, callback_method: Callable[..., Any] | None
    ) -> None:
        """Call ``callback(task_handle, event_type, samples, data)`` for so many samples put out."""
        self.events.register_every(
            EveryNSamplesEventType.TRANSFERRED_FROM_BUFFER, sample_interval, callback_method
        )

    def register_done_event(self, callback_method: Callable[..., Any] | None) -> None:
        """Call ``callback(task_handle, status, data)`` when the task is done or has failed."""
        self.events.register_done(callback_method)
