"""Records of an MCAP file, packed by hand after its specification (https://mcap.dev/spec), for tests of the readers."""

import struct
import zlib

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from daq.core.mcap_file.chunk import MAGIC

COMPRESSORS = {b"": bytes, b"zstd": zstandard.compress, b"lz4": lz4.frame.compress}

DATA_END = struct.pack("<BQI", Opcode.DATA_END, 4, 0)


def record(opcode, content):
    """Return a record: opcode, length and content."""
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value):
    """Return a text, or another field of variable length, after its length."""
    return struct.pack("<I", len(value)) + value


def beginning(library):
    """Return signature and header of a file that is written by this library."""
    return MAGIC + record(Opcode.HEADER, text(b"") + text(library))


def message(channel_id, data):
    """Return a message record with sequence number 7, logged at 2000 ns and published at 1000 ns."""
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", channel_id, 7, 2000, 1000) + data)


def packed_chunk(compression, packed, size, checksum):
    """Return the content of a chunk record that states this unpacked size in bytes and this checksum."""
    head = struct.pack("<QQQI", 1000, 2000, size, checksum)
    return head + text(compression) + struct.pack("<Q", len(packed)) + packed


def chunk(compression, records, checksum=None, size=None):
    """Return the content of a chunk record; by default the stated checksum and size are those of its records."""
    checksum = zlib.crc32(records) if checksum is None else checksum
    size = len(records) if size is None else size
    return packed_chunk(compression, COMPRESSORS[compression](records), size, checksum)


def attachment(name, data):
    """Return the content of an attachment record with its checksum."""
    content = struct.pack("<QQ", 1, 2) + text(name) + text(b"text/plain") + struct.pack("<Q", len(data)) + data
    return content + struct.pack("<I", zlib.crc32(content))
