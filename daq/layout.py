"""The layout of a recording: its topics, schemas and times.

`LAYOUT.md` beside this module says the same for readers who do not use this package.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.errors import RecordingError

VERSION = "1"

RAW = "/raw/"
TRUTH = "/truth/"
DISPLAY = "/display/"
MARKERS = "/markers"
EVENTS = "/truth/events"
ROBOT = "/robot_description"
TRANSFORMS = "/tf"
SCENE_FILE = "scene.yaml"


class Schema(NamedTuple):
    """What the messages of a topic are made of: the schema's name, its encoding, its text, and theirs."""

    name: str
    encoding: str
    data: bytes
    message_encoding: str


class Message(NamedTuple):
    """A message on its way into the file: number of its channel, times in ns, content, place in its topic."""

    channel: int
    log_time: int
    publish_time: int
    data: bytes
    sequence: int


class Messages(NamedTuple):
    """At least one message, all of one size, on their way into the file together, in the order of `data`.

    They are logged when published. Numbers and times are broadcast to the messages, as numpy does.

    Attributes
    ----------
    channel : ndarray or int
        Numbers of their channels.
    time : ndarray or int
        Nanoseconds.
    data : ndarray of uint8, (..., bytes)
        Their content.
    sequence : ndarray or int
        Their places in their topics.
    """

    channel: NDArray[np.int64] | int
    time: NDArray[np.uint64] | int
    data: NDArray[np.uint8]
    sequence: NDArray[np.int64] | int


BLOCK_S = 0.1
SHORTEST_BLOCK = 256
FLUSH_S = 0.5


def block_length(rate: float) -> int:
    """Give the number of samples in a full block: the power of two nearest to 0.1 s, at least 256.

    >>> block_length(5120.0), block_length(51200.0), block_length(100.0)
    (512, 4096, 256)
    """
    return max(SHORTEST_BLOCK, 2 ** round(math.log2(max(1.0, rate * BLOCK_S))))


def flush_length(rate: float) -> int:
    """Give the number of samples after which what was recorded goes to the disk: whole blocks, about 0.5 s.

    >>> flush_length(5120.0) / 5120.0
    0.5
    """
    block = block_length(rate)
    return block * max(1, round(FLUSH_S * rate / block))


@dataclass(frozen=True)
class Clock:
    """The sample clock: sample k is taken at start_ns + k / rate, to the nearest nanosecond.

    Attributes
    ----------
    rate : float
        Samples per second, Hz.
    start_ns : int
        Time of sample 0 in nanoseconds since the epoch of the recording.
    """

    rate: float
    start_ns: int = 0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate > 0):
            raise RecordingError(f"a sample rate must be positive and finite, not {self.rate!r} Hz")

    def time_ns(self, sample: int) -> int:
        """Give the time of a sample in nanoseconds; in integers throughout, so that no error builds up.

        >>> Clock(8533.333333333334).time_ns(10**12) // 10**9
        117187499
        """
        return self._times((sample,))[0]

    def times_ns(self, samples: Iterable[int]) -> NDArray[np.uint64]:
        """Give the times of samples in nanoseconds, as exact as `time_ns`."""
        return np.array(self._times(samples), np.uint64)

    def _times(self, samples: Iterable[int]) -> list[int]:
        numerator, denominator = float(self.rate).as_integer_ratio()
        step, divisor = 2 * 10**9 * denominator, 2 * numerator
        return [self.start_ns + (step * sample + numerator) // divisor for sample in samples]

    def samples_at(self, time_ns: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Give the sample numbers nearest to some times.

        Parameters
        ----------
        time_ns : ndarray of uint64
            Nanoseconds since the epoch of the recording.

        Returns
        -------
        ndarray of int64
            Sample numbers, negative before sample 0; clipped where a time is too far away for one.
        """
        # The subtraction wraps around in 64 bits, which is right for every span below 292 years.
        since = (time_ns - np.uint64(self.start_ns % 2**64)).view(np.int64)
        return np.clip(np.rint(since * (self.rate * 1e-9)), -(2.0**62), 2.0**62).astype(np.int64)


@cache
def descriptors(package: str, messages: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]) -> bytes:
    """Describe protobuf messages as MCAP wants them: a FileDescriptorSet with all that it imports.

    Parameters
    ----------
    package : str
        Their package.
    messages : tuple
        (message, ((field, type), ...)); fields are numbered from 1. A type is a protobuf type such as
        ``double``, or the full name of a message; ``[]`` behind it makes the field repeated.

    Returns
    -------
    bytes
        The serialised set.
    """
    from google.protobuf import descriptor_pb2, timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
    described = descriptor_pb2.FileDescriptorSet()
    kinds = descriptor_pb2.FieldDescriptorProto
    for message, fields in messages:
        made = file.message_type.add(name=message)
        for number, (name, kind) in enumerate(fields, start=1):
            repeated, kind = kind.endswith("[]"), kind.removesuffix("[]")
            field = made.field.add(name=name, number=number)
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


@cache
def message_class(described: bytes, name: str) -> Any:
    """Make the protobuf class of a message out of a FileDescriptorSet."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(described).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def checked(fields: Mapping[str, str]) -> dict[str, str]:
    """Add a checksum to the fields of a metadata record, which MCAP itself gives none.

    >>> is_intact(checked({"rate": "5120"})), is_intact(checked({"rate": "5120"}) | {"rate": "5121"})
    (True, False)
    """
    return {**fields, "crc32": _checksum(fields)}


def is_intact(fields: Mapping[str, str]) -> bool:
    """Say whether a metadata record is as `checked` left it."""
    rest = {key: value for key, value in fields.items() if key != "crc32"}
    return fields.get("crc32") == _checksum(rest)


def _checksum(fields: Mapping[str, str]) -> str:
    import zlib

    text = "".join(f"{key}\0{fields[key]}\0" for key in sorted(fields))
    return f"{zlib.crc32(text.encode()):08x}"
