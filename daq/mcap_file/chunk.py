"""Chunks of an MCAP file: sizes are bounded, checksums verified."""

from __future__ import annotations

import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from mcap.opcode import Opcode

# Largest chunk that is unpacked, bytes; a recorder's chunks are a thousandth of it.
LARGEST_CHUNK = 1 << 26
# The following limits reject small files that would keep a reader busy for minutes.
# Unpacked size up to which any compression ratio is accepted, bytes.
_FREE_RATIO_BYTES = 1 << 21
# Largest compression ratio beyond this size.
_MAX_RATIO = 1000
# Largest excess of the number of records in a chunk over its bytes in the file.
_MAX_EXCESS_RECORDS = 1 << 10

MAGIC = b"\x89MCAP0\r\n"

RECORD_HEAD = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<QQQII")
_IN_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_of_thread = threading.local()
_MESSAGE_HEAD = struct.Struct("<HIQQ")


class Damage(Exception):
    """Damage of a part of a file; becomes a `RecordingError` where the file's name is known."""


class Stored(NamedTuple):
    """A message of a chunk: number of its channel, place in its topic, times in ns, content."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    data: memoryview


def unpack_chunk(content: memoryview, checksum_needed: bool = False, largest: int | None = None) -> memoryview:
    """Unpack the content of a chunk record, without opcode and length, and verify its checksum.

    `largest` limits the unpacked bytes at any ratio; by default `LARGEST_CHUNK` and the ratio do. Raises `Damage`.
    """
    if len(content) < CHUNK_HEAD.size + 8:
        raise Damage("it is cut short")
    _, _, size, checksum, name_length = CHUNK_HEAD.unpack_from(content)
    begin = CHUNK_HEAD.size + name_length
    if name_length > 16 or len(content) < begin + 8:
        raise Damage("its compression is not named")
    compression = bytes(content[CHUNK_HEAD.size : begin])
    (packed,) = struct.unpack_from("<Q", content, begin)
    if size > (LARGEST_CHUNK if largest is None else largest):
        raise Damage(f"it claims to unpack to {size} bytes; at most {largest or LARGEST_CHUNK} are accepted")
    if largest is None and size > _FREE_RATIO_BYTES + _MAX_RATIO * len(content):
        raise Damage(f"it claims to unpack from {len(content)} bytes to {size}")
    if begin + 8 + packed != len(content):
        raise Damage(f"it claims {packed} bytes of records in {len(content) - begin - 8}")
    records = _unpack(compression, content[begin + 8 :], size)
    if len(records) != size:
        raise Damage(f"it unpacks to {len(records)} bytes instead of {size}")
    if checksum and zlib.crc32(records) != checksum:
        raise Damage("its checksum is wrong")
    if checksum_needed and not checksum:
        raise Damage("it has no checksum")
    return memoryview(records)


def _unpack(compression: bytes, packed: memoryview, size: int) -> bytes | memoryview:
    """Unpack at most `size` bytes; a larger result is rejected before it is made."""
    if compression == b"":
        return packed
    if compression == b"zstd":
        import zstandard

        try:
            claimed = zstandard.get_frame_parameters(packed).content_size
            if claimed not in (size, zstandard.CONTENTSIZE_UNKNOWN):
                raise Damage(f"it unpacks to {claimed} bytes instead of {size}")
            return _decompressor().decompress(packed, max_output_size=size, allow_extra_data=False)
        except zstandard.ZstdError as error:
            raise Damage(f"it cannot be unpacked ({error})") from error
    if compression == b"lz4":
        import lz4.frame  # type: ignore[import-untyped]

        try:
            unpacker = lz4.frame.LZ4FrameDecompressor()
            # One byte more than expected reveals a chunk that is too large.
            records = unpacker.decompress(packed, max_length=size + 1)
        except (RuntimeError, ValueError, EOFError) as error:
            raise Damage(f"it cannot be unpacked ({error})") from error
        if not unpacker.eof or unpacker.unused_data:
            raise Damage("it does not unpack to the stated size")
        return bytes(records)
    raise Damage(f"its compression {compression!r} is not known")


def _decompressor() -> Any:
    """Return this thread's decompressor, which takes as long to make as unpacking ten kilobytes."""
    if not hasattr(_of_thread, "zstd"):
        import zstandard

        _of_thread.zstd = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK)
    return _of_thread.zstd


def record_at(read: Callable[[int, int], bytes], place: int, end: int, largest: int) -> tuple[int, memoryview]:
    """Read opcode and content of the record at a place in a file of `end` bytes; raise `Damage` if it is malformed.

    ``read(place, length)`` gives bytes; content of more than `largest` bytes is rejected.
    """
    head = read(place, RECORD_HEAD.size)
    if len(head) < RECORD_HEAD.size:
        raise Damage("the file ends within a record")
    opcode, length = RECORD_HEAD.unpack(head)
    if length > min(largest, end - place - RECORD_HEAD.size):
        raise Damage(f"a record of kind {opcode} claims {length} bytes")
    return opcode, memoryview(read(place + RECORD_HEAD.size, length))


def records_in(records: memoryview, stored: int) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and content of the records of an unpacked chunk; raise `Damage` if they do not fit into it.

    `stored` is the number of bytes that the chunk takes in the file.
    """
    place, end, budget = 0, len(records), _MAX_EXCESS_RECORDS + stored
    while place < end:
        budget -= 1
        if budget < 0:
            raise Damage(f"it holds more than {_MAX_EXCESS_RECORDS + stored} records in {stored} bytes")
        if end - place < RECORD_HEAD.size:
            raise Damage("a record in it is cut short")
        opcode, length = RECORD_HEAD.unpack_from(records, place)
        begin, place = place + RECORD_HEAD.size, place + RECORD_HEAD.size + length
        if place > end:
            raise Damage(f"a record in it claims {length} bytes")
        if opcode not in _IN_CHUNKS:
            raise Damage(f"a record of kind {opcode} in it, which does not belong in a chunk")
        yield opcode, records[begin:place]


def messages_in(records: memoryview, stored: int) -> list[Stored]:
    """Return the messages among the records of a chunk; raises `Damage` as `records_in`."""
    return [parse_message(content) for opcode, content in records_in(records, stored) if opcode == Opcode.MESSAGE]


def parse_message(content: memoryview) -> Stored:
    """Parse a message record; raise `Damage` if it is cut short."""
    if len(content) < _MESSAGE_HEAD.size:
        raise Damage("a message in it is cut short")
    channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(content)
    return Stored(channel, sequence, log_time, publish_time, content[_MESSAGE_HEAD.size :])
