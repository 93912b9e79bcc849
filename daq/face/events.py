"""Callbacks of a task: every N samples, and when it is done.

On the fast and the manual clock a callback runs on the thread that lets time pass (the one that reads,
waits or advances), at the very sample it is due; time stands still meanwhile. On the real clock it runs on
a thread of the task's own, one call at a time and in order, while the bench goes on: a callback that takes
longer than its N samples falls behind, as with hardware. Stopping a task waits for a callback that is
running and drops those still due.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from daq.face.constants import EveryNSamplesEventType
from daq.instrument.errors import DaqError, DAQmxErrors

if TYPE_CHECKING:
    from daq.face.task import Task

Callback = Callable[..., Any]

_TAKEN = {
    EveryNSamplesEventType.ACQUIRED_INTO_BUFFER: (
        DAQmxErrors.EVERY_N_SAMPS_ACQ_INTO_BUFFER_EVENT_ALREADY_REGISTERED
    ),
    EveryNSamplesEventType.TRANSFERRED_FROM_BUFFER: (
        DAQmxErrors.EVERY_N_SAMPS_TRANSFERRED_FROM_BUFFER_EVENT_ALREADY_REGISTERED
    ),
}


class Events:
    """The callbacks of one task.

    Parameters
    ----------
    task : Task
        The task.
    """

    def __init__(self, task: Task) -> None:
        self._task = task
        self._every: dict[EveryNSamplesEventType, tuple[int, Callback, Any]] = {}
        self._done: tuple[Callback, Any] | None = None
        self._delivered = 0
        self._told_done = False
        self._calling = False
        self._thread: threading.Thread | None = None

    def register_every(
        self, kind: EveryNSamplesEventType, samples: int, callback: Callback | None, data: Any = None
    ) -> None:
        """Register a callback for every so many samples, or None to unregister."""
        self._task.check_idle("register_every_n_samples_event")
        if callback is None:
            self._every.pop(kind, None)
            return
        if kind in self._every:
            raise DaqError(
                "an every-N-samples callback is registered already: unregister it first by passing None",
                _TAKEN[kind],
                self._task.name,
            )
        if samples < 1:
            raise DaqError(
                f"every {samples} samples: the interval must be at least 1",
                DAQmxErrors.EVERY_N_SAMPS_EVENT_INTERVAL_ZERO_NOT_SUPPORTED,
                self._task.name,
            )
        self._every[kind] = int(samples), callback, data

    def register_done(self, callback: Callback | None, data: Any = None) -> None:
        """Register a callback for the end of a finite task, or None to unregister."""
        self._task.check_idle("register_done_event")
        if callback is not None and self._done is not None:
            raise DaqError(
                "a done callback is registered already: unregister it first by passing None",
                DAQmxErrors.DONE_EVENT_ALREADY_REGISTERED,
                self._task.name,
            )
        self._done = None if callback is None else (callback, data)

    @property
    def _current(self) -> tuple[EveryNSamplesEventType, int, Callback, Any] | None:
        kind = (
            EveryNSamplesEventType.TRANSFERRED_FROM_BUFFER
            if self._task.kind == "ao"
            else EveryNSamplesEventType.ACQUIRED_INTO_BUFFER
        )
        return (kind, *self._every[kind]) if kind in self._every else None

    def begin(self) -> None:
        """Start with a task."""
        self._delivered, self._told_done = 0, False
        if self._task.chassis.clock.runs_free and (self._every or self._done):
            self._thread = threading.Thread(
                target=self._serve, name=f"callbacks of {self._task.name}", daemon=True
            )
            self._thread.start()

    def end(self) -> None:
        """End with a task, after a callback that is running has returned."""
        thread, self._thread = self._thread, None
        with self._task.chassis.changed:
            self._task.chassis.changed.notify_all()
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout=10.0)

    def horizon(self) -> int:
        """Count the samples until the next callback is due."""
        current = self._current
        if current is None:
            return 1 << 62
        return current[1] - self._task.run.samples_passed % current[1]

    def _next(self) -> tuple[Callback, tuple[Any, ...]] | None:
        """Take the next call that is due."""
        current = self._current
        if current is not None:
            kind, samples, callback, data = current
            if self._delivered < self._task.run.samples_passed // samples:
                self._delivered += 1
                return callback, (self._task.handle, kind.value, samples, data)
        if self._done is not None and not self._told_done and self._task.run.finished:
            self._told_done = True
            callback, data = self._done
            error = self._task.run.failure
            return callback, (self._task.handle, 0 if error is None else error.error_code, data)
        return None

    def deliver(self) -> None:
        """Make all calls that are due, on this thread."""
        if self._calling:
            return
        self._calling = True
        try:
            while self._task.is_running and (call := self._next()):
                call[0](*call[1])
        finally:
            self._calling = False

    def _serve(self) -> None:
        """Make the calls as they become due, on the task's own thread, until the task is stopped."""
        changed = self._task.chassis.changed
        me = threading.current_thread()
        while True:
            with changed:
                call = None
                while self._thread is me and (call := self._next()) is None:
                    changed.wait()
                if self._thread is not me or call is None:
                    return
            call[0](*call[1])
