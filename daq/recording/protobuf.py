"""Protobuf messages of a recording: their schemas, classes and bytes."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Schema(NamedTuple):
    """Schema of a topic: its name, encoding and text, and the encoding of the messages."""

    name: str
    encoding: str
    data: bytes
    message_encoding: str


@cache
def descriptors(package: str, messages: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]) -> bytes:
    """Describe protobuf messages for MCAP as a serialized FileDescriptorSet with all imports.

    `messages` are (message, ((field, type), ...)); fields are numbered from 1. A type is a protobuf type such as
    ``double``, or the full name of a message; ``[]`` behind it makes the field repeated.
    """
    from google.protobuf import descriptor_pb2, timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
    described = descriptor_pb2.FileDescriptorSet()
    kinds = descriptor_pb2.FieldDescriptorProto
    for message, fields in messages:
        message_type = file.message_type.add(name=message)
        for number, (name, kind) in enumerate(fields, start=1):
            repeated, kind = kind.endswith("[]"), kind.removesuffix("[]")
            field = message_type.field.add(name=name, number=number)
            field.label = kinds.LABEL_REPEATED if repeated else kinds.LABEL_OPTIONAL
            if "." not in kind:
                field.type = kinds.Type.Value(f"TYPE_{kind.upper()}")
                continue
            field.type, field.type_name = kinds.TYPE_MESSAGE, f".{kind}"
            if kind == "google.protobuf.Timestamp" and not file.dependency:
                file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
                timestamp_pb2.DESCRIPTOR.CopyToProto(described.file.add())
    described.file.append(file)
    return bytes(described.SerializeToString(deterministic=True))


_SHORT = [bytes([number]) for number in range(0x80)]


def varint(number: int) -> bytes:
    """Encode a non-negative number as protobuf does, seven bits a byte.

    >>> varint(300).hex()
    'ac02'
    """
    if number <= 0x7F:
        return _SHORT[number]
    digits = bytearray()
    while number > 0x7F:
        digits.append(number & 0x7F | 0x80)
        number >>= 7
    digits.append(number)
    return bytes(digits)


def varints(numbers: NDArray[np.uint64], size: int) -> NDArray[np.uint8]:
    """Encode numbers in `size` bytes each, at least as many as `varint` needs; shape (numbers, bytes).

    >>> varints(np.array([300, 1], np.uint64), 2).tolist()
    [[172, 2], [129, 0]]
    """
    digits = (numbers[:, None] >> np.arange(0, 7 * size, 7, dtype=np.uint64)).astype(np.uint8)
    digits |= 0x80
    digits[:, -1] &= 0x7F
    return digits


@cache
def message_class(described: bytes, name: str) -> Any:
    """Make the protobuf class of a message out of a FileDescriptorSet."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(described).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
