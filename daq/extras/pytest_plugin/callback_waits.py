"""Waits of a program for the callbacks of tasks, in bench time.

While the main thread waits in `time.sleep`, `threading.Event.wait` or `queue.Queue.get`, time passes on the bench to
the next event of a task. Then its callbacks finish before time passes again, so a run does not depend on the speed of
the machine: a program that computes gets no additional time. Python has no public way to observe these waits; the
functions are therefore replaced during a test.
"""

import functools
import inspect
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from daq.extras.ni_device.chassis import Chassis
from daq.extras.pytest_plugin.sleeping_threads import SleepingThreads

_wait_for_event, _get_from_queue = threading.Event.wait, queue.Queue.get
_start_thread = threading.Thread.start
# Interval at which a waiting thread checks whether callbacks have finished (wall-clock time) [s].
_CHECK_INTERVAL_S = 0.001
# Longest wait for a callback (wall-clock time) [s]. A longer callback probably waits for the main thread.
_MAX_CALLBACK_S = 10.0
# Longest step of the bench [s], after which the wait is checked: the end of a task has no known tick.
_MAX_STEP_S = 0.05


def pause(seconds: float) -> None:
    """Wait on the wall clock [s]."""
    _wait_for_event(threading.Event(), seconds)


class CallbackWaits:
    """Counts the callbacks of the tasks of this process, and lets time pass while the main thread waits for them."""

    def __init__(self, chassis: Chassis) -> None:
        self._chassis, self._threads = chassis, SleepingThreads(chassis)
        # Number of finished callbacks of each task, in relation to the number of its events.
        self._finished = Counter[str]()
        # Tasks whose callback did not finish in time: it may wait for the main thread.
        self._late: set[str] = set()
        # Whether the main thread starts a thread, which uses an event.
        self._is_starting_thread = False

    def replacements(self) -> Iterator[tuple[Any, str, Any]]:
        """Yield the functions to replace, each as its owner, its name and its new value."""
        import nidaqmx

        events = ("every_n_samples_acquired_into_buffer", "every_n_samples_transferred_from_buffer", "done", "signal")
        for event in events:
            name = f"register_{event}_event"
            yield nidaqmx.Task, name, self._counting(getattr(nidaqmx.Task, name))

        def wait(event: threading.Event, timeout: float | None = None) -> bool:
            if self._is_waiting_for_callback() and not self._pass_time(event.is_set, timeout):
                return event.is_set()
            return _wait_for_event(event, timeout)

        def get(waiting: queue.Queue[Any], block: bool = True, timeout: float | None = None) -> Any:
            if block and self._is_waiting_for_callback():
                block = self._pass_time(lambda: waiting.qsize() > 0, timeout)
            return _get_from_queue(waiting, block, timeout)

        def start(thread: threading.Thread) -> None:
            if threading.current_thread() is not threading.main_thread():
                _start_thread(thread)
                return
            self._is_starting_thread = True
            self._threads.expect_call()
            try:
                _start_thread(thread)
            finally:
                self._is_starting_thread = False

        yield threading.Thread, "start", start
        yield threading.Event, "wait", wait
        yield queue.Queue, "get", get

    def sleep(self, seconds: float) -> None:
        """Let time pass on the bench; its events are followed by their callbacks."""
        if self._is_waiting_for_callback():
            self._pass_time(lambda: False, seconds)
        else:
            self._threads.sleep(seconds)

    def _counting(self, register: Callable[..., Any]) -> Callable[..., Any]:
        """Return a method of a task that registers its last argument, a callback, and counts the finished calls."""
        signature = inspect.signature(register)
        *_, callback_name = signature.parameters

        @functools.wraps(register)
        def call(*arguments: Any, **keywords: Any) -> Any:
            bound = signature.bind(*arguments, **keywords)
            task, callback = bound.args[0], bound.arguments[callback_name]
            if callback is None:
                return register(*bound.args, **bound.kwargs)
            name = task.name
            with self._chassis.changed:
                self._finished[name] = self._chassis.tasks[name].events.n_sent if name in self._chassis.tasks else 0

            @functools.wraps(callback)
            def counted(*values: Any) -> Any:
                try:
                    return callback(*values)
                finally:
                    with self._chassis.changed:
                        self._finished[name] += 1
                        self._late.discard(name)

            bound.arguments[callback_name] = counted
            return register(*bound.args, **bound.kwargs)

        return call

    def _is_waiting_for_callback(self) -> bool:
        """Return whether the calling thread is the main thread, and a callback of a task can come."""
        is_main = threading.current_thread() is threading.main_thread()
        may_wait = is_main and not self._is_starting_thread
        return may_wait and self._chassis.is_in_use and bool(self._registered())

    def _registered(self) -> dict[str, Any]:
        """Return the events of the tasks that have callbacks in this process, by the name of the task."""
        tasks = list(self._chassis.tasks.items())
        return {name: task.events for name, task in tasks if name in self._finished and task.events.are_registered}

    def _pass_time(self, is_done: Callable[[], bool], timeout: float | None) -> bool:
        """Let time pass until a condition is met; return whether it is, or may be met without passing time.

        `timeout`: bench time [s]; None for an unlimited wait.
        """
        chassis = self._chassis
        end = None if timeout is None else chassis.position + round(timeout * chassis.rate)
        while not is_done():
            if end is not None and chassis.position >= end:
                return False
            if not self._pass_to_event(end):
                # The task has been closed, or the clock advances on request.
                return True
            self._await_callbacks(is_done)
        return True

    def _pass_to_event(self, end: int | None) -> bool:
        """Let time pass to the next event, to the end of the wait, or for a short step; return whether it has."""
        chassis = self._chassis
        with chassis.changed:
            position, n_sent = chassis.position, self._n_sent()

            def is_over() -> bool:
                has_ended = end is not None and chassis.position >= end
                return has_ended or self._n_sent() != n_sent or not chassis.is_in_use

            chassis.clock.wait(chassis, is_over, lambda: self._ticks_to_event(end), _MAX_STEP_S)
            return chassis.position != position

    def _n_sent(self) -> int:
        """Return the number of events that have been sent to the callbacks."""
        return sum(events.n_sent for events in self._registered().values())

    def _await_callbacks(self, is_done: Callable[[], bool]) -> None:
        """Wait until the callbacks of the sent events have finished, except of tasks whose callback is late."""
        end = time.monotonic() + _MAX_CALLBACK_S
        while not is_done() and (unfinished := self._unfinished() - self._late):
            if time.monotonic() > end:
                self._late |= unfinished
            pause(_CHECK_INTERVAL_S)

    def _unfinished(self) -> set[str]:
        """Return the names of the tasks with callbacks that have not finished."""
        with self._chassis.changed:
            return {name for name, events in self._registered().items() if events.n_sent > self._finished[name]}

    def _ticks_to_event(self, end: int | None) -> int:
        """Return the number of ticks to the next event of a running task, or to the end of the wait."""
        chassis = self._chassis
        ticks = [task.max_ticks() for task in (*chassis.inputs, *chassis.outputs)]
        return min([*ticks, *([] if end is None else [end - chassis.position])], default=1)
