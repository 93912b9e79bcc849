"""Writing an MCAP file chunk by chunk: whoever writes decides what goes into a chunk.

The records are those of the package mcap. Its own writer takes messages one by one, which took longer than
all else about the thousand small ones that a second of display holds; here the messages of a chunk are
encoded, indexed and counted together. https://mcap.dev/spec describes the records.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from typing import Protocol

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from daq.layout import Message

MAGIC = b"\x89MCAP0\r\n"

_RECORD = struct.Struct("<BQ")
# Opcode, length, channel, sequence, log time, publish time.
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS = _MESSAGE.size - _RECORD.size
_INDEX = struct.Struct("<BQHI")
_INDEX_FIELDS = _INDEX.size - _RECORD.size
_FOOTER = struct.Struct("<BQQQ")


class Stream(Protocol):
    """Where the bytes go."""

    def write(self, data: bytes) -> object:
        """Take further bytes."""

    def tell(self) -> int:
        """Give the number of bytes taken so far."""


class ChunkedFile:
    """An MCAP file in the making, with checksums, indexes and a summary at its end.

    Parameters
    ----------
    stream : Stream
        Where to.
    library : str
        What the file says it was written by.
    compression : {'zstd', 'lz4'}
        How chunks are packed.
    """

    def __init__(self, stream: Stream, library: str, compression: str) -> None:
        self._stream, self._compression = stream, compression
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        # Schemas and channels that the next chunk announces.
        self._announced = RecordBuilder()
        self._chunks: list[records.ChunkIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._times: tuple[int, int] | None = None
        stream.write(MAGIC)
        self._put(records.Header("", library))

    def _put(self, *content: records.McapRecord) -> int:
        """Write records one after another; give how many bytes they take."""
        builder = RecordBuilder()
        for record in content:
            record.write(builder)
        data = builder.end()
        self._stream.write(data)
        return len(data)

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Announce a schema in the next chunk; give its number."""
        schema = records.Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        schema.write(self._announced)
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Announce a channel in the next chunk; give its number."""
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

    def add_chunk(self, messages: Iterable[Message]) -> bool:
        """Write messages as a chunk, in their order; say whether there were any."""
        announced = self._announced.end()
        parts, place = [announced], len(announced)
        entries: dict[int, list[int]] = {}
        earliest, latest = 2**64, 0
        for channel, log_time, publish_time, data, sequence in messages:
            size = _MESSAGE_FIELDS + len(data)
            parts += _MESSAGE.pack(Opcode.MESSAGE, size, channel, sequence, log_time, publish_time), data
            entries.setdefault(channel, []).extend((log_time, place))
            place += _RECORD.size + size
            earliest, latest = min(earliest, log_time), max(latest, log_time)
        if not entries:
            self._announced.write(announced)
            return False
        content = b"".join(parts)
        packed = self._packed(content)
        begin = self._stream.tell()
        length = self._put(
            records.Chunk(
                compression=self._compression,
                data=packed,
                message_start_time=earliest,
                message_end_time=latest,
                uncompressed_crc=zlib.crc32(content),
                uncompressed_size=len(content),
            )
        )
        places, indexes, end = {}, [], begin + length
        for channel, pairs in entries.items():
            places[channel] = end
            listed = 8 * len(pairs)
            head = _INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX_FIELDS + listed, channel, listed)
            indexes.append(head + struct.pack(f"<{len(pairs)}Q", *pairs))
            end += len(indexes[-1])
            self._counts[channel] = self._counts.get(channel, 0) + len(pairs) // 2
        self._stream.write(b"".join(indexes))
        before = self._times
        self._times = (
            (earliest, latest) if before is None else (min(before[0], earliest), max(before[1], latest))
        )
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=length,
                chunk_start_offset=begin,
                compression=self._compression,
                compressed_size=len(packed),
                message_end_time=latest,
                message_index_length=end - begin - length,
                message_index_offsets=places,
                message_start_time=earliest,
                uncompressed_size=len(content),
            )
        )
        return True

    def _packed(self, content: bytes) -> bytes:
        if self._compression == "lz4":
            import lz4.frame  # type: ignore[import-untyped]

            return bytes(lz4.frame.compress(content))
        import zstandard

        return bytes(zstandard.compress(content))

    def add_attachment(
        self, create_time: int, log_time: int, name: str, media_type: str, data: bytes
    ) -> None:
        """Write an attachment."""
        begin = self._stream.tell()
        length = self._put(
            records.Attachment(
                create_time=create_time, log_time=log_time, name=name, media_type=media_type, data=data
            )
        )
        self._attachments.append(
            records.AttachmentIndex(
                offset=begin,
                length=length,
                log_time=log_time,
                create_time=create_time,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def add_metadata(self, name: str, fields: Mapping[str, str]) -> None:
        """Write a metadata record."""
        begin = self._stream.tell()
        length = self._put(records.Metadata(metadata=dict(fields), name=name))
        self._metadata.append(records.MetadataIndex(length=length, name=name, offset=begin))

    def finish(self) -> None:
        """Write the summary and the end of the file."""
        self._put(records.DataEnd(0))
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
        groups: dict[Opcode, list[records.McapRecord]] = {
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
                record.write(builder)
            offsets.append(
                records.SummaryOffset(
                    group_opcode=opcode, group_start=begin + start, group_length=builder.count - start
                )
            )
        offsets_begin = begin + builder.count
        for offset in offsets:
            offset.write(builder)
        summary = builder.end()
        footer = _FOOTER.pack(Opcode.FOOTER, 8 + 8 + 4, begin, offsets_begin)
        checksum = zlib.crc32(footer, zlib.crc32(summary))
        self._stream.write(b"".join((summary, footer, struct.pack("<I", checksum), MAGIC)))
