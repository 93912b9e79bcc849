"""Writing an MCAP file chunk by chunk; the caller determines the content of each chunk.

The records are those of the package mcap. Its writer takes messages one by one, too slow for the thousand small
messages of a second of display; here messages of one size are encoded and indexed together. https://mcap.dev/spec
describes the records.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from daq.mcap_file.chunk import MAGIC, RECORD_HEAD

# Opcodes as plain numbers: those of the package are enumerations, slow to convert.
_MESSAGE_CODE, _CHUNK_CODE = int(Opcode.MESSAGE), int(Opcode.CHUNK)
_INDEX_CODE, _CHUNK_INDEX_CODE = int(Opcode.MESSAGE_INDEX), int(Opcode.CHUNK_INDEX)
# Level of zstd. Samples with noise shrink as much as at the default level 3, in 70 % of the time.
ZSTD_LEVEL = 1

# Opcode, length, channel, sequence, log time, publish time.
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS = _MESSAGE.size - RECORD_HEAD.size
# Log time, place in the chunk.
_ENTRY = struct.Struct("<QQ")
_ENTRIES = np.dtype([("log_time", "<u8"), ("place", "<u8")])
_INDEX = struct.Struct("<BQHI")
_INDEX_FIELDS = _INDEX.size - RECORD_HEAD.size
# Opcode, length, first and last time, place and length of the chunk, bytes of the places that follow; then sizes.
_CHUNK_INDEX = struct.Struct("<BQQQQQI")
# Channel, place of its index in the file.
_PLACE = struct.Struct("<HQ")
_FOOTER = struct.Struct("<BQQQ")


class Stream(Protocol):
    """A sink of bytes."""

    def write(self, data: bytes) -> object:
        """Take further bytes."""

    def tell(self) -> int:
        """Return the number of bytes taken so far."""


class ChunkedFile:
    """Writes an MCAP file with chunks (zstd or lz4), checksums, indexes and a summary at its end."""

    def __init__(self, stream: Stream, library: str, compression: str) -> None:
        self._stream, self._compression = stream, compression.encode()
        name = f"I{len(self._compression)}s"
        self._chunk, self._chunk_sizes = (struct.Struct(form) for form in (f"<BQQQQI{name}Q", f"<Q{name}QQ"))
        # A compressor takes as long to make as packing a small chunk.
        if compression == "lz4":
            import lz4.frame  # type: ignore[import-untyped]

            self._compress: Callable[[bytes], bytes] = lz4.frame.compress
        else:
            from zstandard import ZstdCompressor

            self._compress = ZstdCompressor(level=ZSTD_LEVEL).compress
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        # Schemas and channels that the next chunk announces.
        self._announced = RecordBuilder()
        self._chunks: list[bytes] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._times: tuple[int, int] | None = None
        stream.write(MAGIC)
        self._write_records(records.Header("", library))

    def _write_records(self, *content: records.McapRecord) -> int:
        """Write records; return their size in bytes."""
        builder = RecordBuilder()
        for record in content:
            record.write(builder)
        data = builder.end()
        self._stream.write(data)
        return len(data)

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Announce a schema in the next chunk; return its number."""
        schema = records.Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        schema.write(self._announced)
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Announce a channel in the next chunk; return its number."""
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=encoding,
            metadata=dict(metadata),
            schema_id=schema,
        )
        self._channels.append(channel)
        channel.write(self._announced)
        return channel.id

    def add_chunk(self, messages: Iterable[Message | Messages]) -> bool:
        """Write messages as a chunk, in their order; return False if there are none."""
        announced = self._announced.end()
        parts, place = [announced], len(announced)
        entries: defaultdict[int, list[bytes]] = defaultdict(list)
        times: list[int] = []
        for each in messages:
            if isinstance(each, Messages):
                encoded = _encoded(each)
                index = _index_of(each, encoded, place)
                if isinstance(each.channel, int):
                    entries[each.channel].append(index.tobytes())
                else:
                    for channel, entry in _by_channel(encoded["channel"], index):
                        entries[channel].append(entry)
                if encoded.size:
                    times += _range_of(each.log_time)
                parts.append(encoded.tobytes())
                place += encoded.nbytes
                continue
            channel, log_time, publish_time, data, sequence = each
            size = _MESSAGE_FIELDS + len(data)
            parts += _MESSAGE.pack(_MESSAGE_CODE, size, channel, sequence, log_time, publish_time), data
            entries[channel].append(_ENTRY.pack(log_time, place))
            times.append(log_time)
            place += RECORD_HEAD.size + size
        if not times:
            self._announced.write(announced)
            return False
        self._write_chunk(b"".join(parts), entries, min(times), max(times))
        return True

    def add_chunk_per_channel(self, channels: Sequence[int], messages: Sequence[Messages]) -> int:
        """Write a chunk for each channel; return their number.

        Row k of `data`, shape (channels, messages, bytes), belongs to the channel in place k; times and sequences of
        shape (messages,) are common to all channels.
        """
        numbers = np.array(channels)[:, None]
        rows = [_encoded(each._replace(channel=numbers)) for each in messages]
        times = [time for each in messages for time in _range_of(each.log_time)]
        index, index_place = b"", -1
        for row, channel in enumerate(channels):
            announced = self._announced.end()
            if index_place != len(announced):
                index_place = place = len(announced)
                pieces = []
                for each, encoded in zip(messages, rows, strict=True):
                    pieces.append(_index_of(each, encoded[row], place).tobytes())
                    place += encoded[row].nbytes
                index = b"".join(pieces)
            content = b"".join([announced, *(encoded[row].tobytes() for encoded in rows)])
            self._write_chunk(content, {channel: [index]}, min(times), max(times))
        return len(channels)

    def _write_chunk(self, content: bytes, entries: Mapping[int, Sequence[bytes]], earliest: int, latest: int) -> None:
        """Write the records of a chunk, and the index of each of its channels."""
        packed = self._compress(content)
        begin = self._stream.tell()
        name, size = self._compression, len(content)
        length = self._chunk.size + len(packed)
        head = self._chunk.pack(
            _CHUNK_CODE, length - RECORD_HEAD.size, earliest, latest, size, zlib.crc32(content),
            len(name), name, len(packed),
        )  # fmt: skip
        self._stream.write(head + packed)
        places, indexes, end = [], [], begin + length
        for channel, pieces in entries.items():
            places.append(_PLACE.pack(channel, end))
            listed = sum(map(len, pieces))
            indexes.append(_INDEX.pack(_INDEX_CODE, _INDEX_FIELDS + listed, channel, listed))
            indexes += pieces
            end += _INDEX.size + listed
            self._counts[channel] = self._counts.get(channel, 0) + listed // _ENTRY.size
        self._stream.write(b"".join(indexes))
        first_time, last_time = self._times or (earliest, latest)
        self._times = min(first_time, earliest), max(last_time, latest)
        fixed_size = _CHUNK_INDEX.size - RECORD_HEAD.size + _PLACE.size * len(places) + self._chunk_sizes.size
        head = _CHUNK_INDEX.pack(
            _CHUNK_INDEX_CODE, fixed_size, earliest, latest, begin, length, _PLACE.size * len(places)
        )
        sizes = self._chunk_sizes.pack(end - begin - length, len(name), name, len(packed), size)
        self._chunks.append(b"".join((head, *places, sizes)))

    def add_attachment(self, create_time: int, log_time: int, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment."""
        begin = self._stream.tell()
        length = self._write_records(records.Attachment(create_time, log_time, name, media_type, data))
        index = records.AttachmentIndex(begin, length, log_time, create_time, len(data), name, media_type)
        self._attachments.append(index)

    def add_metadata(self, name: str, fields: Mapping[str, str]) -> None:
        """Write a metadata record."""
        begin = self._stream.tell()
        length = self._write_records(records.Metadata(metadata=dict(fields), name=name))
        self._metadata.append(records.MetadataIndex(length=length, name=name, offset=begin))

    def finish(self) -> None:
        """Write the summary and the end of the file."""
        self._write_records(records.DataEnd(0))
        begin = self._stream.tell()
        first, last = self._times or (0, 0)
        statistics = records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: dict[Opcode, list[records.McapRecord | bytes]] = {
            Opcode.SCHEMA: [*self._schemas],
            Opcode.CHANNEL: [*self._channels],
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: [*self._chunks],
            Opcode.ATTACHMENT_INDEX: [*self._attachments],
            Opcode.METADATA_INDEX: [*self._metadata],
        }
        builder, offsets = RecordBuilder(), []
        for opcode, group in groups.items():
            start = builder.count
            for record in group:
                if isinstance(record, bytes):
                    builder.write(record)
                else:
                    record.write(builder)
            offsets.append(records.SummaryOffset(opcode, begin + start, builder.count - start))
        offsets_begin = begin + builder.count
        for offset in offsets:
            offset.write(builder)
        summary = builder.end()
        footer = _FOOTER.pack(Opcode.FOOTER, 8 + 8 + 4, begin, offsets_begin)
        checksum = zlib.crc32(footer, zlib.crc32(summary))
        self._stream.write(b"".join((summary, footer, struct.pack("<I", checksum), MAGIC)))


@cache
def _record_of(size: int) -> np.dtype[Any]:
    """Describe the record of a message with `size` bytes of content, as `_MESSAGE` and the content."""
    fields = {"opcode": "u1", "length": "<u8", "channel": "<u2", "sequence": "<u4"}
    times = {"log_time": "<u8", "publish_time": "<u8"}
    return np.dtype([*(fields | times).items(), ("data", "u1", (size,))])


def _encoded(messages: Messages) -> NDArray[Any]:
    """Encode messages of one size as records."""
    size = messages.data.shape[-1]
    encoded = np.empty(messages.data.shape[:-1], _record_of(size))
    encoded["opcode"], encoded["length"] = _MESSAGE_CODE, _MESSAGE_FIELDS + size
    encoded["channel"], encoded["sequence"] = messages.channel, messages.sequence
    encoded["log_time"], encoded["publish_time"] = messages.log_time, messages.publish_time
    encoded["data"] = messages.data
    return encoded


def _index_of(messages: Messages, encoded: NDArray[Any], place: int) -> NDArray[Any]:
    """Return the index of encoded messages whose first record is at a place in the chunk."""
    index = np.empty(encoded.shape, _ENTRIES)
    index["log_time"] = messages.log_time
    index["place"] = np.arange(place, place + encoded.nbytes, encoded.itemsize).reshape(index.shape)
    return index


def _range_of(times: NDArray[np.uint64] | int) -> tuple[int, int]:
    """Return the earliest and the latest time."""
    return int(np.minimum.reduce(times, axis=None)), int(np.maximum.reduce(times, axis=None))


def _by_channel(channels: NDArray[Any], index: NDArray[Any]) -> Iterator[tuple[int, bytes]]:
    """Sort the index of messages by channels, in the order of their first messages."""
    channels, index = channels.ravel(), index.ravel()
    order = np.argsort(channels, kind="stable")
    starts = np.flatnonzero(np.diff(channels[order], prepend=-1))
    groups = np.split(index[order], starts[1:])
    for place in np.argsort(order[starts]).tolist():
        yield int(channels[order[starts[place]]]), groups[place].tobytes()


class Message(NamedTuple):
    """A message: number of its channel, times in ns, content, position in its topic."""

    channel: int
    log_time: int
    publish_time: int
    data: bytes
    sequence: int


class Messages(NamedTuple):
    """One or more messages of one size, in the order of `data`.

    Numbers and times are broadcast to the messages, as numpy does.
    """

    channel: NDArray[np.int64] | int
    log_time: NDArray[np.uint64] | int  # Nanoseconds
    publish_time: NDArray[np.uint64] | int  # Nanoseconds
    data: NDArray[np.uint8]  # their content; uint8, shape (..., bytes)
    sequence: NDArray[np.int64] | int  # their positions in their topics
