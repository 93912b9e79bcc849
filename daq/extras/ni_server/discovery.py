"""Description of the server for clients in other languages: reflection service and health service."""

from collections.abc import Callable
from typing import Any

import grpc
from google.protobuf import message_factory
from google.protobuf.message import DecodeError
from grpc_health.v1 import health, health_pb2
from grpc_reflection.v1alpha import reflection, reflection_pb2

from daq.extras.ni_server.protocol import SERVICE, SESSION_SERVICE

_HEALTH = health_pb2.DESCRIPTOR.services_by_name["Health"]
_REFLECTION = reflection_pb2.DESCRIPTOR.services_by_name["ServerReflection"]
SERVICES = (SERVICE, SESSION_SERVICE, _HEALTH, _REFLECTION)


class Discovery:
    """The reflection service and the health service; `handlers` handle their calls."""

    def __init__(self) -> None:
        names = [service.full_name for service in SERVICES]
        self._health = health.HealthServicer()
        for name in ("", *names):
            self._health.set(name, health_pb2.HealthCheckResponse.SERVING)
        self.handlers = (_handler(_HEALTH, self._health), _handler(_REFLECTION, reflection.ReflectionServicer(names)))

    def end(self) -> None:
        """Report the end of the server to all watching clients."""
        self._health.enter_graceful_shutdown()


def _handler(service: Any, servicer: Any) -> grpc.GenericRpcHandler:
    """Return the handler of a service; an invalid request is reported to the client and not printed by the server."""
    # Some releases of the gRPC packages describe calls that their servicers do not implement.
    implemented = [method for method in service.methods if method.name in vars(type(servicer))]
    return grpc.method_handlers_generic_handler(
        service.full_name,
        {method.name: _method_handler(method, getattr(servicer, method.name)) for method in implemented},
    )


def _method_handler(method: Any, servicer_method: Callable[..., Any]) -> Any:
    request_class = message_factory.GetMessageClass(method.input_type)

    def parse(data: bytes, context: grpc.ServicerContext) -> Any:
        try:
            return request_class.FromString(data)
        except DecodeError:
            expected = request_class.DESCRIPTOR.full_name
            return context.abort(
                grpc.StatusCode.INVALID_ARGUMENT, f"the request cannot be decoded. Send a message of type {expected}."
            )

    def respond(request: Any, context: grpc.ServicerContext) -> Any:
        if method.client_streaming:
            return servicer_method((parse(data, context) for data in request), context)
        return servicer_method(parse(request, context), context)

    make_handler = grpc.unary_unary_rpc_method_handler
    if method.server_streaming:
        make_handler = grpc.unary_stream_rpc_method_handler
        if method.client_streaming:
            make_handler = grpc.stream_stream_rpc_method_handler
    return make_handler(respond, None, lambda message: bytes(message.SerializeToString()))
