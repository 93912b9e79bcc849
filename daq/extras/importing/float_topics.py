"""Signals from another program's MCAP file: topics whose messages contain numbers.

MCAP is a container of messages on topics. Messages in JSON, in protobuf, and ROS 2's arrays of numbers are decoded.
"""

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

from daq.core.mcap_file.chunk import (
    CHUNK_HEAD,
    MAGIC,
    RECORD_HEAD,
    Damage,
    StoredMessage,
    parse_message,
    record_at,
    records_in,
    unpack_chunk,
)
from daq.core.mcap_file.summary import parse_record
from daq.core.recording import layout
from daq.extras.importing.clock import Clock, clock_of_times, rate_of_interval
from daq.extras.importing.signal import Signal
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, ShotrigError
from rig.core.numerics.memory import require_memory_with_program

# Message types of ROS 2 (encoded in CDR) that are arrays of numbers, with the type of the numbers.
_MULTI_ARRAYS = {"std_msgs/msg/Float32MultiArray": "f4", "std_msgs/msg/Float64MultiArray": "f8"}
# Names of fields that state the sample rate in Hz.
_RATES = ("sample_rate_hz", "sample_rate", "sampleRate", "rate", "fs")
# Largest memory for decoding, bytes per byte of a message, measured with JSON numbers `0.0,` (a list and an array) and
# with protobuf numbers of one byte.
_DECODED_BYTES = 20
# Number of copies of a schema or channel record in memory at a time.
_DESCRIPTION_COPIES = 4
# Memory of a field in addition to its numbers [bytes].
_FIELD_BYTES = 3000
# Memory of each message of a field in addition to its numbers [bytes].
_MESSAGE_BYTES = 64
Decoder = Callable[[bytes], Mapping[str, Any]]


@dataclass
class _TopicField:
    """A field of a topic."""

    values: array[float] = field(default_factory=lambda: array("d"))  # numbers of all messages
    counts: array[int] = field(default_factory=lambda: array("q"))  # count of numbers in each message
    times: array[int] = field(default_factory=lambda: array("Q"))  # time of each message [ns]
    rate: float | None = None  # Hz; None if not stated


def mcap_signals(path: Path, _stack: ExitStack) -> list[Signal]:
    """List, as signals in memory, the fields of topics that contain numbers or arrays of numbers.

    The sample rate is stated by a field such as ``sample_rate``, or follows from the times of the messages.
    """
    try:
        with path.open("rb") as file:
            reader = _TopicReader(path)
            reader.read(file)
    except (ShotrigError, OSError, MemoryError):
        raise
    except Exception as error:
        # A damaged file can cause any exception in a decoder.
        reason = str(error) if isinstance(error, Damage) else f"{type(error).__name__}: {error}"
        raise RecordingError(
            f"{path} is not an MCAP file, or it is truncated or damaged ({reason:.200}). Export it again."
        ) from error
    if not reader.fields:
        raise RecordingError(
            f"{path} contains no topic with numbers. Record numbers as JSON, protobuf or ROS 2's Float32/64MultiArray."
        )
    fields_per_topic = Counter(topic for topic, _ in reader.fields)
    return [
        _signal(
            path, number, f"{topic}.{name}" if fields_per_topic[topic] > 1 else topic, topic_field, reader.units[topic]
        )
        for number, ((topic, name), topic_field) in enumerate(reader.fields.items(), 1)
    ]


class _TopicReader:
    """Reads the numeric fields of all topics of a file within the allowed memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptions: dict[int, dict[int, Any]] = {Opcode.SCHEMA: {}, Opcode.CHANNEL: {}}
        self._decoders: dict[int, Decoder | None] = {}
        self._in_memory = 0
        self.fields: dict[tuple[str, str], _TopicField] = {}
        self.units: dict[str, str] = {}

    def read(self, file: IO[bytes]) -> None:
        """Read the data section, record by record."""

        def read(position: int, length: int) -> bytes:
            file.seek(position)
            return file.read(length)

        end = file.seek(0, SEEK_END)
        if read(0, len(MAGIC)) != MAGIC:
            raise Damage("the file does not begin with the MCAP signature")
        position, opcode = len(MAGIC), 0
        while opcode != Opcode.DATA_END:
            opcode, content = record_at(read, position, end, end)
            position += RECORD_HEAD.size + len(content)
            if opcode != Opcode.CHUNK:
                self._process_record(opcode, content, len(content))
                continue
            size = CHUNK_HEAD.unpack_from(content)[2] if len(content) >= CHUNK_HEAD.size else 0
            self._require_memory(size + len(content))
            records = unpack_chunk(content, largest=size)
            for inner_opcode, inner_content in records_in(records, len(records)):
                self._process_record(inner_opcode, inner_content, len(content) + len(records))

    def _require_memory(self, extra_bytes: float) -> None:
        require_memory_with_program(self._in_memory + extra_bytes, f"{self._path}: importing it")

    def _process_record(self, opcode: int, content: memoryview, chunk_bytes: int) -> None:
        """Process a record; `chunk_bytes` is the memory of the chunk that contains it."""
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._require_memory(chunk_bytes + _DESCRIPTION_COPIES * len(content))
            record = parse_record(opcode, content)
            # Writers may repeat a description in every chunk.
            if record.id not in self._descriptions[opcode]:
                self._in_memory += _DESCRIPTION_COPIES * len(content)
            self._descriptions[opcode][record.id] = record
        elif opcode == Opcode.MESSAGE:
            self._add_message(parse_message(content), chunk_bytes)

    def _add_message(self, message: StoredMessage, chunk_bytes: int) -> None:
        channel = self._descriptions[Opcode.CHANNEL].get(message.channel)
        if channel is None:
            raise Damage(f"a message belongs to channel {message.channel}, which no earlier record describes")
        schema = self._descriptions[Opcode.SCHEMA].get(channel.schema_id)
        if channel.topic.startswith(layout.RAW) and schema is not None and schema.name.startswith("shotrig."):
            raise RecordingError(f"{self._path} is a recording already. Use it directly with `analysis` and `daq`.")
        if message.channel not in self._decoders:
            self._decoders[message.channel] = _decoder(schema, channel.message_encoding)
        decoder = self._decoders[message.channel]
        if decoder is None:
            return
        self._require_memory(chunk_bytes + _DECODED_BYTES * len(message.data))
        content = decoder(bytes(message.data))
        self.units.setdefault(channel.topic, str(channel.metadata.get("unit", "")))
        for name, values in _numeric_fields(content):
            if (channel.topic, name) not in self.fields:
                self._in_memory += _FIELD_BYTES
            topic_field = self.fields.setdefault((channel.topic, name), _TopicField())
            topic_field.values.frombytes(np.ascontiguousarray(values).tobytes())
            topic_field.counts.append(values.size)
            topic_field.times.append(message.publish_time or message.log_time)
            topic_field.rate = topic_field.rate or _stated_rate(content)
            self._in_memory += values.nbytes + _MESSAGE_BYTES
            self._require_memory(chunk_bytes)


def _signal(path: Path, number: int, name: str, topic_field: _TopicField, unit: str) -> Signal:
    values, counts = np.frombuffer(topic_field.values), np.frombuffer(topic_field.counts, np.int64)
    times = np.frombuffer(topic_field.times, np.uint64)
    if (times[1:] < times[:-1]).any():
        time_order = np.argsort(times, kind="stable")
        messages = np.split(values, np.cumsum(counts)[:-1])
        values = np.concatenate([messages[index] for index in time_order])
        counts, times = counts[time_order], times[time_order]
    elapsed_s = (times - times[0]) * 1e-9
    clock = Clock(topic_field.rate)
    if topic_field.rate is None and values.size == times.size:
        clock = clock_of_times(elapsed_s, 1e-9, f"{path}: the messages on {name}")._replace(start_s=0.0)
    elif topic_field.rate is None and times.size > 1 and elapsed_s[-1] > 0:
        # The time from the first to the last message is the duration of all arrays except the last.
        n_intervals = values.size - int(counts[-1])
        clock = Clock(rate_of_interval(float(elapsed_s[-1]) / n_intervals, 1e-9 / n_intervals))
    return Signal.from_array(path, number, name, unit, values, clock, int(times[0]))


def _decoder(schema: Any, encoding: str) -> Decoder | None:
    if encoding == "json":
        return json.loads
    if schema is None:
        return None
    if encoding == "cdr" and schema.name in _MULTI_ARRAYS:
        number_type = _MULTI_ARRAYS[schema.name]
        return lambda data: {"": _read_multi_array(data, number_type)}
    if encoding == "protobuf":
        from daq.core.mcap_file.protobuf import message_class

        message = message_class(schema.data, schema.name)
        return lambda data: {each.name: value for each, value in message.FromString(bytes(data)).ListFields()}
    return None


def _numeric_fields(content: Any) -> Iterator[tuple[str, Array]]:
    """Yield name and numbers of the arrays in a message, or of its single numbers if it has no arrays."""
    if not isinstance(content, Mapping):
        return
    rows = {
        name: np.asarray(value, dtype=float)
        for name, value in content.items()
        if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes) and len(value)
        if all(isinstance(item, int | float) for item in value[:4])
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


def _read_multi_array(data: bytes, number_type: str) -> Array:
    """Read the numbers of a MultiArray message, which follow its layout: a list of dimensions with labels."""
    byte_order = "<" if data[1] & 1 else ">"

    def read_integer(position: int) -> int:
        return int(struct.unpack_from(f"{byte_order}I", data, position)[0])

    def aligned(position: int, size: int) -> int:
        """Return the next position that is a multiple of `size` bytes after the four-byte head."""
        return 4 + -(-(position - 4) // size) * size  # rounded up

    dimensions, position = read_integer(4), 8
    for _ in range(dimensions):
        position = aligned(position + 4 + read_integer(position), 4) + 8
    count, begin = read_integer(position + 4), aligned(position + 8, int(number_type[1]))
    return np.frombuffer(data, f"{byte_order}{number_type}", count, begin).astype(float)
