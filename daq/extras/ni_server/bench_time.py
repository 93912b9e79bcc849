"""Lets bench time pass while a script in `daq run` sleeps or waits for Enter."""

import math

import grpc

from daq.extras.ni_device.chassis import Chassis

# A wait is divided into steps of at most this time [s]. After each step, the wait ends if the client has disconnected.
_MAX_STEP_S = 100.0


class BenchTime(grpc.GenericRpcHandler):
    """Handles the call /shotrig.Bench/Pass of shotrig's own service, which waits in bench time.

    The request is the time to wait in s, as text; the response is the bench time in s, as text.
    """

    def __init__(self, chassis: Chassis) -> None:
        self._chassis = chassis

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        """Return the handler of the call; None for any other call."""
        if handler_call_details.method != "/shotrig.Bench/Pass":
            return None

        def wait(request: bytes, context: grpc.ServicerContext) -> bytes:
            try:
                seconds = float(request)
            except ValueError:
                context.abort(grpc.StatusCode.INVALID_ARGUMENT, "the time is not a number. Send a number of seconds.")
            # If the client has disconnected, the remaining time is not needed.
            while 0 < seconds < math.inf and context.is_active():
                self._chassis.pass_time(min(seconds, _MAX_STEP_S))
                seconds -= _MAX_STEP_S
            return repr(self._chassis.elapsed).encode()

        return grpc.unary_unary_rpc_method_handler(wait)
