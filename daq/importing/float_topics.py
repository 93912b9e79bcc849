"""Signals of another program's MCAP: topics whose messages hold numbers, in JSON, protobuf or ROS 2's arrays."""

from __future__ import annotations

import json
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os import SEEK_END
from pathlib import Path
from typing import IO, Any

import numpy as np

from daq.importing.signal import Array, Signal, rate_of_interval
from daq.importing.time_gaps import Missing, clock_with_gaps, with_missing
from daq.mcap_file.chunk import (
    CHANNEL,
    CHUNK_HEAD,
    MESSAGE,
    RECORD_HEAD,
    SCHEMA,
    Damage,
    Stored,
    parse_message,
    record_at,
    records_in,
    unpack_chunk,
)
from daq.mcap_file.reader import MAGIC
from daq.mcap_file.summary import CHUNK, DATA_END, parse
from daq.recording import layout
from rig.errors import RecordingError, ShotrigError
from rig.numerics.memory import need_beside_program

# Messages of ROS 2 in CDR that are rows of numbers.
_MULTI_ARRAYS = {"std_msgs/msg/Float32MultiArray": "f4", "std_msgs/msg/Float64MultiArray": "f8"}
_RATES = ("sample_rate_hz", "sample_rate", "sampleRate", "rate", "fs")
# Memory that a byte of a message takes while it is decoded, bytes; at most, measured: JSON `0.0,` as a list of numbers
# and an array, protobuf `0` in one byte.
_DECODED = 20
# Copies of a schema or channel that are held.
_COPIES = 4
# What a field, and each of its messages, take besides its numbers, bytes.
_FIELD_BYTES, _MESSAGE_BYTES = 3000, 64
Decoder = Callable[[bytes], Mapping[str, Any]]


@dataclass
class _Field:
    """A field of a topic's messages: its numbers, how many each message brought, and when."""

    values: array[float] = field(default_factory=lambda: array("d"))
    counts: array[int] = field(default_factory=lambda: array("q"))
    times: array[int] = field(default_factory=lambda: array("Q"))
    rate: float | None = None


def mcap_signals(path: Path) -> list[Signal]:
    """List the fields of all topics that hold numbers: an array a message, or one number; they are held in memory.

    The sample rate is what messages say in a field such as ``sample_rate``, or follows from their times.
    """
    try:
        with path.open("rb") as file:
            topics = _Topics(path)
            topics.read(file)
    except (ShotrigError, OSError, MemoryError):
        raise
    except Exception as error:
        # What decodes messages meets damage as whatever it happens to lead to.
        raise RecordingError(
            f"{path} is no MCAP file, or it is cut off or damaged: {type(error).__name__} {error}"[:300]
        ) from error
    if not topics.fields:
        raise RecordingError(
            f"{path} holds no topic with numbers in JSON, protobuf or ROS 2's Float32/64MultiArray"
        )
    several = Counter(topic for topic, _ in topics.fields)
    return [
        _signal(path, number, f"{topic}.{name}" if several[topic] > 1 else topic, one, topics.units[topic])
        for number, ((topic, name), one) in enumerate(topics.fields.items(), 1)
    ]


class _Topics:
    """The fields of a file's topics, read within the memory that is allowed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, Any] = {}
        self._channels: dict[int, Any] = {}
        self._decoders: dict[int, Decoder | None] = {}
        self._held = 0
        self.fields: dict[tuple[str, str], _Field] = {}
        self.units: dict[str, str] = {}

    def read(self, file: IO[bytes]) -> None:
        """Read the data section, record by record."""

        def read(place: int, length: int) -> bytes:
            file.seek(place)
            return file.read(length)

        end = file.seek(0, SEEK_END)
        if read(0, len(MAGIC)) != MAGIC:
            raise Damage("it does not begin like one")
        place, opcode = len(MAGIC), 0
        while opcode != DATA_END:
            opcode, content = record_at(read, place, end, end)
            place += RECORD_HEAD.size + len(content)
            if opcode == CHUNK:
                records = self._unpacked(content)
                for inside, each in records_in(records, len(records)):
                    self._record(inside, each, len(content) + len(records))
            else:
                self._record(opcode, content, len(content))

    def _unpacked(self, content: memoryview) -> memoryview:
        size = CHUNK_HEAD.unpack_from(content)[2] if len(content) >= CHUNK_HEAD.size else 0
        self._need(size + len(content))
        return unpack_chunk(content, largest=size)

    def _need(self, further: float) -> None:
        need_beside_program(self._held + further, f"{self._path}: importing it")

    def _record(self, opcode: int, content: memoryview, around: int) -> None:
        """Take a record; `around` is the size of the chunk that is in memory with it, bytes."""
        if opcode in (SCHEMA, CHANNEL):
            self._held += _COPIES * len(content)
            self._need(around)
            record = parse(opcode, content)
            known = self._schemas if opcode == SCHEMA else self._channels
            known[record.id] = record
        elif opcode == MESSAGE:
            self._message(parse_message(content), around)

    def _message(self, message: Stored, around: int) -> None:
        channel = self._channels.get(message.channel)
        if channel is None:
            raise Damage(f"a message belongs to channel {message.channel}, which is described nowhere before")
        schema = self._schemas.get(channel.schema_id)
        if channel.topic.startswith(layout.RAW) and schema is not None and schema.name.startswith("shotrig."):
            raise RecordingError(
                f"{self._path} is a recording already: `analysis` and `daq` take it as it is"
            )
        if message.channel not in self._decoders:
            self._decoders[message.channel] = _decoder(schema, channel.message_encoding)
        decoder = self._decoders[message.channel]
        if decoder is None:
            return
        self._need(around + _DECODED * len(message.data))
        content = decoder(bytes(message.data))
        self.units.setdefault(channel.topic, str(channel.metadata.get("unit", "")))
        for name, values in _numbers(content):
            if (channel.topic, name) not in self.fields:
                self._held += _FIELD_BYTES
            one = self.fields.setdefault((channel.topic, name), _Field())
            one.values.frombytes(np.ascontiguousarray(values).tobytes())
            one.counts.append(values.size)
            one.times.append(message.publish_time or message.log_time)
            one.rate = one.rate or _rate(content)
            self._held += values.nbytes + _MESSAGE_BYTES
            self._need(around)


def _signal(path: Path, number: int, name: str, one: _Field, unit: str) -> Signal:
    values, counts = np.frombuffer(one.values), np.frombuffer(one.counts, np.int64)
    times = np.frombuffer(one.times, np.uint64)
    where = f"{path}: the messages on {name}"
    if (times[1:] < times[:-1]).any():
        order = np.argsort(times, kind="stable")
        pieces = np.split(values, np.cumsum(counts)[:-1])
        values, counts, times = np.concatenate([pieces[at] for at in order]), counts[order], times[order]
    start = int(times[0])
    since = (times - times[0]) * 1e-9
    missing: list[Missing] = []
    if one.rate is not None:
        rate: float | None = one.rate
    elif values.size == times.size:
        rate, _, missing = clock_with_gaps(since, 1e-9, where)
    elif times.size > 1 and since[-1] > 0:
        # All but the last array lie between the first time and the last.
        before = values.size - int(counts[-1])
        rate = rate_of_interval(float(since[-1]) / before, 1e-9 / before)
    else:
        rate = None

    def read(first: int, stop: int) -> Array:
        return values[first:stop]

    signal = Signal(path.name, number, name, unit, values.size, rate, read, start_ns=max(start, 0))
    return with_missing(signal, missing)


def _decoder(schema: Any, encoding: str) -> Decoder | None:
    if encoding == "json":
        return json.loads
    if schema is None:
        return None
    if encoding == "cdr" and schema.name in _MULTI_ARRAYS:
        kind = _MULTI_ARRAYS[schema.name]
        return lambda data: {"": _multi_array(data, kind)}
    if encoding == "protobuf":
        from daq.recording.protobuf import message_class

        made = message_class(schema.data, schema.name)
        return lambda data: {each.name: value for each, value in made.FromString(bytes(data)).ListFields()}
    return None


def _numbers(content: Any) -> Iterator[tuple[str, Array]]:
    """Yield the fields of a message that are numbers or rows of numbers; settings beside a row are none."""
    if not isinstance(content, Mapping):
        return
    rows = {
        name: np.asarray(value, dtype=float)
        for name, value in content.items()
        if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes) and len(value)
        if all(isinstance(each, int | float) for each in value[:4])
    }
    yield from rows.items()
    if rows:
        return
    for name, value in content.items():
        if isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool)):
            yield name, np.array([value], dtype=float)


def _rate(content: Mapping[str, Any]) -> float | None:
    for name in _RATES:
        value = content.get(name)
        if isinstance(value, int | float) and 0 < value < 1e12:
            return float(value)
    return None


def _multi_array(data: bytes, kind: str) -> Array:
    """Read the numbers of a multi-array: behind its layout, a list of labelled sizes."""
    order = "<" if data[1] & 1 else ">"

    def number(at: int) -> int:
        return int(struct.unpack_from(f"{order}I", data, at)[0])

    at = 4
    dimensions = number(at)
    at += 4
    for _ in range(dimensions):
        at = _aligned(at + 4 + number(at), 4) + 8
    count, at = number(at + 4), at + 8
    return np.frombuffer(data, f"{order}{kind}", count, _aligned(at, int(kind[1]))).astype(float)


def _aligned(at: int, size: int) -> int:
    """Next place after the four-byte head of a message that is aligned to a size."""
    return 4 + -(-(at - 4) // size) * size
