"""The output of a task: its buffer, its generation, and writes that wait until the buffer has space.

The generation converts the samples of the buffer into the output voltages at each tick, a time step of the bench.
"""

from collections.abc import Sequence

from daq.core.virtual_bench.bench import samples_per_tick
from daq.extras.ni_device.chassis import UNLIMITED_TICKS, Chassis, Runner
from daq.extras.ni_device.engines.generation import Generation, OutputBuffer, OutputPlan
from daq.extras.ni_device.engines.triggers import Source
from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_device.plans import output_plan
from daq.extras.ni_device.settings.channels import Channel
from daq.extras.ni_device.settings.task_settings import TaskSettings
from rig.core.base.arrays import Array


class TaskOutput:
    """Counterpart of `TaskInput`, with its interface: an output is not retriggerable, and has no samples to read."""

    is_retriggerable, all_read = False, True

    def __init__(self, chassis: Chassis, settings: TaskSettings, task: Runner) -> None:
        self._chassis, self._settings, self._task = chassis, settings, task
        self.run: Generation | None = None  # current or last generation
        self.buffer: OutputBuffer | None = None  # written samples
        self._is_running = False
        self._has_played = False  # whether the samples of the buffer were output

    # States

    def start(self, start: Source | None, reference: Source | None) -> None:
        """Start the output of the buffer at the trigger `start`; an output has no reference trigger."""
        if self.buffer is None or self.buffer.written == 0:
            raise DaqError(
                "the output has no samples. Write samples before starting the task.", Code.OUTPUT_BUFFER_EMPTY
            )
        plan, clock_source = output_plan(self._settings, self._chassis, start)
        self.run = self._chassis.run_output(self._task, plan, self.buffer)
        self._is_running = self._has_played = True
        if clock_source is not None:
            self.run.start_if_clock_runs(self._chassis.event_tick(clock_source))

    def stop(self) -> None:
        """End the generation."""
        self._is_running = False
        if self.run is not None:
            self.run.stop()

    def clear(self) -> None:
        """Release the buffer."""
        self.run = self.buffer = None

    @property
    def memory(self) -> int:
        """Size of the buffer [bytes]."""
        return 0 if self.buffer is None else self.buffer.data.nbytes

    # Progress

    @property
    def samples_passed(self) -> int:
        """Samples per channel generated so far."""
        return 0 if self.run is None else self.run.generated

    def ticks_to_end(self) -> int:
        """Return a lower bound of the ticks until the generation is complete, by default those in 10 ms."""
        return max(1, int(self._chassis.rate / 100)) if self.run is None else self.run.ticks_to_end()

    def ticks_until(self, samples: int) -> int:
        """Return the number of ticks until the total number of generated samples is `samples`."""
        return UNLIMITED_TICKS if self.run is None or not self.run.has_started else self.run.ticks_until(samples)

    def ticks_until_log(self) -> int:
        """Return the number of ticks that may pass before `write_log` must be called."""
        return UNLIMITED_TICKS

    def write_log(self) -> None:
        """Do nothing: an output has no log."""

    @property
    def written(self) -> int:
        """Samples per channel written to the buffer."""
        return 0 if self.buffer is None else self.buffer.written

    @property
    def size(self) -> int:
        """Samples per channel that fit into the buffer."""
        return int(self._settings.groups["buffer"]["output_buf_size"]) if self.buffer is None else self.buffer.size

    @property
    def space(self) -> int:
        """Samples per channel for which the buffer has space."""
        if self.buffer is None:
            return self.size
        return min(self.buffer.space(self.samples_passed, self._is_running, self._settings.regenerates), 1 << 31)

    # Writes

    def write(self, volts: Array, timeout: float) -> int:
        """Write samples [V] when the buffer has space, within `timeout` s (negative: infinite); return the number."""
        if not self._is_running and (self.buffer is None or self._has_played):
            # The first write after a run starts a new buffer.
            settings = self._settings.groups["buffer"]
            size = int(settings["output_buf_size"]) if settings.was_set("output_buf_size") else None
            self.buffer, self._has_played = OutputBuffer(volts.shape[0], size), False
        assert self.buffer is not None
        buffer = self.buffer
        chassis, n_requested, n_written = self._chassis, volts.shape[1], 0
        start_s = chassis.clock.now(chassis)

        def current_run() -> Generation | None:
            return self.run if self._is_running else None

        def space() -> int:
            run = current_run()
            return buffer.space(0 if run is None else run.generated, self._is_running, self._settings.regenerates)

        def chunk_size() -> int:
            # A write may be longer than the buffer: it waits for half the buffer at a time.
            return min(n_requested - n_written, max(1, buffer.size // 2))

        while True:
            run = current_run()
            if run is not None and run.error is not None:
                raise DaqError(str(run.error), run.error.code, n_written)
            if run is not None and run.done:
                raise DaqError(
                    "the output has ended. Stop the task before writing again.",
                    Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN,
                    n_written,
                )
            n_accepted = min(space(), n_requested - n_written)
            if n_accepted > 0:
                buffer.write(volts[:, n_written : n_written + n_accepted], run is not None)
                n_written += n_accepted
                chassis.changed.notify_all()
            if n_written == n_requested:
                return n_written
            time_left = timeout if timeout < 0 else max(0.0, timeout - (chassis.clock.now(chassis) - start_s))

            def ready() -> bool:
                run = current_run()
                return run is None or run.done or space() >= chunk_size()

            if run is None or not chassis.wait(ready, lambda: chunk_size() - space(), time_left):
                cause, remedy = "the timeout has expired", "Increase the timeout"
                if run is None:
                    cause, remedy = "the task is not running", "Start the task"
                raise DaqError(
                    f"{n_written} of {n_requested} samples per channel were written: the buffer is full, and {cause}. "
                    f"{remedy}, write fewer samples at a time, or enlarge out_stream.output_buf_size.",
                    Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN,
                    n_written,
                )

    def write_on_demand(self, volts: Array) -> int:
        """Output samples [V] at the tick rate, and keep the last value; return the number of samples per channel."""
        chassis, bench_indices = self._chassis, [channel.bench_index for channel in self._settings.channels]
        if volts.shape[1] > 1:
            buffer = OutputBuffer(volts.shape[0], None)
            buffer.write(volts, is_running=False)
            bench_samples_per_tick = samples_per_tick(chassis.bench.rate, chassis.rate)
            plan = OutputPlan(tuple(bench_indices), chassis.rate, bench_samples_per_tick, volts.shape[1], False)
            run = chassis.run_output(self._task, plan, buffer)
            chassis.wait(lambda: run.done, run.ticks_to_end, -1.0)
            chassis.halt(self._task)
            if run.error is not None:
                raise run.error
        elif volts.shape[1]:
            chassis.last_volts[bench_indices] = volts[:, 0]
        return volts.shape[1]


def check_volts(channels: Sequence[Channel], volts: Array) -> None:
    """Raise `DaqError` -200524 if the shape of samples is not (channels, n), -200561 if they exceed the limits [V]."""
    if volts.ndim != 2 or volts.shape[0] != len(channels):
        raise DaqError(
            f"the data have {volts.shape[0]} channels, the task has {len(channels)}. Write a row for each channel.",
            Code.WRITE_NUM_CHANS_MISMATCH,
        )
    for channel, row in zip(channels, volts, strict=True):
        low, high = channel.settings["ao_min"], channel.settings["ao_max"]
        # The negated comparison also rejects NaN.
        is_outside = ~((row >= low) & (row <= high))
        if is_outside.any():
            raise DaqError(
                f"{channel.name}: {row[is_outside][0]:g} V is outside the limits, {low:g} to {high:g} V. Write "
                "voltages within the limits, or extend the limits.",
                Code.INVALID_AO_DATA_WRITE,
                samples_done=0,
            )
