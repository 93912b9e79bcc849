"""Bench time while threads of a program sleep: it passes, but not faster than its other threads use the bench."""

import threading
from typing import Any

from daq.extras.ni_device.chassis import Chassis

# Longest wait for a thread that is awake (wall-clock time) [s]. A thread that takes longer does not use the bench.
_MAX_THREAD_S = 0.25


class SleepingThreads:
    """Lets time pass to the next end of a sleep, as soon as all threads that use the bench are asleep or read samples.

    A thread is awaited after its first sleep. A thread without sleeps, such as a loop of reads, lets time pass itself;
    it is awaited after its start and while it calls.
    """

    def __init__(self, chassis: Chassis) -> None:
        self._chassis = chassis
        # End of the sleep of each thread [ticks]; None while it is awake.
        self._ends: dict[threading.Thread, int | None] = {threading.main_thread(): None}
        self._is_call_expected = False  # from a thread without sleeps
        chassis.call_listeners.append(self._on_call)

    def expect_call(self) -> None:
        """Await the calls of a thread that starts."""
        self._is_call_expected = True

    def _on_call(self, call: str, task: Any) -> None:
        with self._chassis.changed:
            if not self._has_awake_thread():
                self._is_call_expected = True

    def _has_awake_thread(self) -> bool:
        position = self._chassis.position
        return any(thread.is_alive() and (end is None or end <= position) for thread, end in self._ends.items())

    def sleep(self, seconds: float) -> None:
        """Let time pass on the bench while the present thread sleeps."""
        chassis, thread = self._chassis, threading.current_thread()
        with chassis.changed:
            end = chassis.position + round(seconds * chassis.rate)
            if thread not in self._ends and thread is not threading.main_thread():
                self._is_call_expected = False  # the thread that was expected
            self._ends[thread] = end
            chassis.changed.notify_all()
            try:
                while chassis.is_in_use and chassis.position < end:
                    if self._is_call_expected or self._has_awake_thread():
                        self._await_threads()
                    else:
                        ends = [other for other in self._ends.values() if other is not None]
                        next_end = min(other for other in ends if other > chassis.position)
                        chassis.pass_time((next_end - chassis.position) / chassis.rate)
            finally:
                self._ends[thread] = None

    def _await_threads(self) -> None:
        """Wait until time has passed or a thread has fallen asleep; stop to await threads that are late."""
        chassis, position, ends = self._chassis, self._chassis.position, dict(self._ends)
        if not chassis.changed.wait_for(lambda: (chassis.position, self._ends) != (position, ends), _MAX_THREAD_S):
            self._is_call_expected = False
            self._ends = {thread: other for thread, other in ends.items() if other is not None and other > position}
