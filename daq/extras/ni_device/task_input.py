"""The input of a task: its acquisition, its log, and the reads that wait for samples.

The acquisition stores samples in a buffer, the log in a file. The read position is the index of the sample that the
next read returns first.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.extras.ni_device.chassis import UNLIMITED_TICKS, Chassis, Runner
from daq.extras.ni_device.engines.acquisition import Acquisition
from daq.extras.ni_device.engines.generation import Generation
from daq.extras.ni_device.engines.log import TaskLog, open_log
from daq.extras.ni_device.engines.triggers import Pulses, Source
from daq.extras.ni_device.errors import Code, DaqError, unsupported
from daq.extras.ni_device.plans import input_plan
from daq.extras.ni_device.settings.channels import Channel
from daq.extras.ni_device.settings.task_settings import TaskSettings
from daq.extras.ni_device.values import LoggingMode, RelativeTo


@dataclass
class ReadResult:
    """Result of a read."""

    samples: NDArray[Any]  # shape (channels, n)
    first: int = 0  # index in the acquisition of the first sample that was read
    error: DaqError | None = None  # error that is the reason for fewer samples than requested


class TaskInput:
    """The input of a task."""

    def __init__(self, chassis: Chassis, settings: TaskSettings, task: Runner) -> None:
        self._chassis, self._settings, self._task = chassis, settings, task
        self.run: Acquisition | None = None  # current or last acquisition
        self.log: TaskLog | None = None  # log of the current acquisition
        self._overloaded_names: list[str] | None = None  # overloaded channels; None before a query

    # States

    def start(self, start: Source | None, reference: Source | None) -> None:
        """Start an acquisition, and its log; `start` and `reference` are the sources of its triggers."""
        chassis, read = self._chassis, self._settings.groups["read"]
        chassis.set_conditioning(self._task, self._settings.channels)
        plan = input_plan(self._settings, chassis.bench, start, reference)
        self.run = chassis.run_input(self._task, plan)
        if read["logging_mode"] == LoggingMode.OFF or not read["logging_file_path"]:
            return
        first_tick, ticks_per_sample = chassis.position, chassis.rate / plan.rate

        def time_ns(sample: int) -> int:
            return chassis.time_ns(first_tick + round(sample * ticks_per_sample))

        self.log = open_log(self._task.name, self._settings, chassis.bench, plan, time_ns)

    def stop(self) -> None:
        """End the acquisition, and its log."""
        log, self.log = self.log, None
        if self.run is not None:
            self.run.stop()
            if log is not None:
                log.close(self.run)

    def clear(self) -> None:
        """Release the buffers."""
        self.run = None

    @property
    def memory(self) -> int:
        """Size of the buffers [bytes]."""
        return 0 if self.run is None else self.run.ring.bytes + self.run.overloads.bytes

    @property
    def is_retriggerable(self) -> bool:
        """Whether the start trigger is re-armed after each complete record."""
        return self.run is not None and self.run.plan.is_retriggerable

    # Progress

    @property
    def samples_passed(self) -> int:
        """Samples per channel acquired so far."""
        return 0 if self.run is None else self.run.ring.written

    @property
    def all_read(self) -> bool:
        """Whether all samples have been read."""
        return self.run is None or self.run.position >= self.run.readable_end

    def ticks_to_end(self) -> int:
        """Return a lower bound of the ticks until the acquisition is complete; if it has no end, the ticks in 10 ms."""
        run = self.run
        if run is None or run.plan.samples is None or run.plan.is_retriggerable:
            return max(1, int(self._chassis.rate / 100))
        return run.ticks_until(run.samples_to_wait(run.plan.samples - run.position), self._chassis.position)

    def ticks_until(self, samples: int) -> int:
        """Return the number of ticks until the total number of acquired samples is `samples`."""
        if self.run is None:
            return UNLIMITED_TICKS
        return self.run.ticks_until(samples - self.samples_passed, self._chassis.position)

    def ticks_until_log(self) -> int:
        """Return the number of ticks that may pass before the log must be written."""
        if self.run is None or self.log is None or not self.log.logs_only or self.run.done:
            return UNLIMITED_TICKS
        return self.run.ticks_until(self.run.plan.buffer_size, self._chassis.position)

    def write_log(self) -> None:
        """Write new samples to the log if the task only logs; if writing fails, the acquisition ends with the error."""
        if self.run is not None and self.log is not None and self.log.logs_only:
            try:
                self.log.write_new(self.run)
            except DaqError as error:
                self.run.stop(error)
            self.run.position = max(self.run.position, self.run.readable_end)

    def start_new_file(self, path: Path) -> None:
        """Continue the log in another file; without a log, do nothing."""
        if self.log is not None and self.run is not None:
            self.log.start_new_file(path, self.run)

    def time_of_sample(self, sample: int) -> int:
        """Return the time of a sample of the last acquisition [ns]; without an acquisition the current time."""
        run, chassis = self.run, self._chassis
        if run is None:
            return chassis.time_ns(chassis.position)
        return chassis.time_ns(run.tick_at(run.instant_of(sample)))

    # Overloads

    def overloaded_exist(self) -> bool:
        """Return whether any channel was overloaded since the last query."""
        flags = [] if self.run is None else self.run.overloaded.tolist()
        names = [channel.name for channel in self._settings.channels]
        self._overloaded_names = [name for name, flag in zip(names, flags, strict=False) if flag]
        if self.run is not None:
            self.run.overloaded[:] = False
        return bool(self._overloaded_names)

    def overloaded(self) -> list[str]:
        """Return the names of the channels that `overloaded_exist` reported."""
        if self._overloaded_names is None:
            raise DaqError(
                "overloaded_chans is not available yet. Read in_stream.overloaded_chans_exist first.",
                Code.OVERLOADED_CHANS_EXIST_NOT_READ,
            )
        return list(self._overloaded_names)

    # Reads

    def check_readable(self) -> None:
        """Raise `DaqError` -201301 if the task only logs."""
        if self._settings.groups["read"]["logging_mode"] == LoggingMode.LOG:
            raise DaqError(
                "the task only logs (LoggingMode.LOG). To read as well, log with LoggingMode.LOG_AND_READ.",
                Code.READ_NOT_SUPPORTED_FOR_LOGGING_MODE,
            )

    def read_on_demand(self, indices: Sequence[int], out: NDArray[Any], timeout: float, raw: bool) -> ReadResult:
        """Acquire samples immediately, at the rate of the bench; see `_collect`."""
        chassis = self._chassis
        chassis.set_conditioning(self._task, self._settings.channels)
        plan = input_plan(self._settings, chassis.bench, None, None, on_demand=out.shape[1])
        self.run = chassis.run_input(self._task, plan)
        try:
            return self._collect(self.run, indices, out, timeout, raw)
        finally:
            chassis.halt(self._task)
            self.run = None

    def read(self, indices: Sequence[int], out: NDArray[Any], timeout: float, raw: bool) -> ReadResult:
        """Read from the position that the script has set; see `_collect`."""
        assert self.run is not None
        self._seek(self.run)
        return self._collect(self.run, indices, out, timeout, raw)

    def _seek(self, run: Acquisition) -> None:
        """Set the read position; `DaqError` -200277: before the first sample, -200282: no reference trigger."""
        settings = self._settings.groups["read"]
        origin, offset = RelativeTo(settings["relative_to"]), settings["offset"]
        position = run.position
        if origin == RelativeTo.CURRENT_READ_POSITION:
            position += offset
        elif origin == RelativeTo.FIRST_SAMPLE:
            position = offset
        elif origin == RelativeTo.MOST_RECENT_SAMPLE:
            position = max(0, run.ring.written + offset)
        elif run.plan.reference is None:
            raise DaqError(
                f"in_stream.relative_to is {origin.name}, but the task has no reference trigger. Configure a "
                "reference trigger, or choose another relative_to.",
                Code.NO_REF_TRIG_CONFIGURED,
            )
        elif run.trigger_sample is not None:
            is_at_trigger = origin == RelativeTo.REFERENCE_TRIGGER
            position = (run.trigger_sample if is_at_trigger else run.first_readable) + offset
        if position < 0:
            raise DaqError(
                f"the read would begin {-position} samples before the first sample: in_stream.relative_to is "
                f"{origin.name} and in_stream.offset is {offset}. Increase the offset.",
                Code.NEGATIVE_READ_SAMPLE_NUMBER,
                samples_done=0,
            )
        run.position = position

    def _collect(
        self, run: Acquisition, indices: Sequence[int], out: NDArray[Any], timeout: float, raw: bool
    ) -> ReadResult:
        """Read from the current position into `out`, shape (len(indices), n), and return the filled part.

        `indices` are the indices of the channels in the task. `raw` reads counts of the converter. See `Task.read` for
        `timeout` and errors. The caller holds the lock of the chassis.
        """
        chassis, channels = self._chassis, self._settings.channels
        n_requested, start_s, n_read, first = out.shape[1], chassis.clock.now(chassis), 0, run.position

        def chunk_size() -> int:
            # A read may be longer than the buffer: it waits for half the buffer at a time.
            return min(n_requested - n_read, max(1, run.plan.buffer_size // 2))

        def result(error: DaqError | None) -> ReadResult:
            return ReadResult(out[:, :n_read], first, error)

        while True:
            if lost := run.skip_lost():
                return result(
                    DaqError(
                        f"{lost} samples per channel were overwritten before they were read; the next read begins "
                        "with the oldest stored sample. Read more often or more at a time, or enlarge "
                        "in_stream.input_buf_size.",
                        Code.SAMPLES_NO_LONGER_AVAILABLE,
                    )
                )
            n_available = min(run.readable_end - run.position, n_requested - n_read)
            if n_available > 0:
                first = first if n_read else run.position
                samples = run.read_next(n_available)
                for row, index in enumerate(indices):
                    taken = samples[index]
                    values = _to_counts(channels[index], taken) if raw else run.plan.to_units(index, taken)
                    out[row, n_read : n_read + n_available] = values
                n_read += n_available
                if self.log is not None:
                    try:
                        self.log.write_new(run)
                    except DaqError as error:
                        return result(error)
            if n_read == n_requested:
                return result(None)
            if run.done and run.readable_end <= run.position:
                # A read that ends with the acquisition is complete; an error is reported if it has no sample at all.
                no_samples_left = DaqError(
                    "the acquisition has ended and all its samples have been read. Read fewer samples, acquire more "
                    "(samps_per_chan), or stop and start the task to acquire again.",
                    Code.SAMPLES_WILL_NEVER_BE_AVAILABLE,
                )
                return result(None if n_read and run.error is None else run.error or no_samples_left)
            time_left = timeout if timeout < 0 else max(0.0, timeout - (chassis.clock.now(chassis) - start_s))
            ready = chassis.wait(
                lambda: run.done or run.readable_end - run.position >= chunk_size(),
                lambda: run.ticks_until(run.samples_to_wait(chunk_size()), chassis.position),
                time_left,
            )
            if not ready and run.readable_end <= run.position:
                return result(
                    DaqError(
                        f"only {n_read} of {n_requested} samples per channel were acquired within {timeout:g} s"
                        f"{missing_trigger(run)}. Increase the timeout, read fewer samples, or check the triggers.",
                        Code.SAMPLES_NOT_YET_AVAILABLE,
                    )
                )


def _to_counts(channel: Channel, samples: NDArray[Any]) -> NDArray[Any]:
    """Convert samples to counts; samples are in volts only if the scene's converter is ideal."""
    if np.issubdtype(samples.dtype, np.integer):
        return samples
    bits = channel.module.bits
    if bits is None or not np.isfinite(channel.range):
        raise unsupported(
            "an unscaled read",
            "The scene's converter has no counts. Set converter.bits and converter.range in the scene, or read volts.",
        )
    full_scale = 2.0 ** (bits - 1)
    return np.clip(np.rint(samples / channel.range * full_scale), -full_scale, full_scale - 1)


def missing_trigger(run: Acquisition | Generation | None) -> str:
    """Return a note for an error message about the trigger that has not occurred; empty if all have occurred."""
    role, trigger = "", None
    if run is not None and not run.has_started:
        role, trigger = "start", run.plan.start
    elif isinstance(run, Acquisition) and run.trigger_sample is None:
        role, trigger = "reference", run.plan.reference
    if trigger is None:
        return ""
    reason = ""
    if isinstance(trigger, Pulses) and not trigger.frequency:
        reason = f": the bench has no pulses at {trigger.terminal}"
    return f" (the {role} trigger has not occurred{reason})"
