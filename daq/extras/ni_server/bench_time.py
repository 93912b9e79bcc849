"""Lets bench time pass while a script sleeps or waits for Enter, and interrupts a script at its time limit."""

from __future__ import annotations

import math
import os
import signal
import sys
from collections.abc import Callable

import grpc

from daq.extras.ni_device.chassis import Chassis

# Bench time for which a prompt waits if the run of the script has no time limit.
PROMPT_TIMEOUT_S = 10.0
# A wait is divided into steps of at most this time, s. After each step, the wait ends if the client has disconnected.
_MAX_STEP_S = 100.0


class TimeLimit:
    """Interrupts a process when the bench time reaches `seconds`; None for no limit."""

    def __init__(self, chassis: Chassis, seconds: float | None) -> None:
        self._chassis, self._seconds = chassis, seconds
        self.process: int | None = None  # id of the process
        self.reached = False
        if seconds is not None:
            chassis.schedule(seconds, self._interrupt)

    @property
    def is_unlimited(self) -> bool:
        """Whether there is no limit."""
        return self._seconds is None

    def use_for_prompt(self) -> float:
        """Return the bench time for which a prompt waits, s; the limit then no longer interrupts the process."""
        self.reached = True
        return PROMPT_TIMEOUT_S if self._seconds is None else max(0.0, self._seconds - self._chassis.elapsed)

    def _interrupt(self) -> None:
        if not self.reached and self.process is not None:
            self.reached = True
            if sys.platform == "win32":
                # On Windows a signal to a single process kills it. Ctrl-C reaches all processes of the console; this
                # process ignores it.
                os.kill(0, signal.CTRL_C_EVENT)
            else:
                os.kill(self.process, signal.SIGINT)


class BenchTime(grpc.GenericRpcHandler):
    """Handles two calls of shotrig's own service, which wait in bench time.

    /shotrig.Bench/Pass waits for the seconds in the request. /shotrig.Bench/Prompt waits until the time `limit`, or for
    `PROMPT_TIMEOUT_S` without a limit. Both return the bench time, s, as text.
    """

    def __init__(self, chassis: Chassis, limit: TimeLimit | None = None) -> None:
        self._chassis, self._limit = chassis, limit or TimeLimit(chassis, None)

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        """Return the handler of a call; see the class."""
        waiting_times: dict[str, Callable[[bytes], float]] = {
            "/shotrig.Bench/Pass": float,
            "/shotrig.Bench/Prompt": lambda request: self._limit.use_for_prompt(),
        }
        waiting_time = waiting_times.get(handler_call_details.method)
        if waiting_time is None:
            return None

        def wait(request: bytes, context: grpc.ServicerContext) -> bytes:
            try:
                seconds = waiting_time(request)
            except ValueError:
                context.abort(grpc.StatusCode.INVALID_ARGUMENT, "the time is not a number. Send a number of seconds.")
            # If the client has disconnected, the remaining time is not needed.
            while 0 < seconds < math.inf and context.is_active():
                self._chassis.pass_time(min(seconds, _MAX_STEP_S))
                seconds -= _MAX_STEP_S
            return repr(self._chassis.elapsed).encode()

        return grpc.unary_unary_rpc_method_handler(wait)
