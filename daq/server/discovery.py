"""Description of the server for clients in other languages: reflection, health service, and .proto files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
from google.protobuf import message_factory
from google.protobuf.message import DecodeError
from grpc_health.v1 import health, health_pb2
from grpc_reflection.v1alpha import reflection, reflection_pb2

from daq.server.proto_text import proto_text
from daq.server.protocol import SERVICE, SESSION_SERVICE
from rig.errors import SceneError

_HEALTH = health_pb2.DESCRIPTOR.services_by_name["Health"]
_REFLECTION = reflection_pb2.DESCRIPTOR.services_by_name["ServerReflection"]
SERVICES = (SERVICE, SESSION_SERVICE, _HEALTH, _REFLECTION)


class Discovery:
    """The reflection service and the health service.

    `handlers`: handlers of their calls.
    """

    def __init__(self) -> None:
        names = [each.full_name for each in SERVICES]
        self._health = health.HealthServicer()
        for name in ("", *names):
            self._health.set(name, health_pb2.HealthCheckResponse.SERVING)
        self.handlers = (
            _handler(_HEALTH, self._health),
            _handler(_REFLECTION, reflection.ReflectionServicer(names)),
        )

    def end(self) -> None:
        """Report the end of the server to all watching clients."""
        self._health.enter_graceful_shutdown()


def _handler(service: Any, servicer: Any) -> grpc.GenericRpcHandler:
    """Return the handler of a service; an invalid request is an error of the client, without a traceback here."""
    made = {}
    # Some releases of the packages describe calls that their servicers do not implement.
    for method in (each for each in service.methods if each.name in vars(type(servicer))):
        request, answer = message_factory.GetMessageClass(method.input_type), getattr(servicer, method.name)
        if method.client_streaming:
            made[method.name] = grpc.stream_stream_rpc_method_handler(
                _of_stream(request, answer), None, _bytes
            )
        elif method.server_streaming:
            made[method.name] = grpc.unary_stream_rpc_method_handler(
                _of_request(request, answer), None, _bytes
            )
        else:
            made[method.name] = grpc.unary_unary_rpc_method_handler(
                _of_request(request, answer), None, _bytes
            )
    return grpc.method_handlers_generic_handler(service.full_name, made)


def _bytes(message: Any) -> bytes:
    return bytes(message.SerializeToString())


def _parsed(request: Any, data: bytes, context: grpc.ServicerContext) -> Any:
    try:
        return request.FromString(data)
    except DecodeError:
        return context.abort(grpc.StatusCode.INVALID_ARGUMENT, f"expected a {request.DESCRIPTOR.full_name}")


def _of_request(request: Any, answer: Callable[..., Any]) -> Callable[[bytes, grpc.ServicerContext], Any]:
    return lambda data, context: answer(_parsed(request, data, context), context)


def _of_stream(
    request: Any, answer: Callable[..., Any]
) -> Callable[[Iterator[bytes], grpc.ServicerContext], Any]:
    def respond(stream: Iterator[bytes], context: grpc.ServicerContext) -> Any:
        return answer((_parsed(request, each, context) for each in stream), context)

    return respond


def write_proto_files(folder: Path) -> list[Path]:
    """Write the .proto files of the protocol, including their imports.

    Raises `SceneError` if a file of that name has different text, or cannot be written.
    """
    files: dict[str, Any] = {}
    for service in SERVICES:
        _collect(service.file, files)
    paths = []
    for name, file in files.items():
        path, text = folder / name, proto_text(file)
        try:
            if path.exists() and path.read_bytes() != text.encode():
                raise SceneError(f"{path}: the file exists with other text. Give --proto another folder.")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(text.encode())
        except OSError as error:
            raise SceneError(
                f"{path}: {error.strerror}. Give --proto a folder that can be written."
            ) from None
        paths.append(path)
    return paths


def _collect(file: Any, files: dict[str, Any]) -> None:
    for each in file.dependencies:
        _collect(each, files)
    files[file.name] = file
