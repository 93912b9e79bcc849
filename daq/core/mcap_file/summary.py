"""The records of an MCAP file outside its chunks, and the summary at its end.

The summary repeats schemas and channels, and has an index of every chunk, metadata record and attachment.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, MetadataIndex, Schema, Statistics
from numpy.typing import NDArray

from daq.core.mcap_file.chunk import RECORD_HEAD, Damage

# Maximum number of records of one kind in a summary, except chunk indexes; this limits the memory.
MAX_RECORDS = 1 << 16

# Beginning of a chunk index: times, position and length of the chunk, size of the following map in bytes.
_CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")
# Size of the fields of a chunk index after the map, without the name of the compression.
_CHUNK_INDEX_TAIL_BYTES = 28
_COLUMNS = ("starts", "ends", "offsets", "lengths", "unpacked")


def with_checksum(fields: Mapping[str, str]) -> dict[str, str]:
    """Add a checksum to the fields of a metadata record; MCAP itself has none for it.

    >>> is_intact(with_checksum({"rate": "5120"})), is_intact(with_checksum({"rate": "5120"}) | {"rate": "5121"})
    (True, False)
    """
    text = "".join(f"{key}\0{fields[key]}\0" for key in sorted(fields))
    return {**fields, "crc32": f"{zlib.crc32(text.encode()):08x}"}


def is_intact(fields: Mapping[str, str]) -> bool:
    """Return whether the fields of a metadata record agree with their checksum."""
    return fields == with_checksum({key: value for key, value in fields.items() if key != "crc32"})


def parse_record(opcode: int, content: memoryview, checksum_needed: bool = False) -> Any:
    """Return a record outside the chunks as an object of the package mcap; raise `Damage` if it is malformed.

    The checksums of attachments and metadata records are verified if they exist; if they are needed, they must exist.
    """
    from mcap import records
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    kinds: dict[int, Any] = {
        Opcode.SCHEMA: records.Schema, Opcode.CHANNEL: records.Channel, Opcode.STATISTICS: records.Statistics,
        Opcode.METADATA: records.Metadata, Opcode.METADATA_INDEX: records.MetadataIndex,
        Opcode.ATTACHMENT: records.Attachment, Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
        Opcode.HEADER: records.Header, Opcode.FOOTER: records.Footer, Opcode.DATA_END: records.DataEnd,
        Opcode.CHUNK_INDEX: records.ChunkIndex, Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    }  # fmt: skip
    if opcode not in kinds:
        raise Damage(f"a record with opcode {opcode} does not belong at this position")
    stream = ReadDataStream(BytesIO(content))
    try:
        record = kinds[opcode].read(stream)
    except (McapError, struct.error, UnicodeDecodeError, OverflowError, MemoryError) as error:
        raise Damage(f"a {kinds[opcode].__name__} record is malformed ({type(error).__name__})") from error
    if stream.count > len(content) or (opcode == Opcode.SCHEMA and record.id == 0):
        raise Damage(f"a {kinds[opcode].__name__} record is malformed")
    if opcode == Opcode.ATTACHMENT:
        (checksum,) = struct.unpack_from("<I", content, len(content) - 4)
        if (checksum or checksum_needed) and checksum != zlib.crc32(content[:-4]):
            raise Damage("an attachment has a wrong checksum or none")
    if opcode == Opcode.METADATA:
        fields = record.metadata
        if (checksum_needed or "crc32" in fields) and not is_intact(fields):
            raise Damage(f"the checksum of the metadata {record.name!r} is wrong")
    return record


@dataclass
class Summary:
    """The summary at the end of a file."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    # Each of the following arrays has an element for each chunk, sorted by latest time.
    starts: NDArray[np.uint64]  # earliest time [ns]
    ends: NDArray[np.uint64]  # latest time [ns]
    offsets: NDArray[np.int64]  # position in the file [bytes]
    lengths: NDArray[np.int64]  # length in the file [bytes]
    unpacked: NDArray[np.int64]  # size of the records [bytes]
    chunks_of_channel: Mapping[int, NDArray[np.int64]]  # for each channel: indexes of the chunks with its messages
    metadata: list[MetadataIndex]
    attachments: list[AttachmentIndex]
    statistics: Statistics | None  # counts; None if the file has none


def read_summary(data: memoryview, file_size: int) -> Summary:
    """Parse the summary of a file of `file_size` bytes with verified checksum; raise `Damage` if it is malformed."""
    chunk_positions: defaultdict[int, list[int]] = defaultdict(list)
    kinds = (
        Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX
    )  # fmt: skip
    records_of_kind: dict[int, list[Any]] = {kind: [] for kind in kinds}
    position, end = 0, len(data)
    while position < end:
        if end - position < RECORD_HEAD.size:
            raise Damage("the summary is truncated")
        opcode, length = RECORD_HEAD.unpack_from(data, position)
        position += RECORD_HEAD.size
        if position + length > end:
            raise Damage(f"a record in the summary states a length of {length} bytes, but is truncated")
        if opcode == Opcode.CHUNK_INDEX:
            chunk_positions[length].append(position)
        elif opcode in records_of_kind:
            records = records_of_kind[opcode]
            if len(records) == MAX_RECORDS:
                raise Damage(f"the summary has more than {MAX_RECORDS} records of one kind")
            records.append(parse_record(opcode, data[position : position + length]))
        position += length
    table, chunks_of_channel = _chunk_table(data, chunk_positions, file_size)
    return Summary(
        schemas={record.id: record for record in records_of_kind[Opcode.SCHEMA]},
        channels={record.id: record for record in records_of_kind[Opcode.CHANNEL]},
        **table,
        chunks_of_channel=chunks_of_channel,
        metadata=records_of_kind[Opcode.METADATA_INDEX],
        attachments=records_of_kind[Opcode.ATTACHMENT_INDEX],
        statistics=next(iter(records_of_kind[Opcode.STATISTICS]), None),
    )


def _chunk_table(
    data: memoryview, positions: Mapping[int, list[int]], file_size: int
) -> tuple[dict[str, NDArray[Any]], dict[int, NDArray[np.int64]]]:
    """Return the fields of chunk indexes as arrays, and the chunks of each channel; `positions`: by their length."""
    # Indexes of equal length are parsed in one operation, because a recording of an hour has tens of thousands.
    columns: dict[str, list[NDArray[Any]]] = {column: [] for column in _COLUMNS}
    channels_and_chunks: list[tuple[NDArray[Any], NDArray[np.int64]]] = []
    count = 0
    for length, index_positions in positions.items():
        for start in range(0, len(index_positions), 4096):
            table = _chunk_indexes(data, length, index_positions[start : start + 4096])
            beyond = table["offsets"].clip(0, file_size) + table["lengths"].clip(0, file_size) > file_size
            if (beyond | (table["offsets"] > file_size)).any():
                raise Damage("a chunk index points beyond the end of the file")
            for column, parts in columns.items():
                parts.append(table[column].copy())
            channels = table["map"]["channel"]
            numbers = np.arange(count, count + len(table))
            channels_and_chunks.append((channels.ravel(), np.repeat(numbers, channels.shape[1])))
            count += len(table)
    joined = {column: np.concatenate([np.empty(0, np.uint64), *parts]) for column, parts in columns.items()}
    by_position = np.argsort(joined["offsets"], kind="stable")
    if (np.diff(joined["offsets"][by_position]) < joined["lengths"][by_position][:-1]).any():
        raise Damage("its chunks overlap")
    order = np.lexsort((joined["offsets"], joined["ends"]))
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    arrays = {name: column[order] for name, column in joined.items()}
    for name in ("offsets", "lengths"):
        arrays[name] = arrays[name].astype(np.int64)
    if not channels_and_chunks:
        return arrays, {}
    # Channel and chunk are combined in one number, so a single sort orders the chunks of each channel.
    channel_ids = np.concatenate([channels for channels, _ in channels_and_chunks]).astype(np.int64)
    pairs = np.sort(channel_ids * count + rank[np.concatenate([chunks for _, chunks in channels_and_chunks])])
    channel, chunk = np.divmod(pairs[np.diff(pairs, prepend=-1) > 0], count)
    begins = np.flatnonzero(np.diff(channel, prepend=-1) > 0)
    split = np.split(chunk, begins)[1:]
    return arrays, dict(zip(channel[begins].tolist(), split, strict=True))


def _chunk_indexes(data: memoryview, length: int, positions: list[int]) -> NDArray[Any]:
    """Return the chunk indexes of one length at the given positions as a structured array."""
    if length < _CHUNK_INDEX_HEAD.size + _CHUNK_INDEX_TAIL_BYTES:
        raise Damage("a chunk index is truncated")
    map_bytes = _CHUNK_INDEX_HEAD.unpack_from(data, positions[0])[4]
    name_bytes = length - _CHUNK_INDEX_HEAD.size - map_bytes - _CHUNK_INDEX_TAIL_BYTES
    if map_bytes % 10 or name_bytes < 0:
        raise Damage("a chunk index is malformed")
    entry = np.dtype([("channel", "<u2"), ("offset", "<u8")])
    times_and_positions = [(name, "<u8") for name in _COLUMNS[:4]]
    sizes = [("index_length", "<u8"), ("name_bytes", "<u4"), ("name", f"V{name_bytes}")]
    record = np.dtype(
        [
            *times_and_positions,
            ("map_bytes", "<u4"),
            ("map", entry, (map_bytes // 10,)),
            *sizes,
            ("packed", "<u8"),
            ("unpacked", "<u8"),
        ]
    )
    rows = np.frombuffer(data, np.uint8)[np.array(positions)[:, None] + np.arange(length)]
    table: NDArray[Any] = rows.view(record)[:, 0]
    if (table["map_bytes"] != map_bytes).any() or (table["name_bytes"] != name_bytes).any():
        raise Damage("a chunk index is malformed")
    return table
