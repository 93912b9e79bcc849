"""Chunks of an MCAP file: damage is reported, and sizes are limited before memory is taken."""

import zlib

import numpy as np
import pytest
from mcap.opcode import Opcode

from daq.core.mcap_file import chunk as chunk_module
from daq.core.mcap_file.chunk import CHUNK_HEAD, Damage, StoredMessage, messages_in, records_in, unpack_chunk
from tests.daq.mcap_file.mcap_records import COMPRESSORS, chunk, message, packed_chunk, record

MESSAGE = message(1, bytes(range(40)))


@pytest.mark.parametrize("compression", COMPRESSORS)
def test_intact_chunk_unpacks_to_its_records(compression):
    records = MESSAGE + message(2, b"second " * 4)
    assert unpack_chunk(memoryview(chunk(compression, records)), checksum_needed=True) == records
    # In MCAP, checksum 0 means that there is none.
    assert unpack_chunk(memoryview(chunk(compression, records, checksum=0))) == records
    assert unpack_chunk(memoryview(chunk(compression, b"", checksum=0))) == b""


@pytest.mark.parametrize("compression", COMPRESSORS)
def test_damaged_chunk_is_rejected_or_unpacks_unchanged(compression):
    content = chunk(compression, MESSAGE)
    # The checksum does not cover the two times of the chunk, its first 16 bytes.
    for position in range(16, len(content)):
        damaged = bytearray(content)
        damaged[position] ^= 1 << position % 8
        try:
            assert unpack_chunk(memoryview(damaged), checksum_needed=True) == MESSAGE
        except Damage as damage:
            assert str(damage)
    for cut in range(len(content)):
        with pytest.raises(Damage):
            unpack_chunk(memoryview(content[:cut]))
    with pytest.raises(Damage):
        unpack_chunk(memoryview(content + b"\0"))


def test_unpacked_size_is_limited(monkeypatch):
    monkeypatch.setattr(chunk_module, "LARGEST_CHUNK", 1000)
    assert len(unpack_chunk(memoryview(chunk(b"", bytes(1000))))) == 1000
    with pytest.raises(Damage, match="states 1001 bytes after decompression; at most 1000"):
        unpack_chunk(memoryview(chunk(b"", bytes(1001))))


@pytest.mark.parametrize("compression", [b"zstd", b"lz4"])
def test_compression_ratio_is_limited(compression, monkeypatch):
    content = chunk(compression, bytes(10_000))
    monkeypatch.setattr(chunk_module, "_MAX_RATIO", 3)
    monkeypatch.setattr(chunk_module, "_UNLIMITED_RATIO_BYTES", 10_000 - 3 * len(content))
    assert len(unpack_chunk(memoryview(content))) == 10_000
    monkeypatch.setattr(chunk_module, "_UNLIMITED_RATIO_BYTES", 10_000 - 3 * len(content) - 1)
    with pytest.raises(Damage, match="bytes after decompression; at most"):
        unpack_chunk(memoryview(content))


@pytest.mark.parametrize("records", [b"", bytes(range(256)) * 9])
def test_stated_size_is_limited_by_stored_size(records):
    stored_size = len(chunk(b"zstd", records))
    largest_accepted = 2**21 + 1000 * stored_size
    # Within the limit, the chunk is rejected only for its wrong size.
    for size, reason in ((largest_accepted, "instead of"), (largest_accepted + 1, f"at most {largest_accepted}")):
        with pytest.raises(Damage, match=reason):
            unpack_chunk(memoryview(chunk(b"zstd", records, size=size)))


@pytest.mark.parametrize(("size", "reason"), [(2**26, "instead of"), (2**26 + 1, "at most 67108864")])
def test_stated_size_is_limited_to_largest_chunk(size, reason):
    # The compression ratio of these incompressible bytes would permit a larger size.
    records = np.random.default_rng(1).bytes(70_000)
    with pytest.raises(Damage, match=reason):
        unpack_chunk(memoryview(chunk(b"zstd", records, size=size)))


@pytest.mark.parametrize("name", [b"zst", b"zstd2", b"lz", b"lz4 ", b"a", b"zz", b"brotli", b"x" * 16])
def test_unknown_compression_is_named(name):
    content = packed_chunk(name, b"abcd", 4, zlib.crc32(b"abcd"))
    with pytest.raises(Damage, match=f"compression {name!r} of the chunk is not known"):
        unpack_chunk(memoryview(content))


@pytest.mark.parametrize("size", [len(MESSAGE) - 1, len(MESSAGE) + 1])
@pytest.mark.parametrize("compression", COMPRESSORS)
def test_wrong_size_in_header_is_rejected(compression, size):
    with pytest.raises(Damage, match="decompress"):
        unpack_chunk(memoryview(chunk(compression, MESSAGE, size=size)))


@pytest.mark.parametrize("excess", [-20, -1, 1, 20])
@pytest.mark.parametrize("compression", COMPRESSORS)
def test_chunk_length_error_gives_both_sizes(compression, excess):
    content = chunk(compression, MESSAGE)
    packed_size = len(content) - CHUNK_HEAD.size - len(compression) - 8
    wrong_content = content + bytes(excess) if excess > 0 else content[:excess]
    with pytest.raises(Damage, match=f"states {packed_size} bytes of records, but contains {packed_size + excess}$"):
        unpack_chunk(memoryview(wrong_content))


def opcodes_and_contents(records):
    return [(opcode, bytes(content)) for opcode, content in records_in(memoryview(records), len(records))]


def test_records_of_a_chunk_are_read_in_order():
    channel, schema, second = record(Opcode.CHANNEL, b"channel"), record(Opcode.SCHEMA, b""), message(2, b"second " * 4)
    records = channel + MESSAGE + schema + second
    assert opcodes_and_contents(records) == [
        (Opcode.CHANNEL, b"channel"),
        (Opcode.MESSAGE, MESSAGE[9:]),
        (Opcode.SCHEMA, b""),
        (Opcode.MESSAGE, second[9:]),
    ]
    messages = messages_in(memoryview(records), len(records))
    assert messages[0] == StoredMessage(1, 7, 2000, 1000, memoryview(bytes(range(40))))
    assert [bytes(each.data) for each in messages] == [bytes(range(40)), b"second " * 4]
    empty_message = message(3, b"")
    [empty] = messages_in(memoryview(empty_message), len(empty_message))
    assert empty.data == b""


def test_record_cut_within_a_chunk_is_rejected():
    parts = [record(Opcode.CHANNEL, b"channel"), MESSAGE, record(Opcode.SCHEMA, b""), message(2, b"second " * 4)]
    records = b"".join(parts)
    ends = {len(b"".join(parts[:count])) for count in range(5)}
    for cut in set(range(len(records))) - ends:
        with pytest.raises(Damage, match="truncated"):
            opcodes_and_contents(records[:cut])


@pytest.mark.parametrize(
    "fields", [(Opcode.CHUNK, b""), (Opcode.FOOTER, b""), (0xEE, b""), (Opcode.MESSAGE, bytes(21))]
)
def test_records_foreign_to_a_chunk_are_rejected(fields):
    wrong = record(*fields)
    with pytest.raises(Damage, match=r"does not belong in a chunk|truncated"):
        messages_in(memoryview(wrong), len(wrong))


@pytest.mark.parametrize("stored_bytes", [0, 1, 2, 7])
def test_more_records_than_bytes_are_rejected(monkeypatch, stored_bytes):
    monkeypatch.setattr(chunk_module, "_MAX_EXCESS_RECORDS", 3)
    max_records = 3 + stored_bytes
    empty_record = record(Opcode.SCHEMA, b"")
    assert len(list(records_in(memoryview(empty_record * max_records), stored_bytes))) == max_records
    with pytest.raises(Damage, match=f"more than {max_records} records in {stored_bytes} bytes"):
        list(records_in(memoryview(empty_record * (max_records + 1)), stored_bytes))
