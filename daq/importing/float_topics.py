"""Signals of another program's MCAP: topics whose messages hold numbers, in JSON, protobuf or ROS 2's arrays."""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from daq.importing.signal import Array, Signal, clock_of_times, rate_of_interval
from daq.recording import layout
from rig.errors import RecordingError

# Messages of ROS 2 in CDR that are rows of numbers.
_MULTI_ARRAYS = {"std_msgs/msg/Float32MultiArray": "f4", "std_msgs/msg/Float64MultiArray": "f8"}
_RATES = ("sample_rate_hz", "sample_rate", "sampleRate", "rate", "fs")
Decoder = Callable[[bytes], Mapping[str, Any]]


@dataclass
class _Field:
    """A field of a topic's messages: its numbers, and when messages began."""

    parts: list[Array] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    rate: float | None = None


def mcap_signals(path: Path, stack: ExitStack) -> list[Signal]:
    """List the fields of all topics that hold numbers: an array a message, or one number; they are held in memory.

    The sample rate is what messages say in a field such as ``sample_rate``, or follows from their times.
    """
    from mcap.reader import make_reader

    fields: dict[tuple[str, str], _Field] = {}
    units: dict[str, str] = {}
    file = stack.enter_context(path.open("rb"))
    try:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if (
                channel.topic.startswith(layout.RAW)
                and schema is not None
                and schema.name.startswith("shotrig.")
            ):
                raise RecordingError(f"{path} is a recording already: `analysis` and `daq` take it as it is")
            decoder = _decoder(schema, channel.message_encoding)
            if decoder is None:
                continue
            content = decoder(message.data)
            units.setdefault(channel.topic, str(channel.metadata.get("unit", "")))
            for name, values in _numbers(content):
                one = fields.setdefault((channel.topic, name), _Field())
                one.parts.append(values)
                one.times.append(message.publish_time or message.log_time)
                one.rate = one.rate or _rate(content)
    except (RecordingError, OSError):
        raise
    except Exception as error:
        # The reader, and what unpacks and decodes for it, meet damage as whatever it happens to lead to.
        raise RecordingError(
            f"{path} is no MCAP file, or it is damaged: {type(error).__name__} {error}"[:300]
        ) from error
    if not fields:
        raise RecordingError(
            f"{path} holds no topic with numbers in JSON, protobuf or ROS 2's Float32/64MultiArray"
        )
    several = Counter(topic for topic, _ in fields)
    return [
        _signal(path, number, f"{topic}.{name}" if several[topic] > 1 else topic, one, units[topic])
        for number, ((topic, name), one) in enumerate(fields.items(), 1)
    ]


def _signal(path: Path, number: int, name: str, one: _Field, unit: str) -> Signal:
    values = np.concatenate(one.parts)
    where = f"{path}: the messages on {name}"
    start = one.times[0]
    since = np.array([time - start for time in one.times]) * 1e-9
    if one.rate is not None:
        rate: float | None = one.rate
    elif values.size == len(one.parts):
        rate, _ = clock_of_times(since, 1e-9, where)
    elif len(one.parts) > 1 and since[-1] > 0:
        # All but the last array lie between the first time and the last.
        before = values.size - one.parts[-1].size
        rate = rate_of_interval(float(since[-1]) / before, 1e-9 / before)
    else:
        rate = None

    def read(first: int, stop: int) -> Array:
        return values[first:stop]

    return Signal(path.name, number, name, unit, values.size, rate, read, start_ns=max(start, 0))


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
