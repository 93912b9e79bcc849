"""Chunks of an MCAP file: decompression and parsing, with bounded sizes and verified checksums.

A chunk is a compressed sequence of records: messages, and the schemas and channels that they require.
"""

import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from mcap.opcode import Opcode

# Largest accepted size of an unpacked chunk [bytes]. The recorder's chunks are a thousand times smaller.
LARGEST_CHUNK = 1 << 26
# The next three limits reject small files that would keep a reader busy for minutes. Up to this unpacked size in bytes,
# any compression ratio is accepted.
_UNLIMITED_RATIO_BYTES = 1 << 21
# Largest accepted compression ratio of larger chunks: samples with noise compress far less, a malformed file more.
_MAX_RATIO = 1000
# A chunk of n bytes in the file may have at most n plus this number of records, which a malformed file exceeds.
_MAX_EXCESS_RECORDS = 1 << 10

MAGIC = b"\x89MCAP0\r\n"

RECORD_HEAD = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<QQQII")
_CHUNK_OPCODES = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_thread_local = threading.local()
MESSAGE_HEAD = struct.Struct("<HIQQ")


class Damage(Exception):
    """Damage of a file; callers that know the path of the file convert this error to a `RecordingError`."""


class StoredMessage(NamedTuple):
    """A message of a chunk."""

    channel: int  # number of the channel
    sequence: int  # number of the message in its topic
    log_time: int  # ns
    publish_time: int  # ns
    data: memoryview


def unpack_chunk(content: memoryview, checksum_needed: bool = False, largest: int | None = None) -> memoryview:
    """Return the records in a chunk, given its content without opcode and length; verify its checksum.

    `largest` is the largest accepted number of unpacked bytes; by default, it follows from `LARGEST_CHUNK` and the
    compression ratio. Raises `Damage`.
    """
    if len(content) < CHUNK_HEAD.size + 8:
        raise Damage("the chunk is truncated")
    _, _, size, checksum, name_length = CHUNK_HEAD.unpack_from(content)
    begin = CHUNK_HEAD.size + name_length
    if name_length > 16 or len(content) < begin + 8:
        raise Damage("the chunk does not name its compression")
    compression = bytes(content[CHUNK_HEAD.size : begin])
    (packed,) = struct.unpack_from("<Q", content, begin)
    if largest is None:
        largest = min(LARGEST_CHUNK, _UNLIMITED_RATIO_BYTES + _MAX_RATIO * len(content))
    if size > largest:
        raise Damage(f"the chunk states {size} bytes after decompression; at most {largest} are accepted")
    if begin + 8 + packed != len(content):
        raise Damage(f"the chunk states {packed} bytes of records, but contains {len(content) - begin - 8}")
    records = _unpack(compression, content[begin + 8 :], size)
    if len(records) != size:
        raise Damage(f"the chunk decompresses to {len(records)} bytes instead of {size}")
    if checksum and zlib.crc32(records) != checksum:
        raise Damage("the checksum of the chunk is wrong")
    if checksum_needed and not checksum:
        raise Damage("the chunk has no checksum")
    return memoryview(records)


def _unpack(compression: bytes, packed: memoryview, size: int) -> bytes | memoryview:
    """Unpack at most `size` bytes; a larger result is rejected before it is allocated."""
    if compression == b"":
        return packed
    if compression == b"zstd":
        import zstandard

        try:
            claimed = zstandard.get_frame_parameters(packed).content_size
            if claimed not in (size, zstandard.CONTENTSIZE_UNKNOWN):
                raise Damage(f"the chunk decompresses to {claimed} bytes instead of {size}")
            return _decompressor().decompress(packed, max_output_size=size, allow_extra_data=False)
        except zstandard.ZstdError as error:
            raise Damage(f"the chunk cannot be decompressed ({error})") from error
    if compression == b"lz4":
        import lz4.frame  # type: ignore[import-untyped]

        try:
            unpacker = lz4.frame.LZ4FrameDecompressor()
            # Request one byte more than expected, to detect a chunk that is too large.
            records = unpacker.decompress(packed, max_length=size + 1)
        except (RuntimeError, ValueError, EOFError) as error:
            raise Damage(f"the chunk cannot be decompressed ({error})") from error
        if not unpacker.eof or unpacker.unused_data:
            raise Damage(f"the chunk states {size} bytes after decompression, but decompresses to a different size")
        return bytes(records)
    raise Damage(f"the compression {compression!r} of the chunk is not known; expected zstd, lz4 or none")


def _decompressor() -> Any:
    """Return the cached decompressor of this thread; creating one takes as long as unpacking 10 kB."""
    if not hasattr(_thread_local, "zstd"):
        import zstandard

        _thread_local.zstd = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK)
    return _thread_local.zstd


def record_at(read: Callable[[int, int], bytes], position: int, end: int, largest: int) -> tuple[int, memoryview]:
    """Return opcode and content, at most `largest` bytes, of the record at a position; `Damage` if malformed."""
    head = read(position, RECORD_HEAD.size)
    if len(head) < RECORD_HEAD.size:
        raise Damage("the file ends within a record")
    opcode, length = RECORD_HEAD.unpack(head)
    longest = min(largest, end - position - RECORD_HEAD.size)
    if length > longest:
        raise Damage(f"a record with opcode {opcode} states a length of {length} bytes; at most {longest} are possible")
    return opcode, memoryview(read(position + RECORD_HEAD.size, length))


def records_in(records: memoryview, stored_bytes: int) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and content of an unpacked chunk of `stored_bytes` in the file; `Damage` if malformed."""
    position, end, records_left = 0, len(records), _MAX_EXCESS_RECORDS + stored_bytes
    while position < end:
        records_left -= 1
        if records_left < 0:
            raise Damage(
                f"the chunk has more than {_MAX_EXCESS_RECORDS + stored_bytes} records in {stored_bytes} bytes"
            )
        if end - position < RECORD_HEAD.size:
            raise Damage("a record in the chunk is truncated")
        opcode, length = RECORD_HEAD.unpack_from(records, position)
        begin, position = position + RECORD_HEAD.size, position + RECORD_HEAD.size + length
        if position > end:
            raise Damage(f"a record in the chunk states a length of {length} bytes, but is truncated")
        if opcode not in _CHUNK_OPCODES:
            raise Damage(f"a record with opcode {opcode} does not belong in a chunk")
        yield opcode, records[begin:position]


def messages_in(records: memoryview, stored_bytes: int) -> list[StoredMessage]:
    """Return the messages among the records of a chunk; raises `Damage` like `records_in`."""
    return [parse_message(content) for opcode, content in records_in(records, stored_bytes) if opcode == Opcode.MESSAGE]


def parse_message(content: memoryview) -> StoredMessage:
    """Parse a message record; raise `Damage` if the record is truncated."""
    if len(content) < MESSAGE_HEAD.size:
        raise Damage("a message is truncated")
    channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(content)
    return StoredMessage(channel, sequence, log_time, publish_time, content[MESSAGE_HEAD.size :])
