"""Tasks: channels, timing, triggers and streams as data, and their life on the chassis."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.instrument.chassis import Chassis
from daq.instrument.clock import seconds
from daq.instrument.engines.generation import Generation, OutputBuffer
from daq.instrument.engines.input_engine import InputEngine
from daq.instrument.engines.log import TaskLog, open_log
from daq.instrument.errors import STOPPED_BEFORE_DONE, Code, DaqError, bad
from daq.instrument.events import Events, Listener
from daq.instrument.plans import check_timing, input_plan, output_plan, sources
from daq.instrument.settings.scales import Scale
from daq.instrument.settings.task_settings import TaskSettings
from daq.instrument.values import LoggingMode, TaskMode

Array = NDArray[np.float64]


class Task:
    """A task on the chassis: its settings and its life; see `task_reading` and `task_writing` for its samples.

    Parameters
    ----------
    chassis : Chassis
        Where it runs.
    name : str
        Name; one is made up if it is empty.
    scales : mapping of str to Scale
        Custom scales that its channels may name.

    Attributes
    ----------
    settings : TaskSettings
        What the script has said.
    acquisition, generation : InputEngine and Generation or None
        The run that goes on, or the last one.
    buffer : OutputBuffer or None
        What has been written.
    running, closed, automatic, committed : bool
        Whether it runs, is closed, was started by a read or a write, keeps its modules when it stops.
    reported : bool
        Whether the script has heard why the run ended early.
    played : bool
        Whether the buffer has been played.
    overloads_reported : list of str or None
        Channels that were overloaded when that was last asked.
    """

    def __init__(self, chassis: Chassis, name: str, scales: Mapping[str, Scale]) -> None:
        self.chassis, self.settings = chassis, TaskSettings(chassis.devices.module, scales)
        self.events = Events()
        self.acquisition: InputEngine | None = None
        self.generation: Generation | None = None
        self.buffer: OutputBuffer | None = None
        self.running = self.closed = False
        self.automatic = self.committed = self.reported = self.played = False
        self.overloads_reported: list[str] | None = None
        self._looked: dict[str, int] = {}
        self.log: TaskLog | None = None
        self.name = ""
        self.name = chassis.admit(self, name)

    # What it is

    @property
    def sample_rate(self) -> float | None:
        """See `daq.instrument.chassis.Runner`."""
        if self.settings.kind != "ai" or not self.settings.channels or not self.settings.clocked:
            return None
        try:
            return self.settings.rate
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
            self.reserve()
            try:
                self.chassis.wake(self)
                self._run()
            except BaseException:
                self._end()
                raise
            self.automatic, self.running, self.reported = automatic, True, False

    def reserve(self) -> None:
        """Reserve the modules and outputs that the task needs; see `Chassis.reserve`."""
        if self.settings.kind == "ao":
            self.chassis.reserve(self, {each.row: each.port.name for each in self.settings.channels})
        else:
            self.chassis.reserve(self, {f"{name}/ai": f"{name}/ai" for name in self.settings.device_names})

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
            plan = input_plan(self.settings, chassis.bench, start, reference)
            self.acquisition = chassis.run_input(self, plan)
            self._open_log()
            return
        if self.buffer is None or self.buffer.written == 0:
            raise DaqError(
                "nothing has been written for the output to play: write samples before starting the task",
                Code.OUTPUT_BUFFER_EMPTY,
            )
        out, joins = output_plan(self.settings, chassis.rate, start)
        self.generation, self.played = chassis.run_output(self, out, self.buffer), True
        if joins is not None:
            self.generation.join(chassis.moment(joins))

    def _open_log(self) -> None:
        read, engine = self.settings.groups["read"], self.acquisition
        if read["logging_mode"] == LoggingMode.OFF or not read["logging_file_path"] or engine is None:
            return
        chassis, began, plan = self.chassis, self.chassis.position, engine.acquisition.plan
        ticks = chassis.rate / plan.rate

        def time_ns(sample: int) -> int:
            return chassis.time_ns(began + round(sample * ticks))

        self.log = open_log(self.name, self.settings, chassis.bench, plan, time_ns)

    def stop(self) -> int:
        """Stop the task.

        Returns
        -------
        int
            The warning 200010, if a finite task is not done yet; else 0.

        Raises
        ------
        DaqError
            If the task ended early and the error was not reported yet.
        """
        if not self.running:
            return 0
        early = not self.endless and not self.finished
        failure = None if self.reported else self.failure
        self.end()
        if failure is not None:
            raise failure
        return STOPPED_BEFORE_DONE if early else 0

    def end(self) -> None:
        """End the run, if there is one."""
        with self.chassis.changed:
            self._end()

    def _end(self) -> None:
        self.running = False
        if self.committed:
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
            self.end()
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
            self.reserve()
            self.committed = True
        else:
            self.committed = False
            self.end()
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
    def memory(self) -> int:
        """Bytes that its buffers take."""
        run = None if self.acquisition is None else self.acquisition.acquisition
        held = 0 if run is None else run.ring.bytes + run.overloads.bytes
        return held + (0 if self.buffer is None else self.buffer.data.nbytes)

    def free_memory(self) -> None:
        """End the run and give its buffers back."""
        with self.chassis.changed:
            self.end()
            self.acquisition = self.generation = self.buffer = None

    @property
    def failure(self) -> DaqError | None:
        """Why the run ended early."""
        return None if self.run is None else self.run.error

    def raise_failure(self) -> None:
        """Raise the reason why the run ended early, as often as somebody asks until the task is stopped."""
        if self.failure is not None and self.running:
            self.reported = True
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
        return engine.ticks(run.missing(plan.samples - run.position), self.chassis.position)

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
            most = min(most, engine.ticks(engine.acquisition.plan.buffer, self.chassis.position))
        return most

    def passed(self) -> bool:
        """See `daq.instrument.chassis.Runner`."""
        if self.acquisition is not None and self.log is not None and self.log.by_itself:
            run = self.acquisition.acquisition
            self.log.follow(run)
            run.position = max(run.position, run.readable)
        return self.running and self.events.notify(self._samples_passed, self.run)

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
        if self.acquisition is None:
            return 1 << 62
        return self.acquisition.ticks(due - self._samples_passed, self.chassis.position)

    @property
    def answered(self) -> bool:
        """See `daq.instrument.chassis.Runner`."""
        run = self.run
        return not self.running or run is None or self.settings.kind == "ao" or run.position >= run.readable

    # Samples

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

    def start_new_file(self, path: str) -> None:
        """Go on logging in another file; before the start, log into that one."""
        with self.chassis.changed:
            if self.log is not None and self.acquisition is not None:
                self.log.start_new_file(Path(path), self.acquisition.acquisition)
            self.settings.groups["read"]["logging_file_path"] = path
