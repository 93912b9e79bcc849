"""Signals of another program's MCAP: topics whose messages hold numbers, in JSON, protobuf or ROS 2's arrays."""

from __future__ import annotations

import json
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from os import SEEK_END
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.opcode import Opcode

from daq.importing.clock import Clock, clock_of_times, rate_of_interval
from daq.importing.signal import Signal
from daq.mcap_file.chunk import (
    CHUNK_HEAD,
    MAGIC,
    RECORD_HEAD,
    Damage,
    Stored,
    parse_message,
    record_at,
    records_in,
    unpack_chunk,
)
from daq.mcap_file.summary import parse
from daq.recording import layout
from rig.arrays import Array
from rig.errors import RecordingError, ShotrigError
from rig.numerics.memory import require_memory_with_program

# Messages of ROS 2 in CDR that are rows of numbers, with the type of the numbers.
_MULTI_ARRAYS = {"std_msgs/msg/Float32MultiArray": "f4", "std_msgs/msg/Float64MultiArray": "f8"}
# Fields that state the sample rate.
_RATES = ("sample_rate_hz", "sample_rate", "sampleRate", "rate", "fs")
# Memory that a byte of a message takes while it is decoded, bytes; at most, measured: JSON `0.0,` as a list of numbers
# and an array, protobuf `0` in one byte.
_DECODED_BYTES = 20
# Copies of a schema or channel in memory.
_COPIES = 4
# Memory of a field in addition to its numbers, bytes.
_FIELD_BYTES = 3000
# Memory of each of its messages in addition to the numbers, bytes.
_MESSAGE_BYTES = 64
Decoder = Callable[[bytes], Mapping[str, Any]]


@dataclass
class _Field:
    """A field of a topic's messages: its numbers, the count and the time of each message, and the stated rate."""

    values: array[float] = field(default_factory=lambda: array("d"))
    counts: array[int] = field(default_factory=lambda: array("q"))
    times: array[int] = field(default_factory=lambda: array("Q"))
    rate: float | None = None


def mcap_signals(path: Path, _stack: ExitStack) -> list[Signal]:
    """List the fields of all topics that hold numbers: an array a message, or one number; they are held in memory.

    The sample rate is stated by a field such as ``sample_rate``, or follows from the times of the messages.
    """
    try:
        with path.open("rb") as file:
            topics = _Topics(path)
            topics.read(file)
    except (ShotrigError, OSError, MemoryError):
        raise
    except Exception as error:
        # A damaged file can cause any exception in a decoder.
        raise RecordingError(
            f"{path} is not an MCAP file, or it is cut off or damaged: {type(error).__name__} {error}"[:300]
        ) from error
    if not topics.fields:
        raise RecordingError(
            f"{path} contains no topic with numbers. Record them as JSON, protobuf or ROS 2's Float32/64MultiArray."
        )
    fields_per_topic = Counter(topic for topic, _ in topics.fields)
    return [
        _signal(path, number, f"{topic}.{name}" if fields_per_topic[topic] > 1 else topic, each, topics.units[topic])
        for number, ((topic, name), each) in enumerate(topics.fields.items(), 1)
    ]


class _Topics:
    """The fields of a file's topics, read within the allowed memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[int, dict[int, Any]] = {Opcode.SCHEMA: {}, Opcode.CHANNEL: {}}
        self._decoders: dict[int, Decoder | None] = {}
        self._in_memory = 0
        self.fields: dict[tuple[str, str], _Field] = {}
        self.units: dict[str, str] = {}

    def read(self, file: IO[bytes]) -> None:
        """Read the data section, record by record."""

        def read(place: int, length: int) -> bytes:
            file.seek(place)
            return file.read(length)

        end = file.seek(0, SEEK_END)
        if read(0, len(MAGIC)) != MAGIC:
            raise Damage("it does not begin with the MCAP signature")
        place, opcode = len(MAGIC), 0
        while opcode != Opcode.DATA_END:
            opcode, content = record_at(read, place, end, end)
            place += RECORD_HEAD.size + len(content)
            if opcode != Opcode.CHUNK:
                self._record(opcode, content, len(content))
                continue
            size = CHUNK_HEAD.unpack_from(content)[2] if len(content) >= CHUNK_HEAD.size else 0
            self._need(size + len(content))
            records = unpack_chunk(content, largest=size)
            for inside, each in records_in(records, len(records)):
                self._record(inside, each, len(content) + len(records))

    def _need(self, further: float) -> None:
        require_memory_with_program(self._in_memory + further, f"{self._path}: importing it")

    def _record(self, opcode: int, content: memoryview, container: int) -> None:
        """Process a record; `container` is the size of the chunk that is in memory with it, bytes."""
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._in_memory += _COPIES * len(content)
            self._need(container)
            record = parse(opcode, content)
            self._known[opcode][record.id] = record
        elif opcode == Opcode.MESSAGE:
            self._message(parse_message(content), container)

    def _message(self, message: Stored, container: int) -> None:
        channel = self._known[Opcode.CHANNEL].get(message.channel)
        if channel is None:
            raise Damage(f"a message belongs to channel {message.channel}, which no record before describes")
        schema = self._known[Opcode.SCHEMA].get(channel.schema_id)
        if channel.topic.startswith(layout.RAW) and schema is not None and schema.name.startswith("shotrig."):
            raise RecordingError(f"{self._path} is a recording already. Use it directly with `analysis` and `daq`.")
        if message.channel not in self._decoders:
            self._decoders[message.channel] = _decoder(schema, channel.message_encoding)
        decoder = self._decoders[message.channel]
        if decoder is None:
            return
        self._need(container + _DECODED_BYTES * len(message.data))
        content = decoder(bytes(message.data))
        self.units.setdefault(channel.topic, str(channel.metadata.get("unit", "")))
        for name, values in _numeric_fields(content):
            if (channel.topic, name) not in self.fields:
                self._in_memory += _FIELD_BYTES
            field = self.fields.setdefault((channel.topic, name), _Field())
            field.values.frombytes(np.ascontiguousarray(values).tobytes())
            field.counts.append(values.size)
            field.times.append(message.publish_time or message.log_time)
            field.rate = field.rate or _stated_rate(content)
            self._in_memory += values.nbytes + _MESSAGE_BYTES
            self._need(container)


def _signal(path: Path, number: int, name: str, field: _Field, unit: str) -> Signal:
    values, counts = np.frombuffer(field.values), np.frombuffer(field.counts, np.int64)
    times = np.frombuffer(field.times, np.uint64)
    if (times[1:] < times[:-1]).any():
        order = np.argsort(times, kind="stable")
        messages = np.split(values, np.cumsum(counts)[:-1])
        values, counts, times = np.concatenate([messages[at] for at in order]), counts[order], times[order]
    elapsed_s = (times - times[0]) * 1e-9
    clock = Clock(field.rate)
    if field.rate is None and values.size == times.size:
        clock = clock_of_times(elapsed_s, 1e-9, f"{path}: the messages on {name}")._replace(start_s=0.0)
    elif field.rate is None and times.size > 1 and elapsed_s[-1] > 0:
        # All but the last array lie between the first time and the last.
        n_intervals = values.size - int(counts[-1])
        clock = Clock(rate_of_interval(float(elapsed_s[-1]) / n_intervals, 1e-9 / n_intervals))
    return Signal.of_array(path, number, name, unit, values, clock, int(times[0]))


def _decoder(schema: Any, encoding: str) -> Decoder | None:
    if encoding == "json":
        return json.loads
    if schema is None:
        return None
    if encoding == "cdr" and schema.name in _MULTI_ARRAYS:
        kind = _MULTI_ARRAYS[schema.name]
        return lambda data: {"": _read_multi_array(data, kind)}
    if encoding == "protobuf":
        from daq.recording.protobuf import message_class

        message = message_class(schema.data, schema.name)
        return lambda data: {each.name: value for each, value in message.FromString(bytes(data)).ListFields()}
    return None


def _numeric_fields(content: Any) -> Iterator[tuple[str, Array]]:
    """Yield the rows of numbers of a message; its single numbers if it has no rows."""
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
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield name, np.array([value], dtype=float)


def _stated_rate(content: Mapping[str, Any]) -> float | None:
    rates = (content.get(name) for name in _RATES)
    return next((float(rate) for rate in rates if isinstance(rate, int | float) and 0 < rate < 1e12), None)


def _read_multi_array(data: bytes, kind: str) -> Array:
    """Read the numbers of a multi-array; they follow its layout, a list of labeled sizes."""
    order = "<" if data[1] & 1 else ">"

    def number(at: int) -> int:
        return int(struct.unpack_from(f"{order}I", data, at)[0])

    def aligned(at: int, size: int) -> int:
        """Return the next position, counted behind the four-byte head, that is aligned to a size."""
        return 4 + -(-(at - 4) // size) * size

    dimensions, at = number(4), 8
    for _ in range(dimensions):
        at = aligned(at + 4 + number(at), 4) + 8
    count, at = number(at + 4), at + 8
    return np.frombuffer(data, f"{order}{kind}", count, aligned(at, int(kind[1]))).astype(float)
