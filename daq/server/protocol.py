"""NI's gRPC device protocol, service `nidaqmx_grpc.NiDAQmx`: its calls, requests and responses.

The protocol is public; every release of `nidaqmx[grpc]` contains its message classes, generated from `nidaqmx.proto`.
The server uses the descriptors of the installed release, so that it works with releases that have more or fewer
calls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from google.protobuf import message_factory
from google.protobuf.timestamp_pb2 import Timestamp
from nidaqmx._stubs import nidaqmx_pb2

from daq.instrument.errors import invalid_value
from daq.recording.protobuf import varint

SERVICE = nidaqmx_pb2.DESCRIPTOR.services_by_name["NiDAQmx"]
# The service of NI's server for devices of any driver.
_SESSION_FILE = next(file for file in nidaqmx_pb2.DESCRIPTOR.dependencies if file.name.endswith("session.proto"))
SESSION_SERVICE = _SESSION_FILE.services_by_name["SessionUtilities"]
# Maximum number of entries of a list other than samples.
_MAX_ENTRIES = 10_000
# Maximum length of a text, characters: it may name thousands of channels.
_MAX_CHARACTERS = 1 << 16
# Lists of samples, whose length is not limited here.
_SAMPLES = ("write_array", "waveforms")
# Full names of the messages for a session and a time; suffix of a choice between a named and a raw number.
_SESSION, _TIMESTAMP, _ENUM = "nidevice_grpc.Session", "google.protobuf.Timestamp", "_enum"


DeviceProperties = message_factory.GetMessageClass(_SESSION_FILE.message_types_by_name["DeviceProperties"])


@dataclass(frozen=True)
class Method:
    """A remote call."""

    name: str  # in the service
    request: Any  # class of the message
    response: Any  # class of the message
    streams: bool  # the response is a stream of messages


def methods(service: Any = SERVICE) -> list[Method]:
    """List the calls of a service."""
    return [
        Method(
            method.name,
            message_factory.GetMessageClass(method.input_type),
            message_factory.GetMessageClass(method.output_type),
            method.server_streaming,
        )
        for method in service.methods
    ]


def decode(request: Any) -> dict[str, Any]:
    """Return the fields of a request by name, as Python values.

    A choice (`oneof`) between a named and a raw value becomes its number, under the name of the choice, 0 if absent.
    A session becomes its name, a time seconds since 1970, a list of numbers an array, any other list a list.

    Raises `DaqError` -200077 for a text, or a list other than samples, above the maximum length, and for a text with a
    null character.
    """
    fields: dict[str, Any] = {}
    for name, choice, kind, repeated in _fields(request.DESCRIPTOR):
        if choice:
            field_name = request.WhichOneof(choice)
            fields[name] = 0 if field_name is None else getattr(request, field_name)
            continue
        value = getattr(request, name)
        if repeated and name not in _SAMPLES and len(value) > _MAX_ENTRIES:
            raise invalid_value(f"{name} has {len(value)} entries; expected {_MAX_ENTRIES} at most.")
        if isinstance(value, str):
            _check_text(name, value)
        if repeated and kind != "message":
            fields[name] = np.array(value, dtype=np.float64) if kind == "double" else list(value)
        elif kind == _SESSION:
            _check_text(name, value.name)
            fields[name] = value.name
        elif kind == _TIMESTAMP:
            fields[name] = value.seconds + value.nanos * 1e-9
        else:
            fields[name] = value
    return fields


def _check_text(name: str, text: str) -> None:
    if len(text) > _MAX_CHARACTERS:
        raise invalid_value(f"{name} is a text of {len(text)} characters; expected {_MAX_CHARACTERS} at most.")
    if "\0" in text:
        raise invalid_value(f"{name} contains a null character, which ends a text of NI's driver. Remove it.")


@cache
def _fields(descriptor: Any) -> list[tuple[str, str, str, bool]]:
    """Return name, choice ('' if none), kind of value, and whether it is a list, of each field of a request.

    The kind is "double", "message", the full name of a session or time message, or '' for any other type.
    """
    fields, names = [], set()
    for field in descriptor.fields:
        choice = field.containing_oneof.name if field.containing_oneof is not None else ""
        if choice in names:
            continue
        names.add(choice or field.name)
        kind = ""
        if field.message_type is not None:
            kind = field.message_type.full_name
            kind = kind if kind in (_SESSION, _TIMESTAMP) else "message"
        elif field.cpp_type == field.CPPTYPE_DOUBLE:
            kind = "double"
        fields.append((choice.removesuffix(_ENUM) or field.name, choice, kind, _is_list(field)))
    return fields


def _is_list(field: Any) -> bool:
    """Return whether a field is repeated; the attribute depends on the release of protobuf."""
    return bool(getattr(field, "is_repeated", None) or getattr(field, "label", 0) == 3)


def encode(response: Any, values: Mapping[str, Any]) -> bytes:
    """Encode a response from values by field name; a value also becomes the raw form of its field, if there is one.

    Samples are copied from memory, which has the format of the protocol. The conversion of thousands of samples to
    Python numbers would delay all other clients.
    """
    names, samples = response.DESCRIPTOR.fields_by_name, b""
    for name, value in values.items():
        for field_name in (name, f"{name}_raw"):
            field = names.get(field_name)
            if field is None:
                continue
            if field.message_type is not None and field.message_type.full_name == _SESSION:
                getattr(response, field_name).name = value
            elif field.message_type is not None and field.message_type.full_name == _TIMESTAMP:
                getattr(response, field_name).CopyFrom(timestamp(value))
            elif isinstance(value, np.ndarray) and field.cpp_type == field.CPPTYPE_DOUBLE:
                data = value.astype("<f8").tobytes()
                samples += varint(field.number << 3 | 2) + varint(len(data)) + data
            elif _is_list(field):
                getattr(response, field_name).extend(value.ravel().tolist() if isinstance(value, np.ndarray) else value)
            else:
                setattr(response, field_name, value)
    return bytes(response.SerializeToString()) + samples


def timestamp(seconds: float) -> Timestamp:
    """Convert seconds since 1970 to a timestamp message."""
    whole_seconds = int(seconds // 1)
    return Timestamp(seconds=whole_seconds, nanos=min(round((seconds - whole_seconds) * 1e9), 999_999_999))


def attribute_name(request: Any) -> str | None:
    """Return NI's name of the attribute in a request, without the prefix of its group; None without a name."""
    field = request.DESCRIPTOR.fields_by_name["attribute"]
    member = request.WhichOneof("attribute_enum")
    number = getattr(request, member) if member else 0
    if number == DEFAULT_NUMBER_OF_SAMPLES:
        return "default_number_of_samples"
    value = field.enum_type.values_by_number.get(number)
    if value is None or not number:
        return None
    return str(value.name).partition("_ATTRIBUTE_")[2].lower()


# The client's reads use this attribute, but the protocol does not name it.
DEFAULT_NUMBER_OF_SAMPLES = 0x31E8
