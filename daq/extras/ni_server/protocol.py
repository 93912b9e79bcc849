"""NI's gRPC device protocol, service `nidaqmx_grpc.NiDAQmx`: its calls, requests and responses.

The protocol is public; every release of `nidaqmx[grpc]` contains its message classes, generated from `nidaqmx.proto`.
The server uses the descriptors of the installed release, so releases may have more or fewer calls.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, message_factory
from google.protobuf.timestamp_pb2 import Timestamp
from nidaqmx._stubs import nidaqmx_pb2

from daq.core.mcap_file.protobuf import varint
from daq.extras.ni_device.errors import invalid_value

SERVICE = nidaqmx_pb2.DESCRIPTOR.services_by_name["NiDAQmx"]
# Attribute that the client uses in reads, although the protocol has no name for it.
DEFAULT_NUMBER_OF_SAMPLES = 0x31E8
# The service of NI's server for the devices of all drivers.
_SESSION_FILE = next(file for file in nidaqmx_pb2.DESCRIPTOR.dependencies if file.name.endswith("session.proto"))
SESSION_SERVICE = _SESSION_FILE.services_by_name["SessionUtilities"]
# Maximum number of entries of a list other than samples, so a client cannot exhaust the memory.
_MAX_ENTRIES = 10_000
# Maximum length of a string [characters]; a string may name thousands of channels.
_MAX_CHARACTERS = 1 << 16
# Lists of samples, whose length is not limited here.
_SAMPLES = ("write_array", "waveforms")
# Full names of the message types of a session and a time.
_SESSION, _TIMESTAMP = "nidevice_grpc.Session", "google.protobuf.Timestamp"
_LABEL_REPEATED = descriptor_pb2.FieldDescriptorProto.LABEL_REPEATED
# Suffix of the name of a oneof that has either an enum value or its raw number.
_ENUM = "_enum"

DeviceProperties = message_factory.GetMessageClass(_SESSION_FILE.message_types_by_name["DeviceProperties"])


@dataclass(frozen=True)
class Method:
    """A remote call."""

    name: str  # name of the call in the service
    request: Any  # class of the message
    response: Any  # class of the message
    streams: bool  # whether the response is a stream of messages


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

    * oneof of an enum value and its raw number: the number, 0 if absent; the key is the oneof's name without `_enum`
    * session: its name
    * timestamp: seconds since 1970
    * repeated double: array; other repeated field: list

    Raises `DaqError` -200077 for a string, or a list other than samples, above the maximum length, and for a string
    with a null character.
    """
    fields: dict[str, Any] = {}
    for name, oneof, value_type, repeated in _fields(request.DESCRIPTOR):
        if oneof:
            field_name = request.WhichOneof(oneof)
            fields[name] = 0 if field_name is None else getattr(request, field_name)
            continue
        value = getattr(request, name)
        if repeated and name not in _SAMPLES and len(value) > _MAX_ENTRIES:
            raise invalid_value(f"{name} has {len(value)} entries; the maximum is {_MAX_ENTRIES}. Shorten the list.")
        if isinstance(value, str):
            _check_string(name, value)
        if repeated and value_type != "message":
            fields[name] = np.array(value, dtype=np.float64) if value_type == "double" else list(value)
        elif value_type == _SESSION:
            _check_string(name, value.name)
            fields[name] = value.name
        elif value_type == _TIMESTAMP:
            fields[name] = value.seconds + value.nanos * 1e-9
        else:
            fields[name] = value
    return fields


def _check_string(name: str, value: str) -> None:
    if len(value) > _MAX_CHARACTERS:
        raise invalid_value(f"{name} has {len(value)} characters; the maximum is {_MAX_CHARACTERS}. Shorten it.")
    if "\0" in value:
        raise invalid_value(f"{name} contains a null character, which ends a string in NI's driver. Remove it.")


@cache
def _fields(descriptor: Any) -> list[tuple[str, str, str, bool]]:
    """Return name, oneof, type, and whether it is repeated, of each field of a request.

    The fields of a oneof are a single entry; for other fields, the oneof is ''. The type is "double", "message", the
    full name of a session or timestamp message, or '' for any other type.
    """
    fields, names = [], set()
    for field in descriptor.fields:
        oneof = field.containing_oneof.name if field.containing_oneof is not None else ""
        if oneof in names:
            continue
        names.add(oneof or field.name)
        value_type = ""
        if field.message_type is not None:
            value_type = field.message_type.full_name
            value_type = value_type if value_type in (_SESSION, _TIMESTAMP) else "message"
        elif field.cpp_type == field.CPPTYPE_DOUBLE:
            value_type = "double"
        fields.append((oneof.removesuffix(_ENUM) or field.name, oneof, value_type, is_repeated(field)))
    return fields


def is_repeated(field: Any) -> bool:
    """Return whether a field is repeated (a list); the attribute depends on the release of protobuf."""
    return bool(getattr(field, "is_repeated", None) or getattr(field, "label", 0) == _LABEL_REPEATED)


def encode(response: Any, values: Mapping[str, Any]) -> bytes:
    """Encode a response from values by field name; a value is also written to the field `<name>_raw`, if it exists.

    Arrays of doubles are appended as bytes, because their memory layout equals that of the protocol. The conversion of
    thousands of samples to Python numbers would delay all other clients.
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
                # The tag of a length-delimited field, the length, and the data.
                samples += varint(field.number << 3 | 2) + varint(len(data)) + data
            elif is_repeated(field):
                getattr(response, field_name).extend(value.ravel().tolist() if isinstance(value, np.ndarray) else value)
            else:
                setattr(response, field_name, value)
    return bytes(response.SerializeToString()) + samples


def timestamp(seconds: float) -> Timestamp:
    """Convert seconds since 1970 to a timestamp message."""
    whole_seconds = int(seconds // 1)
    return Timestamp(seconds=whole_seconds, nanos=min(round((seconds - whole_seconds) * 1e9), 999_999_999))


def attribute_name(request: Any) -> str | None:
    """Return NI's name of the attribute in a request, such as "samp_clk_rate"; None if its number has no name."""
    field = request.DESCRIPTOR.fields_by_name["attribute"]
    member = request.WhichOneof("attribute_enum")
    number = getattr(request, member) if member else 0
    if number == DEFAULT_NUMBER_OF_SAMPLES:
        return "default_number_of_samples"
    value = field.enum_type.values_by_number.get(number)
    if value is None or not number:
        return None
    return str(value.name).partition("_ATTRIBUTE_")[2].lower()
