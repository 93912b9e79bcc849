"""Encoding of protobuf messages without the protobuf package, and description of their types for MCAP."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Schema(NamedTuple):
    """Schema of a topic, in the form that MCAP requires."""

    name: str
    encoding: str  # language of the schema, such as "protobuf"
    data: bytes  # the schema itself
    message_encoding: str  # encoding of the messages, such as "json"


# Numbers of the types of fields (google/protobuf/descriptor.proto).
_FIELD_TYPES = {"double": 1, "float": 2, "fixed64": 6, "string": 9, "sfixed32": 15, "sfixed64": 16}
_MESSAGE_TYPE = 11
# Full name of the only imported message, and the descriptor of its file, without an import of the protobuf package: it
# would take longer than to encode the samples of a minute.
_TIMESTAMP, _TIMESTAMP_FILE = "google.protobuf.Timestamp", "google/protobuf/timestamp.proto"
_TIMESTAMP_DESCRIPTOR = (
    b'\n\x1fgoogle/protobuf/timestamp.proto\x12\x0fgoogle.protobuf";\n\tTimestamp'
    b"\x12\x18\n\x07seconds\x18\x01 \x01(\x03R\x07seconds\x12\x14\n\x05nanos\x18\x02 \x01(\x05R\x05nanos"
    b"B\x85\x01\n\x13com.google.protobufB\x0eTimestampProtoP\x01Z2google.golang.org/protobuf/types/known/timestamppb"
    b"\xf8\x01\x01\xa2\x02\x03GPB\xaa\x02\x1eGoogle.Protobuf.WellKnownTypesb\x06proto3"
)


@cache
def descriptor_set_bytes(package: str, messages: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]) -> bytes:
    """Return the serialized FileDescriptorSet of protobuf messages and of their imports, as MCAP requires.

    `messages` are (message, ((field, type), ...)); fields are numbered from 1. A type is a protobuf type such as
    ``double``, or the full name of a message; ``[]`` after it makes the field repeated.
    """
    imported = b""
    file = text_field(1, f"{package}.proto") + text_field(2, package)
    if any(_TIMESTAMP in field_type for _, fields in messages for _, field_type in fields):
        imported = _bytes_field(1, _TIMESTAMP_DESCRIPTOR)
        file += text_field(3, _TIMESTAMP_FILE)
    for message, fields in messages:
        descriptors = (_bytes_field(2, _field_descriptor(number, *field)) for number, field in enumerate(fields, 1))
        file += _bytes_field(4, text_field(1, message) + b"".join(descriptors))
    return imported + _bytes_field(1, file + text_field(12, "proto3"))


def _field_descriptor(number: int, name: str, field_type: str) -> bytes:
    is_repeated, field_type = field_type.endswith("[]"), field_type.removesuffix("[]")
    is_message = "." in field_type
    type_number = _MESSAGE_TYPE if is_message else _FIELD_TYPES[field_type]
    numbers = bytes([0x18, number, 0x20, 3 if is_repeated else 1, 0x28, type_number])
    return text_field(1, name) + numbers + (text_field(6, f".{field_type}") if is_message else b"")


def _bytes_field(number: int, data: bytes) -> bytes:
    """Encode a field of bytes, or of an embedded message."""
    return varint(number << 3 | 2) + varint(len(data)) + data


def text_field(number: int, text: str) -> bytes:
    """Encode a field of text with a field number."""
    return _bytes_field(number, text.encode())


_ONE_BYTE = [bytes([number]) for number in range(0x80)]


def varint(number: int) -> bytes:
    """Encode a non-negative number as protobuf does, seven bits a byte.

    >>> varint(300).hex()
    'ac02'
    """
    if number <= 0x7F:
        return _ONE_BYTE[number]
    digits = bytearray()
    while number > 0x7F:
        digits.append(number & 0x7F | 0x80)
        number >>= 7
    digits.append(number)
    return bytes(digits)


def varints(numbers: NDArray[np.uint64], size: int) -> NDArray[np.uint8]:
    """Encode each number in `size` bytes; shape (numbers, bytes). No number may require more bytes.

    >>> varints(np.array([300, 1], np.uint64), 2).tolist()
    [[172, 2], [129, 0]]
    """
    digits = (numbers[:, None] >> np.arange(0, 7 * size, 7, dtype=np.uint64)).astype(np.uint8)
    digits |= 0x80
    digits[:, -1] &= 0x7F
    return digits


@cache
def message_class(descriptor_set: bytes, name: str) -> Any:
    """Return the protobuf class of a message in a serialized FileDescriptorSet."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptor_set).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
