"""Tasks: channels, timing, triggers and streams as data, and their life on the chassis."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.instrument.chassis import Chassis, InputEngine, NeededRate
from daq.instrument.clock import seconds
from daq.instrument.errors import STOPPED_BEFORE_DONE, Code, DaqError, bad
from daq.instrument.events import Events, Listener
from daq.instrument.generation import Generation, OutputBuffer
from daq.instrument.plans import check_timing, input_plan, output_plan, sources
from daq.instrument.reading import Reading, collect, seek
from daq.instrument.ring_buffer import room
from daq.instrument.scales import Scale
from daq.instrument.settings import TaskSettings
from daq.instrument.task_log import TaskLog, open_log
from daq.instrument.values import LoggingMode, TaskMode, TimestampEvent
from daq.instrument.writing import check_volts, fill, hold

Array = NDArray[np.float64]


class Task:
    """A task on the chassis.

    Parameters
    ----------
    chassis : Chassis
        Where it runs.
    name : str
        Name; one is made up if it is empty.
    scales : mapping of str to Scale
        Custom scales that its channels may name.
    """

    def __init__(self, chassis: Chassis, name: str, scales: Mapping[str, Scale]) -> None:
        self.chassis, self.settings = chassis, TaskSettings(chassis.module, scales)
        self.events = Events()
        self.acquisition: InputEngine | None = None
        self.generation: Generation | None = None
        self.buffer: OutputBuffer | None = None
        self.running = self.closed = False
        self._automatic = self._committed = self._told = self._played = False
        self._overloaded: list[str] | None = None
        self._looked: dict[str, int] = {}
        self.log: TaskLog | None = None
        self.name = ""
        self.name = chassis.admit(self, name)

    # What it is

    @property
    def rate_needed(self) -> NeededRate | None:
        """See `daq.instrument.chassis.Runner`."""
        if not self.settings.channels or not self.settings.clocked or self.closed:
            return None
        try:
            return NeededRate(self.settings.rate, self.settings.kind == "ai")
        except DaqError:
            return None

    def check_idle(self, what: str, code: Code = Code.CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING) -> None:
        """Make sure that the task is not running."""
        if self.running:
            raise DaqError(f"{what}: not while the task is running; call stop() first", code)

    # Life

    def verify(self) -> None:
        """Check the settings against each other."""
        check_timing(self.settings)
        sources(self.settings, self.chassis)

    def start(self, automatic: bool = False) -> None:
        """Start the task; its triggers are armed and its time passes from now on."""
        self.check_idle("start")
        if not self.settings.channels:
            raise DaqError(
                "the task has no channels: add some before starting it",
                Code.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK,
            )
        with self.chassis.changed:
            self._reserve()
            try:
                self.chassis.wake(self)
                self._run()
            except BaseException:
                self._end()
                raise
            self._automatic, self.running, self._told = automatic, True, False

    def _reserve(self) -> None:
        if self.settings.kind == "ao":
            self.chassis.reserve(self, tuple(each.row for each in self.settings.channels))
        else:
            self.chassis.reserve(self, tuple(f"{name}/ai" for name in self.settings.device_names))

    def _run(self) -> None:
        self.verify()
        self.acquisition = self.generation = None
        self.events.begin()
        if not self.settings.clocked:
            return
        chassis = self.chassis
        start, reference = sources(self.settings, chassis)
        if self.settings.kind == "ai":
            chassis.wire(self, self.settings.channels)
            plan = input_plan(self.settings, chassis.source, start, reference)
            self.acquisition = chassis.run_input(self, plan)
            self._open_log()
            return
        if self.buffer is None or self.buffer.written == 0:
            raise DaqError(
                "nothing has been written for the output to play: write samples before starting the task",
                Code.OUTPUT_BUFFER_EMPTY,
            )
        out, joins = output_plan(self.settings, chassis.rate, start)
        self.generation, self._played = chassis.run_output(self, out, self.buffer), True
        if joins is not None:
            self.generation.join(chassis.moment(joins))

    def _open_log(self) -> None:
        read, engine = self.settings.groups["read"], self.acquisition
        if read["logging_mode"] == LoggingMode.OFF or not read["logging_file_path"] or engine is None:
            return
        self.log = open_log(self.name, self.settings, self.chassis, engine.acquisition.plan)

    def stop(self) -> int:
        """Stop the task.

        Returns
        -------
        int
            The warning 200010, if a finite task is not done yet; else 0.

        Raises
        ------
        DaqError
            If the task had ended early and nobody has been told why.
        """
        if not self.running:
            return 0
        early = not self.endless and not self.finished
        failure = None if self._told else self.failure
        self._stop()
        if failure is not None:
            raise failure
        return STOPPED_BEFORE_DONE if early else 0

    def _stop(self) -> None:
        with self.chassis.changed:
            self._end()

    def _end(self) -> None:
        self.running = False
        if self._committed:
            self.chassis.halt(self)
        else:
            self.chassis.release(self)
        if self.run is not None:
            self.run.stop()
        log, self.log = self.log, None
        if log is not None and self.acquisition is not None:
            log.close(self.acquisition.acquisition)

    def close(self) -> None:
        """Stop the task and give everything back; it cannot be used again."""
        if self.closed:
            return
        try:
            self._stop()
        finally:
            self.closed = True
            self.events.close()
            self.chassis.dismiss(self)

    def control(self, action: int) -> int:
        """Take a step of the task's life; COMMIT and RESERVE keep its modules until UNRESERVE or close."""
        if action not in list(TaskMode):
            raise bad(f"task mode {action}: expected one of {', '.join(each.name for each in TaskMode)}")
        if action == TaskMode.START:
            self.start()
        elif action == TaskMode.STOP:
            return self.stop()
        elif action == TaskMode.VERIFY:
            self.verify()
        elif action in (TaskMode.COMMIT, TaskMode.RESERVE):
            self.verify()
            self._reserve()
            self._committed = True
        else:
            self._committed = False
            self._stop()
        return 0

    @property
    def run(self) -> Any:
        """The run that goes on, or the last one: an acquisition or a generation."""
        return self.generation if self.acquisition is None else self.acquisition.acquisition

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end."""
        return self.run is not None and self.run.done

    @property
    def endless(self) -> bool:
        """Whether it goes on until it is stopped."""
        again = self.acquisition is not None and self.acquisition.acquisition.plan.again
        return not self.settings.clocked or not self.settings.finite or again

    @property
    def failure(self) -> DaqError | None:
        """Why the run ended early."""
        return None if self.run is None else self.run.error

    def raise_failure(self) -> None:
        """Raise the reason why the run ended early, as often as somebody asks until the task is stopped."""
        if self.failure is not None and self.running:
            self._told = True
            raise self.failure

    def look(self, question: str) -> None:
        """Hear that a script asks how far the run has come.

        A script that asks the same again although nothing has passed waits in a loop of its own: a clock
        that moves only while somebody waits then lets a little time pass.
        """
        chassis = self.chassis
        again = self._looked.get(question) == chassis.position
        if again and self.running and not self.finished:
            chassis.clock.glance(chassis)
        self._looked[question] = chassis.position

    def is_done(self) -> bool:
        """Whether the task is done, or not running; a task without a clock always is."""
        with self.chassis.changed:
            self.look("is_task_done")
            self.raise_failure()
            return not self.running or self.finished or not self.settings.clocked

    def missing(self) -> int:
        """Ticks that must pass at least until the run is complete."""
        if self.generation is not None:
            return self.generation.missing()
        engine = self.acquisition
        plan = None if engine is None else engine.acquisition.plan
        if engine is None or plan is None or plan.samples is None or plan.again:
            return max(1, int(self.chassis.rate / 100))
        run = engine.acquisition
        return run.missing(plan.samples - run.position) * engine.divisor

    def wait_until_done(self, timeout: float) -> None:
        """Wait until a finite task is done; with -200560, if it is not done in time."""
        timeout = seconds(timeout)
        with self.chassis.changed:
            done = (
                not self.running
                or not self.settings.clocked
                or self.chassis.wait(lambda: self.finished or not self.running, self.missing, timeout)
            )
            self.raise_failure()
        if not done:
            raise DaqError(
                f"the task is not done after {timeout:g} s"
                + ("" if self.settings.finite else "; a continuous task never is: stop it")
                + ". Wait longer, or check that it is triggered",
                Code.WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE,
            )

    # Events

    def listen_every(self, kind: int, samples: int, listener: Listener | None) -> None:
        """Listen for so many samples; see `Events.listen_every`. With -200960 while the task runs."""
        self._check_listener(listener)
        self.events.listen_every(kind, samples, listener, outputs=self.settings.kind == "ao")

    def listen_done(self, listener: Listener | None) -> None:
        """Listen for the end of the task."""
        self._check_listener(listener)
        self.events.listen_done(listener)

    def listen_signal(self, signal: int, listener: Listener | None) -> None:
        """Listen for a signal."""
        self._check_listener(listener)
        self.events.listen_signal(signal, listener)

    def _check_listener(self, listener: Listener | None) -> None:
        if listener is not None:
            code = Code.CANNOT_REGISTER_DA_QMX_SOFTWARE_EVENT_WHILE_TASK_IS_RUNNING
            self.check_idle("registering an event", code)

    # As the chassis sees it

    @property
    def device(self) -> str:
        """Name of the first device in use."""
        return self.settings.device

    def horizon(self) -> int:
        """See `daq.instrument.chassis.Runner`."""
        engine = self.acquisition
        most = 1 << 62 if self.chassis.clock.runs_free else self._ticks_to_event()
        if engine is not None and self.log is not None and self.log.by_itself and not self.finished:
            most = min(most, engine.acquisition.plan.buffer * engine.divisor)
        return most

    def passed(self) -> bool:
        """See `daq.instrument.chassis.Runner`."""
        if self.acquisition is not None and self.log is not None and self.log.by_itself:
            run = self.acquisition.acquisition
            self.log.follow(run)
            run.position = max(run.position, run.readable)
        return self.running and self.events.tell(self._samples_passed, self.run)

    @property
    def _samples_passed(self) -> int:
        if self.generation is not None:
            return self.generation.generated
        return 0 if self.acquisition is None else self.acquisition.acquisition.ring.written

    def _ticks_to_event(self) -> int:
        due = self.events.due(self._samples_passed)
        if due is None or (self.generation is not None and not self.generation.begun):
            return 1 << 62
        if self.generation is not None:
            return self.generation.ticks_until(due)
        return (due - self._samples_passed) * (1 if self.acquisition is None else self.acquisition.divisor)

    @property
    def answered(self) -> bool:
        """See `daq.instrument.chassis.Runner`."""
        run = self.run
        return not self.running or run is None or self.settings.kind == "ao" or run.position >= run.readable

    # Samples

    def read(self, samples: int, timeout: float, raw: bool = False) -> Reading:
        """Read samples, starting the task if need be.

        Parameters
        ----------
        samples : int
            Samples per channel; -1 takes all of a finite task, what is there of a continuous one.
        timeout : float
            Seconds to wait; 0 tries once, negative waits for ever.
        raw : bool
            Whether to give the converter's counts instead of readings in the channels' units.

        Returns
        -------
        Reading
            With -200284 when time is up, -200279 when samples have been overwritten (reading goes on with
            the oldest left), -200278 beyond the end of a finite acquisition, or the reason why the
            acquisition stopped; the samples that came before are there too.
        """
        timeout = seconds(timeout)
        with self.chassis.changed:
            self.settings.require("ai")
            if self.settings.groups["read"]["logging_mode"] == LoggingMode.LOG:
                raise DaqError(
                    "the task only logs (LoggingMode.LOG): to read as well, log with LoggingMode.LOG_AND_READ",
                    Code.READ_NOT_SUPPORTED_FOR_LOGGING_MODE,
                )
            if samples < 0:
                samples = self.default_count()
            rows = self.settings.rows_to_read()
            out = room(len(rows), samples, np.int32 if raw else np.float64)
            if not self.settings.clocked:
                return self._read_on_demand(rows, out, timeout, raw)
            self.begin()
            assert self.acquisition is not None
            if timeout == 0:
                self.look("read")
            try:
                seek(self.settings.groups["read"], self.acquisition.acquisition)
                return self._collect(self.acquisition, rows, out, timeout, raw)
            finally:
                self._after_read()

    def _read_on_demand(self, rows: list[int], out: NDArray[Any], timeout: float, raw: bool) -> Reading:
        chassis = self.chassis
        self.verify()
        self._reserve()
        chassis.wake(self)
        chassis.wire(self, self.settings.channels)
        plan = input_plan(self.settings, chassis.source, None, None, on_demand=out.shape[1])
        self.acquisition = chassis.run_input(self, plan)
        try:
            return self._collect(self.acquisition, rows, out, timeout, raw)
        finally:
            chassis.halt(self)
            self.acquisition = None
            if not (self.running or self._committed):
                chassis.release(self)

    def _collect(
        self, engine: InputEngine, rows: list[int], out: NDArray[Any], timeout: float, raw: bool
    ) -> Reading:
        def taken() -> None:
            if self.log is not None:
                self.log.follow(engine.acquisition)

        channels = self.settings.channels if raw else None
        reading = collect(self.chassis, engine, rows, out, timeout, channels, taken)
        self._told |= reading.error is not None and reading.error is engine.acquisition.error
        return reading

    def default_count(self) -> int:
        """Count what a read takes by default: all of a finite task, what is there of a continuous one."""
        settings = self.settings
        settings.require("ai")
        run = self.acquisition.acquisition if self.running and self.acquisition is not None else None
        if not settings.clocked:
            return 1
        if settings.finite and not settings.groups["read"]["read_all_avail_samp"]:
            if run is None or run.plan.again:
                return settings.samples
            end = settings.samples if run.trigger is None else run.first_readable + settings.samples
            return max(end - run.position, 0) or settings.samples
        if run is None:
            self.begin()
            assert self.acquisition is not None
            run = self.acquisition.acquisition
        if run.readable <= run.position and self.running and not run.done:
            self.chassis.clock.glance(self.chassis)
        return max(0, run.readable - run.position)

    def begin(self) -> None:
        """Start the task for a read, unless it may not start by itself."""
        if self.running or not self.settings.clocked:
            return
        if not self.settings.groups["read"]["auto_start"]:
            raise DaqError(
                "the task is not running, and in_stream.auto_start is off: call start() before reading",
                Code.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED,
            )
        self.start(automatic=True)

    def _after_read(self) -> None:
        """Stop a finite task that a read has started and emptied."""
        run = self.run
        if self._automatic and self.running and run is not None and run.done and run.position >= run.readable:
            self._stop()

    @property
    def raw_width(self) -> int:
        """Bytes of a converter count."""
        return 2 if self.settings.channels and (self.settings.channels[0].module.bits or 32) <= 16 else 4

    def time_of_sample(self, sample: int) -> int:
        """Time of a sample of the last acquisition, ns; without one, that of now."""
        engine, chassis = self.acquisition, self.chassis
        if engine is None:
            return chassis.time_ns(chassis.position)
        return chassis.time_ns(engine.acquisition.tick_of(sample) * engine.divisor)

    def time_of(self, event: TimestampEvent, timeout: float) -> int:
        """Time at which the task started or was triggered, ns.

        Raises
        ------
        DaqError
            With -209842, if times of triggers were switched off; with -200284, if it has not happened in time.
        """
        name = {TimestampEvent.START_TRIGGER: "start", TimestampEvent.REFERENCE_TRIGGER: "ref"}.get(event)
        settings, key = self.settings.groups["trig"], f"{name}_trig_timestamp_enable"
        if name is not None and settings.was_set(key) and not settings[key]:
            raise DaqError(
                "the time of that trigger is not kept: set timestamp_enable before starting the task",
                Code.TIMESTAMP_NOT_ENABLED,
            )
        if name is None:
            self.settings.groups["timing"]["first_samp_timestamp_enable"] = True

        def tick() -> int | None:
            if self.acquisition is not None:
                reference = event == TimestampEvent.REFERENCE_TRIGGER and self.run.plan.reference is not None
                return self.acquisition.start_tick(reference, self.chassis.position)
            return None if self.generation is None else self.generation.first_tick

        with self.chassis.changed:
            guess = max(1, int(self.chassis.rate / 100))
            if not self.chassis.wait(lambda: tick() is not None, lambda: guess, seconds(timeout)):
                raise DaqError(
                    f"the task has not been started or triggered within {timeout:g} s",
                    Code.SAMPLES_NOT_YET_AVAILABLE,
                )
            found = tick()
            assert found is not None
            return self.chassis.time_ns(found)

    def start_new_file(self, path: str) -> None:
        """Go on logging in another file; before the start, log into that one."""
        with self.chassis.changed:
            if self.log is not None and self.acquisition is not None:
                self.log.start_new_file(Path(path), self.acquisition.acquisition)
            self.settings.groups["read"]["logging_file_path"] = path

    def _fill(self, volts: Array, timeout: float) -> int:
        assert self.buffer is not None

        def running() -> Generation | None:
            return self.generation if self.running else None

        try:
            return fill(self.chassis, self.buffer, volts, timeout, self.settings.regenerates, running)
        finally:
            self._told |= self.failure is not None

    def write(self, volts: Array, auto_start: bool, timeout: float) -> int:
        """Write samples, shape (channels, n), in the channels' units.

        Returns
        -------
        int
            Samples per channel written, n.

        Raises
        ------
        DaqError
            With -200292 when time is up; the reason why the output stopped; -200561 for samples beyond the
            channel's limits, -200524 for the wrong number of channels.
        """
        timeout = seconds(timeout)
        self.settings.require("ao")
        check_volts(self.settings.channels, volts)
        with self.chassis.changed:
            if not self.settings.clocked:
                if not (auto_start or self.running):
                    raise DaqError(
                        "the task is not running, and auto_start is off: call start() before writing",
                        Code.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED,
                    )
                return self._write_on_demand(volts)
            if not self.running and (self.buffer is None or self._played):
                # What has been played to its end or stopped is done with: a new write begins a new buffer.
                chosen = self.settings.groups["buffer"]
                size = int(chosen["output_buf_size"]) if chosen.was_set("output_buf_size") else None
                self.buffer, self._played = OutputBuffer(volts.shape[0], size), False
            written = self._fill(volts, timeout)
            if auto_start and not self.running:
                self.start()
            return written

    def _write_on_demand(self, volts: Array) -> int:
        self.verify()
        self._reserve()
        try:
            self.chassis.wake(self)
            hold(self.chassis, self, [each.row for each in self.settings.channels], volts)
        finally:
            if not (self.running or self._committed):
                self.chassis.release(self)
        return volts.shape[1]

    def overloaded_exist(self) -> bool:
        """Whether any channel has been overloaded since this was last asked; asking clears the flags."""
        run = None if self.acquisition is None else self.acquisition.acquisition
        flags = [] if run is None else run.overloaded.tolist()
        names = [each.name for each in self.settings.channels]
        self._overloaded = [name for name, flag in zip(names, flags, strict=False) if flag]
        if run is not None:
            run.overloaded[:] = False
        return bool(self._overloaded)

    def overloaded(self) -> list[str]:
        """Names of the channels that were overloaded when `overloaded_exist` was asked."""
        if self._overloaded is None:
            raise DaqError(
                "ask in_stream.overloaded_chans_exist first: it takes the flags that overloaded_chans names",
                Code.OVERLOADED_CHANS_EXIST_NOT_READ,
            )
        return list(self._overloaded)
