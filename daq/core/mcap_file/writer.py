"""Writer of an MCAP file, chunk by chunk; the caller chooses the content of each chunk.

https://mcap.dev/spec describes the records. The writer of the package mcap encodes messages one by one. This is too
slow for display data, which has about a thousand small messages per second. This writer encodes and indexes messages of
equal size in one operation.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from daq.core.mcap_file.chunk import MAGIC, RECORD_HEAD
from daq.core.mcap_file.compression import Compressor

# Opcodes as plain numbers: the enumeration members of the package mcap are slow to convert.
_MESSAGE_CODE, _CHUNK_CODE = int(Opcode.MESSAGE), int(Opcode.CHUNK)
_INDEX_CODE, _CHUNK_INDEX_CODE = int(Opcode.MESSAGE_INDEX), int(Opcode.CHUNK_INDEX)

# Opcode, length, channel, sequence, log time, publish time.
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS = _MESSAGE.size - RECORD_HEAD.size
# Entry of a message index: log time, position in the chunk.
_ENTRY = struct.Struct("<QQ")
_ENTRIES = np.dtype([("log_time", "<u8"), ("position", "<u8")])
# Message index: opcode, length, channel, size of the following entries in bytes.
_INDEX = struct.Struct("<BQHI")
_INDEX_FIELDS = _INDEX.size - RECORD_HEAD.size
# Chunk index: opcode, length, first and last time, position and length of the chunk, size of the following map in
# bytes. The map and the sizes follow.
_CHUNK_INDEX = struct.Struct("<BQQQQQI")
# Entry of this map: channel, and position of its message index in the file.
_POSITION = struct.Struct("<HQ")
# Chunk: opcode, length, first and last time, size and checksum of the records, length of the compression's name.
_CHUNK = struct.Struct("<BQQQQII")
# Chunk index, after its map: total size of the chunk's message indexes in bytes, length of the compression's name.
_CHUNK_INDEX_END = struct.Struct("<QI")
# Sizes of the compressed and of the uncompressed records of a chunk [bytes].
_SIZE, _SIZES = struct.Struct("<Q"), struct.Struct("<QQ")
_FOOTER = struct.Struct("<BQQQ")


class Stream(Protocol):
    """A sink of bytes."""

    def write(self, data: bytes) -> object:
        """Write further bytes."""

    def tell(self) -> int:
        """Return the number of bytes written so far."""


class ChunkedFile:
    """Writes an MCAP file with compressed chunks, checksums, indexes and a summary at its end."""

    def __init__(self, stream: Stream, library: str) -> None:
        self._stream = stream
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        # Schemas and channels that the next chunk must begin with.
        self._new_descriptions = RecordBuilder()
        self._chunk_indexes: list[bytes] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: dict[int, int] = {}  # number of messages of each channel
        self._times: tuple[int, int] | None = None  # earliest and latest log time [ns]
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
        """Add a schema to the next chunk; return its number."""
        schema = records.Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        schema.write(self._new_descriptions)
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a channel to the next chunk; return its number."""
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=encoding,
            metadata=dict(metadata),
            schema_id=schema,
        )
        self._channels.append(channel)
        channel.write(self._new_descriptions)
        return channel.id

    def add_chunk(self, messages: Iterable[Message | Messages], compressor: Compressor) -> bool:
        """Write messages as a chunk, in the given order; return False if there are no messages."""
        descriptions = self._new_descriptions.end()
        parts, position = [descriptions], len(descriptions)
        entries: defaultdict[int, list[bytes]] = defaultdict(list)
        times: list[int] = []
        for each in messages:
            if isinstance(each, Messages):
                encoded = each.encode()
                index = _index_of(each.log_time, encoded, position)
                for channel, channel_index in zip(each.channels, index, strict=True):
                    entries[channel].append(channel_index.tobytes())
                times += _range_of(each)
                parts.append(encoded.tobytes())
                position += encoded.nbytes
                continue
            channel, log_time, publish_time, data, sequence = each
            size = _MESSAGE_FIELDS + len(data)
            parts += _MESSAGE.pack(_MESSAGE_CODE, size, channel, sequence, log_time, publish_time), data
            entries[channel].append(_ENTRY.pack(log_time, position))
            times.append(log_time)
            position += RECORD_HEAD.size + size
        if not times:
            self._new_descriptions.write(descriptions)
            return False
        self._write_chunk(b"".join(parts), compressor, entries, min(times), max(times))
        return True

    def add_chunk_per_channel(self, messages: Sequence[Messages], compressor: Compressor) -> int:
        """Write a chunk for each channel; all `Messages` must have the same channels. Return the number of chunks."""
        channels = messages[0].channels
        encoded = [each.encode() for each in messages]
        times = [time for each in messages for time in _range_of(each)]
        index, index_position = b"", -1
        for row, channel in enumerate(channels):
            descriptions = b"" if row else self._new_descriptions.end()
            # Channels whose messages begin at the same position have equal indexes.
            if index_position != len(descriptions):
                index_position = position = len(descriptions)
                entries = []
                for each, records in zip(messages, encoded, strict=True):
                    entries.append(_index_of(each.log_time, records[row], position).tobytes())
                    position += records[row].nbytes
                index = b"".join(entries)
            content = b"".join([descriptions, *(records[row].tobytes() for records in encoded)])
            self._write_chunk(content, compressor, {channel: [index]}, min(times), max(times))
        return len(channels)

    def _write_chunk(
        self, content: bytes, compressor: Compressor, entries: Mapping[int, Sequence[bytes]], earliest: int, latest: int
    ) -> None:
        """Write compressed records and index `entries` by channel; `earliest`, `latest`: log times of the chunk."""
        name, packed, size = compressor.name, compressor.compress(content), len(content)
        begin = self._stream.tell()
        length = _CHUNK.size + len(name) + _SIZE.size + len(packed)
        head = _CHUNK.pack(
            _CHUNK_CODE, length - RECORD_HEAD.size, earliest, latest, size, zlib.crc32(content), len(name)
        )
        self._stream.write(b"".join((head, name, _SIZE.pack(len(packed)), packed)))
        positions, indexes, end = [], [], begin + length
        for channel, channel_entries in entries.items():
            positions.append(_POSITION.pack(channel, end))
            entries_size = sum(map(len, channel_entries))
            indexes.append(_INDEX.pack(_INDEX_CODE, _INDEX_FIELDS + entries_size, channel, entries_size))
            indexes += channel_entries
            end += _INDEX.size + entries_size
            self._counts[channel] = self._counts.get(channel, 0) + entries_size // _ENTRY.size
        self._stream.write(b"".join(indexes))
        first_time, last_time = self._times or (earliest, latest)
        self._times = min(first_time, earliest), max(last_time, latest)
        end_fields = (_CHUNK_INDEX_END.pack(end - begin - length, len(name)), name, _SIZES.pack(len(packed), size))
        fields = b"".join((*positions, *end_fields))
        head = _CHUNK_INDEX.pack(
            _CHUNK_INDEX_CODE, _CHUNK_INDEX.size - RECORD_HEAD.size + len(fields), earliest, latest, begin, length,
            _POSITION.size * len(positions),
        )  # fmt: skip
        self._chunk_indexes.append(head + fields)

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
            chunk_count=len(self._chunk_indexes),
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
            Opcode.CHUNK_INDEX: [*self._chunk_indexes],
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
    """Return the numpy type of a message record with `size` bytes of content: the fields of `_MESSAGE`, and content."""
    fields = {"opcode": "u1", "length": "<u8", "channel": "<u2", "sequence": "<u4"}
    times = {"log_time": "<u8", "publish_time": "<u8"}
    return np.dtype([*(fields | times).items(), ("data", "u1", (size,))])


def _index_of(log_time: NDArray[np.uint64], records: NDArray[Any], position: int) -> NDArray[Any]:
    """Return the index entries of messages, given their records and the position of the first record in the chunk."""
    index = np.empty(records.shape, _ENTRIES)
    index["log_time"] = log_time
    index["position"] = np.arange(position, position + records.nbytes, records.itemsize).reshape(records.shape)
    return index


def _range_of(messages: Messages) -> tuple[int, int]:
    """Return the earliest and the latest log time."""
    return int(messages.log_time[0]), int(messages.log_time[-1])


class Message(NamedTuple):
    """A message."""

    channel: int  # number of the channel
    log_time: int  # ns
    publish_time: int  # ns
    data: bytes
    sequence: int  # number of the message in its topic


class Messages(NamedTuple):
    """Messages of equal size on some channels, at least one on each, at the same times."""

    channels: Sequence[int]  # numbers of the channels
    log_time: NDArray[np.uint64]  # ns, in ascending order
    publish_time: NDArray[np.uint64]  # ns
    data: NDArray[np.uint8]  # content of the messages; shape (channels, messages, bytes)
    sequence: NDArray[np.int64]  # numbers of the messages in each topic

    def encode(self) -> NDArray[Any]:
        """Return the records, shape (channels, messages)."""
        size = self.data.shape[-1]
        records = np.empty(self.data.shape[:-1], _record_of(size))
        records["opcode"], records["length"] = _MESSAGE_CODE, _MESSAGE_FIELDS + size
        records["channel"], records["sequence"] = np.array(self.channels)[:, None], self.sequence
        records["log_time"], records["publish_time"] = self.log_time, self.publish_time
        records["data"] = self.data
        return records
