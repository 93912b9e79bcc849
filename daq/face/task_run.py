"""What a task is doing: made from its settings when it starts, kept for its counters after it has stopped."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from daq.face.constants import LoggingMode, OverwriteMode, TriggerType
from daq.face.task_log import TaskLog, open_log
from daq.face.triggers import OtherTask, ReferenceTrigger, StartTrigger, digital_source
from daq.instrument.acquisition import Acquisition, AnalogSource, InputPlan, Source
from daq.instrument.errors import DaqError, DAQmxErrors, unsupported
from daq.instrument.generation import Generation, OutputPlan

if TYPE_CHECKING:
    from daq.face.task import Task


class TaskRun:
    """The running side of a task.

    Parameters
    ----------
    task : Task
        The task.

    Attributes
    ----------
    acquisition : Acquisition or None
        Of an input task: the current run, or the last one.
    generation : Generation or None
        Of an output task: the current run, or the last one.
    failure_told : bool
        Whether the script has heard why the run ended early.
    """

    def __init__(self, task: Task) -> None:
        self._task = task
        self.acquisition: Acquisition | None = None
        self.generation: Generation | None = None
        self.failure_told = False
        self._log: TaskLog | None = None
        self._looked: dict[str, int] = {}

    def look(self, question: str) -> None:
        """Hear that a script asks how far the run has come.

        A script that asks the same again although nothing has passed waits in a loop of its own: a clock
        that moves only while somebody waits then lets a little time pass.
        """
        chassis = self._task.chassis
        with chassis.changed:
            again = self._looked.get(question) == chassis.position
            if again and self._task.is_running and not self.finished:
                chassis.clock.glance(chassis)
            self._looked[question] = chassis.position

    @property
    def samples_passed(self) -> int:
        """Samples per channel acquired or put out since the start."""
        if self.generation is not None:
            return self.generation.generated
        return 0 if self.acquisition is None else self.acquisition.ring.written

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end."""
        run = self.acquisition or self.generation
        return run is not None and run.done

    @property
    def endless(self) -> bool:
        """Whether it goes on until it is stopped."""
        timing = self._task.timing
        again = self.acquisition is not None and self.acquisition.plan.again
        return not timing.clocked or not timing.finite or again

    @property
    def failure(self) -> DaqError | None:
        """Why the run ended early."""
        run = self.acquisition or self.generation
        return None if run is None else run.error

    @property
    def untold_failure(self) -> DaqError | None:
        """Why the run ended early, unless the script has heard of it."""
        return None if self.failure_told else self.failure

    def raise_failure(self) -> None:
        """Raise the reason why the run ended early, as often as somebody asks until the task is stopped."""
        failure = self.failure
        if failure is not None and self._task.is_running:
            self.failure_told = True
            raise DaqError(failure.bare_message, failure.error_code, self._task.name)

    def missing(self) -> int:
        """Ticks that must pass at least until the run is complete."""
        if self.generation is not None:
            return self.generation.missing()
        run = self.acquisition
        if run is None or run.plan.samples is None or run.plan.again:
            return max(1, int(self._task.chassis.rate / 100))
        return run.missing(run.plan.samples - run.position)

    def last_read(self, count: int) -> tuple[int, int]:
        """Tell the number of the first of the `count` samples just read, and its time in ns."""
        chassis, run = self._task.chassis, self.acquisition
        if run is None:
            return 0, chassis.time_ns(chassis.position - count)
        first = run.position - count
        return first, chassis.time_ns(run.tick_of(first))

    # Beginning and end

    def begin(self) -> None:
        """Arm the triggers; the bench brings the samples."""
        task = self._task
        start, reference = self.sources()
        self.acquisition = self.generation = None
        self.failure_told = False
        if not task.timing.clocked:
            return
        samples = task.timing.samp_quant_samp_per_chan if task.timing.finite else None
        if task.kind == "ao":
            self._begin_output(samples, start)
        else:
            self._begin_input(self._input_plan(samples, start, reference))

    def _begin_output(self, samples: int | None, start: Source | None) -> None:
        task, chassis = self._task, self._task.chassis
        if isinstance(start, AnalogSource):
            raise unsupported("an analog start trigger of an output", "Start it by ai/StartTrigger.")
        on_input_clock = task.timing.waits_for_input_clock and start is None
        if on_input_clock:
            start = OtherTask("", "ai", reference=False)
        plan = OutputPlan(task.timing.samp_clk_rate, samples, task.out_stream.regenerate, start)
        self.generation = Generation(plan, task.out_stream.started(), chassis.position, chassis.held)
        if on_input_clock and isinstance(start, OtherTask):
            self.generation.join(chassis.moment(start))
        chassis.running_outputs[task] = self.generation

    def _begin_input(self, plan: InputPlan) -> None:
        task, chassis = self._task, self._task.chassis
        self.acquisition = Acquisition(plan, chassis.position, chassis.samples_dtype)
        stream = task.in_stream
        if stream.logging_mode is not LoggingMode.OFF and stream.logging_file_path is not None:
            self._log = open_log(
                stream.logging_file_path,
                stream.logging_mode,
                stream.logging_tdms_operation,
                stream.logging_tdms_group_name or task.name,
                chassis.bench_scene,
                [chassis.inputs[row] for row in plan.rows],
                task.channel_names,
                [each.unit for each in task.ai_channels.terminals],
                plan.scale,
                chassis.time_ns(chassis.position),
            )
        chassis.running_inputs[task] = self.acquisition

    def end(self) -> None:
        """Take and make no more samples, and complete the log."""
        for run in (self.acquisition, self.generation):
            if run is not None:
                run.stop()
        log, self._log = self._log, None
        if log is not None and self.acquisition is not None:
            log.close(self.acquisition)

    @contextmanager
    def on_demand(self, samples: int) -> Iterator[Acquisition]:
        """Take a few samples from now on, without the sample clock's settings; the modules are reserved."""
        task, chassis = self._task, self._task.chassis
        self.sources()
        run = Acquisition(self._input_plan(samples, None, None), chassis.position, chassis.samples_dtype)
        self.acquisition = chassis.running_inputs[task] = run
        try:
            yield run
        finally:
            chassis.running_inputs.pop(task, None)
            self.acquisition = None

    # Logging

    @property
    def _logs_by_itself(self) -> bool:
        return self._log is not None and self._log.mode is LoggingMode.LOG

    def log_horizon(self) -> int:
        """Count the samples that may come before `log_samples` has to be called, so that none is lost."""
        run = self.acquisition
        return run.plan.buffer if run is not None and not run.done and self._logs_by_itself else 1 << 62

    def log_samples(self) -> None:
        """Log what has come, if the task logs by itself; for the buffer it is read then."""
        if self.acquisition is not None and self._logs_by_itself:
            self.log_read()
            self.acquisition.position = max(self.acquisition.position, self.acquisition.readable)

    def log_read(self) -> None:
        """Log what has been read."""
        if self._log is not None and self.acquisition is not None:
            self._log.follow(self.acquisition)

    # What the settings ask for

    def _input_plan(self, samples: int | None, start: Source | None, reference: Source | None) -> InputPlan:
        task, chassis = self._task, self._task.chassis
        terminals = task.ai_channels.terminals
        volts = [chassis.inputs[each.number].volts_per_count or 1.0 for each in terminals]
        buffer = task.in_stream.input_buf_size if task.timing.clocked else samples or 1
        return InputPlan(
            rows=tuple(each.number for each in terminals),
            scale=np.array([volt * each.per_volt for volt, each in zip(volts, terminals, strict=True)]),
            rate=chassis.rate,
            samples=samples,
            buffer=max(buffer, samples or 0) if reference is not None else buffer,
            keep=task.in_stream.overwrite is OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES,
            start=start,
            reference=reference,
            pretrigger=task.triggers.reference_trigger.pretrig_samples,
            again=task.triggers.start_trigger.retriggerable and start is not None and samples is not None,
        )

    def sources(self) -> tuple[Source | None, Source | None]:
        """Give what start and reference trigger listen to, checked.

        Raises
        ------
        DaqError
            With -200262 without a sample clock, -200358 for a reference trigger of a continuous task, -200213
            for more pretrigger samples than there is room for, -200265 for a source that is not there.
        """
        task = self._task
        start, reference = (
            self._source(each) for each in (task.triggers.start_trigger, task.triggers.reference_trigger)
        )
        if (start or reference) and not task.timing.clocked:
            raise DaqError(
                "a trigger needs a sample clock: call timing.cfg_samp_clk_timing",
                DAQmxErrors.TRIG_WHEN_ON_DEMAND_SAMP_TIMING,
                task.name,
            )
        if reference is not None:
            before, samples = (
                task.triggers.reference_trigger.pretrig_samples,
                task.timing.samp_quant_samp_per_chan,
            )
            if not task.timing.finite or task.kind == "ao":
                raise DaqError(
                    "a reference trigger needs a finite acquisition: use AcquisitionType.FINITE, with "
                    "samps_per_chan the samples before and after the trigger together",
                    DAQmxErrors.REF_TRIG_WHEN_CONTINUOUS,
                    task.name,
                )
            if not 0 <= before < samples:
                raise DaqError(
                    f"{before} pretrigger samples: expected from 0 to {samples - 1}, as {samples} samples "
                    "are "
                    "acquired in all",
                    DAQmxErrors.TOO_MANY_PRETRIG_PLUS_MIN_POST_TRIG_SAMPS,
                    task.name,
                )
        return start, reference

    def _source(self, trigger: StartTrigger | ReferenceTrigger) -> Source | None:
        if trigger.trig_type is TriggerType.NONE:
            return None
        if trigger.trig_type is TriggerType.DIGITAL_EDGE:
            return digital_source(trigger.dig_edge_src, trigger.dig_edge_edge)
        channels = self._task.ai_channels
        wanted = trigger.anlg_edge_src.lower().lstrip("/")
        for row, each in enumerate(channels.terminals):
            if wanted in (each.name.lower(), each.physical.lower()):
                return AnalogSource(
                    row, trigger.anlg_edge_slope, trigger.anlg_edge_lvl, trigger.anlg_edge_hyst
                )
        raise DaqError(
            f"analog trigger source {trigger.anlg_edge_src!r}: expected one of the task's input channels, "
            f"{', '.join(channels.channel_names) or 'of which there are none'}",
            DAQmxErrors.INVALID_ANALOG_TRIG_SRC,
            self._task.name,
        )
