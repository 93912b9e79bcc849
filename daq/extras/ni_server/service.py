"""The server: receives remote calls of clients, and sends responses, events and errors as NI's protocol defines."""

import contextlib
import queue
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.clock import raise_priority
from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_device.task import Task
from daq.extras.ni_server.calls.call import Call
from daq.extras.ni_server.calls.handlers import handler_of, rejection
from daq.extras.ni_server.client_defaults import STRICT
from daq.extras.ni_server.discovery import Discovery
from daq.extras.ni_server.protocol import SERVICE, SESSION_SERVICE, Method, decode, encode, methods
from daq.extras.ni_server.served_instrument import Limits, ServedInstrument, format_error, truncate
from daq.extras.ni_server.sessions import SessionExists
from rig.core.base.errors import unexpected_text

# Default port of the protocol.
PORT = 31763
# Maximum number of connections.
_MAX_CONNECTIONS = 200
# Longest time until the first exchange on a connection [ms].
_MAX_HANDSHAKE_MS = 5000
# Interval of thread switches: with Python's 5 ms, responses would wait too long for the simulation's lock.
_SWITCH_INTERVAL_S = 0.0005


class _Handlers(grpc.GenericRpcHandler):
    """Creates the gRPC handler of a method at its first call, because clients call few of the hundreds of methods."""

    def __init__(self, create: Callable[[Method], Any]) -> None:
        self._create = cache(create)

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> Any:
        """Return the handler of a call; None if no service has the method."""
        method = _methods_by_path().get(handler_call_details.method)
        return None if method is None else self._create(method)


@cache
def _methods_by_path() -> dict[str, Method]:
    return {
        f"/{service.full_name}/{method.name}": method
        for service in (SERVICE, SESSION_SERVICE)
        for method in methods(service)
    }


class Server:
    """An instrument on the network.

    `address` is host and port; port 0 selects a free port. The attribute `port` is the selected port. Without
    `credentials` the connection is not encrypted. `other_handlers` are the handlers of services other than NI's.
    """

    def __init__(
        self,
        chassis: Chassis,
        address: str = "127.0.0.1:0",
        credentials: grpc.ServerCredentials | None = None,
        limits: Limits | None = None,
        other_handlers: Sequence[grpc.GenericRpcHandler] = (),
    ) -> None:
        self.limits = limits or Limits()
        self.instrument = ServedInstrument(chassis, self.limits)
        self.sessions = self.instrument.sessions
        self._unexpected: dict[tuple[str, type[Exception]], str] = {}  # messages of printed unexpected errors
        self._running_calls, self._count_lock = Counter[str](), threading.Lock()
        self._closing = threading.Event()
        self._server = grpc.server(
            ThreadPoolExecutor(self.limits.max_calls, thread_name_prefix="client", initializer=raise_priority),
            maximum_concurrent_rpcs=self.limits.max_calls,
            options=[
                ("grpc.max_receive_message_length", self.limits.max_request_bytes),
                ("grpc.max_send_message_length", self.limits.max_message_bytes),
                ("grpc.so_reuseport", 0),
                # Limited, because idle connections must not use all file descriptors of the process.
                ("grpc.max_allowed_incoming_connections", _MAX_CONNECTIONS),
                ("grpc.server_handshake_timeout_ms", _MAX_HANDSHAKE_MS),
            ],
        )
        self._discovery = Discovery()
        handlers = (_Handlers(self._handler), *self._discovery.handlers, *other_handlers)
        self._server.add_generic_rpc_handlers(handlers)
        if credentials is None:
            self.port = self._server.add_insecure_port(address)
        else:
            self.port = self._server.add_secure_port(address, credentials)
        self._server.start()
        self._previous_switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        threading.Thread(target=self._end_abandoned_sessions, name="sessions", daemon=True).start()

    def close(self, grace: float | None = 0.5) -> None:
        """End all sessions and close the server; running calls may finish within `grace` s (None: they are aborted)."""
        self._closing.set()
        self._discovery.end()
        sys.setswitchinterval(self._previous_switch_interval)
        self.sessions.close_all()
        self._server.stop(grace).wait()

    def wait(self) -> None:
        """Wait until the server has been closed."""
        self._server.wait_for_termination()

    def _handler(self, method: Method) -> Any:
        """Return the gRPC handler of a call."""
        # Requests are decoded in the handler: for an invalid request, gRPC would print a traceback on the terminal.
        if method.streams:
            return grpc.unary_stream_rpc_method_handler(self._stream(method))
        handler = handler_of(method.name) or rejection(method.name)

        def respond(request: bytes, context: grpc.ServicerContext) -> Any:
            with self._decoded(method, request, context) as call:
                response_fields = handler(call)
                if method.name.startswith(("Read", "Write", "Start")):
                    self.sessions.check_memory(call.fields["task"], self.limits.max_buffer_bytes)
                return encode(method.response(), response_fields or {})

        return grpc.unary_unary_rpc_method_handler(respond)

    @contextlib.contextmanager
    def _decoded(self, method: Method, request: bytes, context: grpc.ServicerContext) -> Iterator[Call]:
        """Decode a request; report errors of the decoding and of the `with` body as the protocol requires."""
        peer, name = context.peer(), method.name
        api_key = dict(context.invocation_metadata()).get("ni-api-key", "")
        call = Call(self.instrument, peer, strict=api_key == STRICT, is_active=context.is_active)
        try:
            self._count_call(peer, context)
            call.message = method.request.FromString(request)
            call.fields = decode(call.message)
            yield call
        except DecodeError:
            context.abort(
                grpc.StatusCode.INVALID_ARGUMENT,
                f"{name}: the request cannot be decoded. Send a {method.request.DESCRIPTOR.name}.",
            )
        except DaqError as error:
            task = self.sessions.task_name(call.fields.get("task", ""))
            message = format_error(error, task)
            direction = "written" if "Write" in name else "read"
            metadata = [("ni-error", str(error.code))]
            if error.samples_done is not None or name.startswith(("Read", "Write")):
                metadata.append((f"ni-samps-per-chan-{direction}", str(error.samples_done or 0)))
            context.set_trailing_metadata(tuple(metadata))
            context.abort(grpc.StatusCode.UNKNOWN, message)
        except SessionExists as error:
            context.abort(grpc.StatusCode.ALREADY_EXISTS, truncate(str(error)))
        except Exception as error:
            # An unexpected error is printed only once for each call and type of error.
            error_type = name, type(error)
            if error_type not in self._unexpected:
                self._unexpected[error_type] = f"{type(error).__name__}: {error}"
                print(unexpected_text(error), file=sys.stderr, flush=True)
            context.set_trailing_metadata((("ni-error", str(int(Code.INVALID_ATTRIBUTE_VALUE))),))
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, truncate(f"{name}: {self._unexpected[error_type]}"))

    def _count_call(self, peer: str, context: grpc.ServicerContext) -> None:
        """Count a running call of a client until it ends. Raises `DaqError` -50103 if the maximum number is running."""

        def end_call_count() -> None:
            with self._count_lock:
                self._running_calls -= Counter({peer: 1})

        max_calls = self.limits.max_calls_per_client
        with self._count_lock:
            if self._running_calls[peer] >= max_calls:
                raise DaqError(
                    f"this client has {max_calls} unfinished calls, the maximum. Wait until a call has ended.",
                    Code.PAL_RESOURCE_RESERVED,
                )
            self._running_calls[peer] += 1
        if not context.add_callback(end_call_count):
            end_call_count()

    def _stream(self, method: Method) -> Callable[[Any, grpc.ServicerContext], Iterator[Any]]:
        """Return the function that registers a client for an event and yields a response at each event."""
        register, response_fields = _EVENTS[method.name]

        def events(request: bytes, context: grpc.ServicerContext) -> Iterator[Any]:
            values: queue.SimpleQueue[int | None] = queue.SimpleQueue()
            with self._decoded(method, request, context) as call:
                task, fields = call.task, call.fields
                with task.chassis.changed:
                    task.check_idle(
                        "registering an event", Code.CANNOT_REGISTER_DA_QMX_SOFTWARE_EVENT_WHILE_TASK_IS_RUNNING
                    )
                    register(task, fields, values.put)
            task.events.at_end(values.put)
            context.add_callback(lambda: values.put(None))
            # The client waits for this header, so no event precedes its registration.
            context.send_initial_metadata(())
            try:
                while (value := values.get()) is not None and context.is_active():
                    yield encode(method.response(), response_fields(fields, value))
            finally:
                with contextlib.suppress(DaqError), task.chassis.changed:
                    task.events.remove_listener(values.put)

        return events

    def _end_abandoned_sessions(self) -> None:
        """End the sessions of disconnected clients until the server closes; runs in a separate thread."""
        while not self._closing.wait(min(1.0, self.limits.disconnect_timeout / 4)):
            connected = _connected_to(self.port)
            if connected is None:
                continue
            for name in self.sessions.end_abandoned(connected, self.limits.disconnect_timeout):
                print(f"task {name} was closed, because its client has disconnected", file=sys.stderr, flush=True)


# Calls that register for events: a function that registers the queue of a stream, and a function that returns the
# fields of a response, given the fields of the request and the value of the event.
_EVENTS: dict[str, tuple[Callable[[Task, dict[str, Any], Any], None], Callable[..., dict[str, Any]]]] = {
    "RegisterEveryNSamplesEvent": (
        lambda task, fields, queue_event: task.events.listen_every(
            fields["every_n_samples_event_type"],
            fields["n_samples"],
            queue_event,
            has_outputs=task.settings.direction == "ao",
        ),
        lambda fields, value: {"n_samples": value, "every_n_samples_event_type": fields["every_n_samples_event_type"]},
    ),
    "RegisterDoneEvent": (
        lambda task, fields, queue_event: task.events.listen_done(queue_event),
        lambda fields, value: {"status": value},
    ),
    "RegisterSignalEvent": (
        lambda task, fields, queue_event: task.events.listen_signal(fields["signal_id"], queue_event),
        lambda fields, value: {"signal_id": value},
    ),
}


def _connected_to(port: int) -> set[tuple[str, int]] | None:
    """Return the addresses connected to a port of this process; None if they cannot be determined."""
    import psutil

    try:
        connections = psutil.Process().net_connections(kind="tcp")
    except (psutil.Error, OSError):
        return None
    return {
        (connection.raddr.ip.removeprefix("::ffff:"), connection.raddr.port)
        for connection in connections
        if connection.laddr
        and connection.laddr.port == port
        and connection.raddr
        and connection.status == psutil.CONN_ESTABLISHED
    }
