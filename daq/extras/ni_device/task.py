"""Tasks of clients, as in NI-DAQmx: settings (channels, timing, triggers, streams), states, reads and writes.

A run lasts from the start of a task to its stop. Only a task with a sample clock has runs; without a sample clock, each
read or write takes its samples immediately (on demand).
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.clock import normalize_timeout
from daq.extras.ni_device.engines.acquisition import Acquisition
from daq.extras.ni_device.engines.generation import Generation
from daq.extras.ni_device.engines.ring_buffer import allocate
from daq.extras.ni_device.engines.triggers import OtherTask
from daq.extras.ni_device.errors import STOPPED_BEFORE_DONE, Code, DaqError, invalid_value
from daq.extras.ni_device.events import Events
from daq.extras.ni_device.plans import check_timing, trigger_sources
from daq.extras.ni_device.settings.scales import Scale
from daq.extras.ni_device.settings.task_settings import TaskSettings
from daq.extras.ni_device.task_input import ReadResult, TaskInput, missing_trigger
from daq.extras.ni_device.task_output import TaskOutput, check_volts
from daq.extras.ni_device.values import TaskMode
from rig.core.base.arrays import Array


class Task:
    """A task on the chassis: settings, an input or an output, events, and its state.

    An empty `name` is replaced with a generated name. `scales` are the custom scales that its channels may use.
    """

    def __init__(self, chassis: Chassis, name: str, scales: Mapping[str, Scale]) -> None:
        self.chassis, self.settings = chassis, TaskSettings(chassis.devices.module, scales)
        # A task with input channels uses `input`, a task with output channels `output`.
        self.input = TaskInput(chassis, self.settings, self)
        self.output = TaskOutput(chassis, self.settings, self)
        self.events = Events()
        self.running = self.closed = False
        self._was_started_by_read = False
        self._is_committed = False  # modules remain reserved after a stop
        self._was_failure_raised = False  # the error that ended the run has been raised
        self._query_positions: dict[str, int] = {}  # tick of the last query of each quantity
        self.name = ""
        self.name = chassis.register(self, name)

    # Description

    @property
    def sample_rate(self) -> float | None:
        """Sample rate of the inputs, S/s; None on demand, or without inputs."""
        if self.settings.direction != "ai" or not self.settings.channels or not self.settings.has_sample_clock:
            return None
        try:
            return self.settings.rate
        except DaqError:
            return None

    def check_idle(self, operation: str, code: Code = Code.CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING) -> None:
        """Raise `DaqError` with the code if the task is running."""
        if self.running:
            raise DaqError(f"{operation} is not possible while the task is running. Call stop() first.", code)

    # States

    def verify(self) -> None:
        """Check that the settings are consistent."""
        check_timing(self.settings)
        trigger_sources(self.settings, self.chassis)

    def start(self, by_read: bool = False) -> None:
        """Start the task, or arm its start trigger, and keep bench time running; `by_read`: a read starts the task."""
        self.check_idle("starting")
        self._announce("start")
        if not self.settings.channels:
            raise DaqError(
                "the task has no channels. Add a channel before starting it.",
                Code.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK,
            )
        with self.chassis.changed:
            self.reserve()
            try:
                self.chassis.keep_time_running(self)
                self._run()
            except BaseException:
                self.end()
                raise
            self._was_started_by_read, self.running, self._was_failure_raised = by_read, True, False

    def reserve(self) -> None:
        """Reserve the modules and outputs that the task needs; see `Chassis.reserve`."""
        if self.settings.direction == "ao":
            self.chassis.reserve(self, {channel.bench_index: channel.port.name for channel in self.settings.channels})
        else:
            self.chassis.reserve(self, {f"{name}/ai": f"{name}/ai" for name in self.settings.device_names})

    def _run(self) -> None:
        self.verify()
        self._check_event_interval()
        self.input.run = self.output.run = None
        self.events.begin()
        if self.settings.has_sample_clock:
            self._active_part.start(*trigger_sources(self.settings, self.chassis))

    def _check_event_interval(self) -> None:
        """Raise `DaqError` -200877 if the interval of events does not divide the buffer size of a device with DMA."""
        interval, stream = (
            self.events.interval,
            "in_stream.input" if self.settings.direction == "ai" else "out_stream.output",
        )
        size = self.settings.input_buffer_size if self.settings.direction == "ai" else self.output.size
        if interval and size % interval and self.settings.channels[0].module.uses_dma:
            raise DaqError(
                f"the buffer of {size} samples is not a multiple of the {interval} samples between two events, which "
                f"DMA requires. Change {stream}_buf_size, samps_per_chan or the interval.",
                Code.BUFFER_SIZE_NOT_MULTIPLE_OF_EVERY_N_SAMPS_EVENT_INTERVAL_WHEN_DMA,
            )

    def stop(self) -> int:
        """Stop the task; return warning 200010 if it is incomplete, otherwise 0; raise an error that ended the run."""
        if not self.running:
            return 0
        is_early = not self.runs_until_stopped and not self.finished
        failure = None if self._was_failure_raised else self.failure
        self.end()
        if failure is not None:
            raise failure
        return STOPPED_BEFORE_DONE if is_early else 0

    def end(self) -> None:
        """End the current run, if any; release its modules unless the task is committed."""
        with self.chassis.changed:
            self.running = False
            if self._is_committed:
                self.chassis.halt(self)
            else:
                self.chassis.release(self)
            self._active_part.stop()

    def close(self) -> None:
        """Stop the task and release its resources; it cannot be used again."""
        if self.closed:
            return
        try:
            self.end()
        finally:
            self.closed = True
            self.events.close()
            self.chassis.unregister(self)

    def control(self, action: int) -> int:
        """Apply a `TaskMode` such as START, STOP or COMMIT to the task; return the status of `stop`, otherwise 0.

        COMMIT and RESERVE keep its modules reserved until UNRESERVE or ABORT.
        """
        if action not in list(TaskMode):
            raise invalid_value(f"there is no task mode {action}. Choose {', '.join(mode.name for mode in TaskMode)}.")
        if action == TaskMode.START:
            self.start()
        elif action == TaskMode.STOP:
            return self.stop()
        elif action == TaskMode.VERIFY:
            self.verify()
        elif action in (TaskMode.COMMIT, TaskMode.RESERVE):
            self.verify()
            self.reserve()
            self._is_committed = True
        else:
            self._is_committed = False
            self.end()
        return 0

    @property
    def _active_part(self) -> TaskInput | TaskOutput:
        """The output of a task with output channels, otherwise the input."""
        return self.output if self.settings.direction == "ao" else self.input

    @property
    def run(self) -> Acquisition | Generation | None:
        """The current run, or the last run; None before the first."""
        return self._active_part.run

    @property
    def finished(self) -> bool:
        """Whether the current or last run is complete, or was ended by an error."""
        return self.run is not None and self.run.done

    @property
    def runs_until_stopped(self) -> bool:
        """Whether the task has no end: it is continuous, retriggerable or on demand."""
        return not self.settings.has_sample_clock or not self.settings.is_finite or self._active_part.is_retriggerable

    @property
    def memory(self) -> int:
        """Size of all buffers [bytes]."""
        return self.input.memory + self.output.memory

    def free_memory(self) -> None:
        """End the run and release its buffers."""
        with self.chassis.changed:
            self.end()
            self.input.clear()
            self.output.clear()

    @property
    def failure(self) -> DaqError | None:
        """Error that ended the current or last run; None without an error."""
        return None if self.run is None else self.run.error

    def raise_failure(self) -> None:
        """Raise the error that ended the run, if any, at every call until the task is stopped."""
        if self.failure is not None and self.running:
            self._was_failure_raised = True
            raise self.failure

    def note_query(self, query: str) -> None:
        """Record that a script has queried the progress of the run; `query`: name of the queried quantity.

        A script that repeats a query at the same bench time is polling: the fast clock then lets a short time pass.
        """
        chassis = self.chassis
        is_repeated = self._query_positions.get(query) == chassis.position
        if is_repeated and self.running and not self.finished:
            chassis.clock.pass_query(chassis)
        self._query_positions[query] = chassis.position

    def is_done(self) -> bool:
        """Return whether the task is done or not running; a task without a sample clock is always done."""
        with self.chassis.changed:
            self.note_query("is_task_done")
            self.raise_failure()
            return not self.running or self.finished or not self.settings.has_sample_clock

    def wait_until_done(self, timeout: float) -> None:
        """Wait until a finite task is done. Raises `DaqError` -200560 after the timeout."""
        timeout = normalize_timeout(timeout)
        with self.chassis.changed:
            is_done = (
                not self.running
                or not self.settings.has_sample_clock
                or self.chassis.wait(lambda: self.finished or not self.running, self._active_part.ticks_to_end, timeout)
            )
            self.raise_failure()
        if not is_done:
            remedy = "Wait longer, or check its trigger."
            if not self.settings.is_finite:
                remedy = "A continuous task does not end by itself. Stop it."
            raise DaqError(
                f"the task is not done after {timeout:g} s{missing_trigger(self.run)}. {remedy}",
                Code.WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE,
            )

    # Interface for the chassis (`Runner`)

    @property
    def device(self) -> str:
        """Name of the first device in use."""
        return self.settings.device

    def provides(self, source: OtherTask) -> bool:
        """Return whether a trigger terminal is on the device of the task."""
        owner = self.chassis.terminal_owner(self.settings.channels[0].module)
        return not (owner and source.owner) or owner == source.owner

    def max_ticks(self) -> int:
        """Return the number of ticks that may pass before `notify_samples` must be called."""
        part = self._active_part
        log_ticks = part.ticks_until_log()
        due = None if self.chassis.clock.is_free_running else self.events.next_due(part.samples_passed)
        return log_ticks if due is None else min(log_ticks, part.ticks_until(due))

    def notify_samples(self) -> bool:
        """Log new samples and send events; return whether a callback must finish before the next samples."""
        self._active_part.write_log()
        return self.running and self.events.notify(self._active_part.samples_passed, self.run)

    @property
    def callback_finished(self) -> bool:
        """Whether the callback for `notify_samples` has finished: all samples have been read."""
        return not self.running or self._active_part.all_read

    # Samples

    def read(
        self, samples: int, timeout: float, raw: bool = False, check: Callable[[int], None] = lambda samples: None
    ) -> ReadResult:
        """Read samples per channel; start the task if necessary.

        `samples`: -1 reads all samples of a finite task, or the available samples of a continuous task; `timeout`: s, 0
        checks once, a negative timeout is infinite; `raw`: return the counts of the converter; `check`: called with the
        number of samples before the read, may raise an exception. The result has the samples before an error, and the
        error: -200284 after the timeout, -200279 if samples were overwritten (the next read begins with the oldest
        stored sample), -200278 after the end of a finite acquisition, else the error that ended the acquisition.
        """
        timeout = normalize_timeout(timeout)
        with self.chassis.changed:
            self.settings.require("ai")
            self.input.check_readable()
            self._announce("read")
            if samples < 0:
                samples = self.default_count()
            check(samples)
            result = self._read(samples, timeout, raw)
            self._report_transfer(result.samples, result.error)
            return result

    def _read(self, samples: int, timeout: float, raw: bool) -> ReadResult:
        """Read a number of samples; see `read`."""
        indices = self.settings.indices_to_read()
        out = allocate(len(indices), samples, np.int32 if raw else np.float64)
        if not self.settings.has_sample_clock:
            with self._on_demand():
                return self.input.read_on_demand(indices, out, timeout, raw)
        self._start_for_read()
        if timeout == 0:
            self.note_query("read")
        try:
            result = self.input.read(indices, out, timeout, raw)
            self._was_failure_raised |= result.error is not None and result.error is self.failure
            return result
        finally:
            # A read that started a finite task and read all its samples also stops it.
            if self._was_started_by_read and self.running and self.finished and self.input.all_read:
                self.end()

    def write(self, volts: Array, auto_start: bool, timeout: float) -> int:
        """Write samples [V], shape (channels, n); return the number of samples per channel written.

        Raises `DaqError` -200292 after the timeout, -200561 for samples beyond the limits of a channel, -200524 for
        a wrong number of channels, or the error that ended the generation.
        """
        timeout = normalize_timeout(timeout)
        self.settings.require("ao")
        check_volts(self.settings.channels, volts)
        with self.chassis.changed:
            self._announce("write")
            try:
                written = self._write(volts, auto_start, timeout)
            except DaqError as error:
                self._report_transfer(volts[:, : error.samples_done or 0], error)
                raise
            self._report_transfer(volts[:, :written], None)
            if auto_start and self.settings.has_sample_clock and not self.running:
                self.start()
            return written

    def _write(self, volts: Array, auto_start: bool, timeout: float) -> int:
        """Write samples without starting the task; see `write`."""
        if self.settings.has_sample_clock:
            try:
                return self.output.write(volts, timeout)
            except DaqError:
                self._was_failure_raised |= self.running and self.failure is not None
                raise
        if not (auto_start or self.running):
            raise DaqError(
                "the task is not running, and auto_start is False. Call start() before writing.",
                Code.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED,
            )
        with self._on_demand():
            return self.output.write_on_demand(volts)

    def _announce(self, call: str) -> None:
        """Call the listeners of the chassis before a call of the task; a `DaqError` of a listener ends the call."""
        for listener in self.chassis.call_listeners:
            listener(call, self)

    def _report_transfer(self, samples: Array, error: DaqError | None) -> None:
        """Report the samples of a read or write to the listeners of the chassis."""
        for listener in self.chassis.transfer_listeners:
            listener(self, samples, error)

    @contextmanager
    def _on_demand(self) -> Iterator[None]:
        """Reserve the modules and keep bench time running while the `with` block samples without a sample clock."""
        self.verify()
        self.reserve()
        try:
            self.chassis.keep_time_running(self)
            yield
        finally:
            if not (self.running or self._is_committed):
                self.chassis.release(self)

    def default_count(self) -> int:
        """Return the unread samples of a finite task, or those available now, for a read without a number."""
        settings = self.settings
        settings.require("ai")
        if not settings.has_sample_clock:
            return 1
        run = self.input.run if self.running else None
        if settings.is_finite and not settings.groups["read"]["read_all_avail_samp"]:
            record_length = settings.samples_per_channel
            if run is None or run.plan.is_retriggerable:
                return record_length
            end = run.first_readable + record_length
            return max(end - run.position, 0) or record_length
        if run is None:
            self._start_for_read()
            run = self.input.run
            assert run is not None
        if run.readable_end <= run.position and self.running and not run.done:
            self.chassis.clock.pass_query(self.chassis)
        return max(0, run.readable_end - run.position)

    @property
    def raw_width(self) -> int:
        """Size of the integer type of the converter's counts [bytes]."""
        return 2 if all((channel.module.bits or 32) <= 16 for channel in self.settings.channels) else 4

    def _start_for_read(self) -> None:
        """Start the task for a read. Raises `DaqError` -200473 if the script has disabled the automatic start."""
        if self.running or not self.settings.has_sample_clock:
            return
        if not self.settings.groups["read"]["auto_start"]:
            raise DaqError(
                "the task is not running, and in_stream.auto_start is False. Call start() before reading.",
                Code.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED,
            )
        self.start(by_read=True)

    def start_new_file(self, path: str) -> None:
        """Continue the log in another file; the next run also logs into this file."""
        with self.chassis.changed:
            self.input.start_new_file(Path(path))
            self.settings.groups["read"]["logging_file_path"] = path
