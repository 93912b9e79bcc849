"""Encodes protobuf messages without the protobuf package, and describes their types for MCAP."""

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


@cache
def descriptor_set_bytes(package: str, messages: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]) -> bytes:
    """Return the serialized FileDescriptorSet of protobuf messages and of their imports, as MCAP requires.

    `messages` are (message, ((field, type), ...)); fields are numbered from 1. A type is a protobuf type such as
    ``double``, or the full name of a message; ``[]`` after it makes the field repeated.
    """
    from google.protobuf import descriptor_pb2, timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
    descriptor_set = descriptor_pb2.FileDescriptorSet()
    field_descriptor = descriptor_pb2.FieldDescriptorProto
    for message, fields in messages:
        message_type = file.message_type.add(name=message)
        for number, (name, field_type) in enumerate(fields, start=1):
            repeated, field_type = field_type.endswith("[]"), field_type.removesuffix("[]")
            field = message_type.field.add(name=name, number=number)
            field.label = field_descriptor.LABEL_REPEATED if repeated else field_descriptor.LABEL_OPTIONAL
            if "." not in field_type:
                field.type = field_descriptor.Type.Value(f"TYPE_{field_type.upper()}")
                continue
            field.type, field.type_name = field_descriptor.TYPE_MESSAGE, f".{field_type}"
            if field_type == "google.protobuf.Timestamp" and not file.dependency:
                file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
                timestamp_pb2.DESCRIPTOR.CopyToProto(descriptor_set.file.add())
    descriptor_set.file.append(file)
    return bytes(descriptor_set.SerializeToString(deterministic=True))


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
