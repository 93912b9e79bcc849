"""A small file damaged at every byte: all intact data is recovered, and no other data."""

from __future__ import annotations

import struct
import zlib

import lz4.frame
import pytest
import zstandard

from daq.mcap_file import chunk as chunk_module
from daq.mcap_file import damaged_file as damaged_file_module
from daq.mcap_file.chunk import CHUNK_HEAD, Damage, Stored, messages_in, records_in, unpack_chunk
from daq.mcap_file.damaged_file import DamagedFile, Intact, Unreadable
from daq.mcap_file.summary import checked

MAGIC = b"\x89MCAP0\r\n"
PACKERS = {b"": bytes, b"zstd": zstandard.compress, b"lz4": lz4.frame.compress}


def record(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value):
    return struct.pack("<I", len(value)) + value


def message(channel, data):
    return record(5, struct.pack("<HIQQ", channel, 7, 2000, 1000) + data)


def chunk(compression, inside, crc=None, size=None):
    packed = PACKERS[compression](inside)
    crc = zlib.crc32(inside) if crc is None else crc
    head = struct.pack("<QQQI", 1000, 2000, len(inside) if size is None else size, crc)
    return head + text(compression) + struct.pack("<Q", len(packed)) + packed


def metadata(fields):
    pairs = b"".join(text(key.encode()) + text(value.encode()) for key, value in fields.items())
    return text(b"run") + text(pairs)


def attachment(data):
    content = struct.pack("<QQ", 1, 2) + text(b"scene") + text(b"text/plain") + struct.pack("<Q", len(data)) + data
    return content + struct.pack("<I", zlib.crc32(content))


INSIDE = [message(1, bytes(range(40))), message(2, b"second " * 4), message(1, b"\x06\x0c\x0f" * 9)]
INDEX = struct.pack("<HI", 1, 16) + struct.pack("<QQ", 5, 6)
CONTENTS = [
    (6, chunk(b"", INSIDE[0])),
    (7, INDEX),
    (0x0C, metadata(checked({"seed": "1", "rate": "5120"}))),
    (6, chunk(b"zstd", INSIDE[1])),
    (9, attachment(b"structure: {}")),
    (6, chunk(b"lz4", INSIDE[2])),
]
HEAD = MAGIC + record(1, text(b"") + text(b"hand"))
END = record(0x0F, struct.pack("<I", 0))
RECORDS = [record(opcode, content) for opcode, content in CONTENTS]
WHOLE = HEAD + b"".join(RECORDS) + END + record(2, bytes(20)) + MAGIC
# Begin, end and content of each record; no index is needed.
SPANS, place = [], len(HEAD)
for each in RECORDS:
    SPANS.append((place, place + len(each)))
    place += len(each)


def content_of(part):
    """Content of a part, as bytes or fields."""
    content = part.content
    if isinstance(content, memoryview):
        return bytes(content)
    return getattr(content, "metadata", None) or bytes(content.data)


# Positions of the length fields: of a chunk, and of its packed content.
LENGTHS = {
    first + byte
    for (opcode, content), (begin, _) in zip(CONTENTS, SPANS, strict=True)
    if opcode == 6
    for first in (begin + 1, begin + 9 + CHUNK_HEAD.size + CHUNK_HEAD.unpack_from(content)[4])
    for byte in range(8)
}

RECORD_LENGTHS = {begin: end - begin for begin, end in SPANS}
# Number of bytes that confirm the length of each record; an attachment must be complete.
BYTES_TO_IDENTIFY = [49, 15, 20, 53, RECORD_LENGTHS[SPANS[4][0]], 52]
EXPECTED_CONTENTS = [INSIDE[0], None, checked({"seed": "1", "rate": "5120"}), INSIDE[1], b"structure: {}", INSIDE[2]]


def parts_of(path, data):
    path.write_bytes(data)
    with DamagedFile(path) as file:
        return list(file.parts())


def test_whole_file_is_read_in_order(tmp_path):
    parts = parts_of(tmp_path / "a", WHOLE)
    assert all(isinstance(part, Intact) for part in parts)
    assert [content_of(part) for part in parts] == [each for each in EXPECTED_CONTENTS if each is not None]
    assert [part.stored for part in parts] == [len(content) for opcode, content in CONTENTS if opcode != 7]


@pytest.mark.parametrize("damage", ["flip", "ones"])
def test_damaged_byte_costs_only_its_record(tmp_path, damage):
    for at in range(len(HEAD) + sum(map(len, RECORDS))):
        data = bytearray(WHOLE)
        data[at] = data[at] ^ (1 << at % 8) if damage == "flip" else 0xFF
        if data == WHOLE:
            continue
        parts = parts_of(tmp_path / "a", data)
        recovered = [content_of(part) for part in parts if isinstance(part, Intact)]
        untouched = [true for true, (begin, end) in zip(EXPECTED_CONTENTS, SPANS, strict=True) if not begin <= at < end]
        assert [
            each for each in EXPECTED_CONTENTS if each is not None and (each in untouched or each in recovered)
        ] == recovered
        assert all(each in recovered for each in untouched if each is not None)
        unreadable = [part for part in parts if isinstance(part, Unreadable)]
        assert len(unreadable) <= 1
        missing = [each for each in EXPECTED_CONTENTS if each is not None and each not in recovered]
        assert not (missing and at in LENGTHS)
        if missing:
            [span] = [span for true, span in zip(EXPECTED_CONTENTS, SPANS, strict=True) if true == missing[0]]
            assert (unreadable[0].begin, unreadable[0].end) == span
            assert unreadable[0].reason


def test_cut_file_keeps_all_records_before_the_cut(tmp_path):
    cuts = {at + offset for span in SPANS for at in span for offset in (0, *range(-10, 70, 3))}
    for cut in sorted(each for each in cuts if len(HEAD) <= each <= SPANS[-1][1]):
        parts = parts_of(tmp_path / "a", WHOLE[:cut])
        before = [
            true for true, (_, end) in zip(EXPECTED_CONTENTS, SPANS, strict=True) if end <= cut and true is not None
        ]
        assert [content_of(part) for part in parts if isinstance(part, Intact)] == before
        cut_records = [begin for begin, end in SPANS if begin < cut < end]
        unreadable_spans = [(part.begin, part.end) for part in parts if isinstance(part, Unreadable)]
        assert unreadable_spans == [(begin, cut) for begin in cut_records]
        for begin, part in zip(cut_records, (each for each in parts if isinstance(each, Unreadable)), strict=True):
            known = (
                cut - begin < 9 or cut - begin >= BYTES_TO_IDENTIFY[SPANS.index((begin, begin + RECORD_LENGTHS[begin]))]
            )
            assert part.reason == ("the file ends within a record" if known else "no record can be identified")


@pytest.mark.parametrize("length", [1, 8, 9, 200, (1 << 20) - 9, (1 << 20) + 5])
def test_record_after_foreign_bytes_is_located(tmp_path, length):
    for filler in (b"\0", b"\xff", b"\x06\x0c\x0f\x07"):
        foreign = (filler * length)[:length]
        parts = parts_of(tmp_path / "a", HEAD + RECORDS[0] + foreign + RECORDS[3] + RECORDS[4] + END)
        begin = len(HEAD) + len(RECORDS[0])
        spans = [(part.begin, part.end) for part in parts if isinstance(part, Unreadable)]
        assert spans == [(begin, begin + length)]
        assert [content_of(part) for part in parts if isinstance(part, Intact)] == [
            EXPECTED_CONTENTS[0],
            EXPECTED_CONTENTS[3],
            EXPECTED_CONTENTS[4],
        ]


@pytest.mark.parametrize("kind", range(len(RECORDS)))
def test_any_record_after_foreign_bytes_is_located(tmp_path, kind):
    for tail in (RECORDS[3] + END, END, b""):
        parts = parts_of(tmp_path / "a", HEAD + bytes(20) + RECORDS[kind] + tail)
        assert (parts[0].begin, parts[0].end) == (len(HEAD), len(HEAD) + 20)
        recovered = [EXPECTED_CONTENTS[kind], EXPECTED_CONTENTS[3] if tail.startswith(RECORDS[3]) else None]
        assert [content_of(part) for part in parts[1:]] == [each for each in recovered if each is not None]
    parts = parts_of(tmp_path / "a", HEAD + bytes(20) + END + RECORDS[kind])
    assert [(part.begin, part.end) for part in parts] == [(len(HEAD), len(HEAD) + 20)]


def inconsistent_records():
    """Return slightly inconsistent beginnings of records."""
    contents = [*CONTENTS[:4], (9, attachment(b"x")[:-1] + b"\0"), (0x0F, bytes(4)), (0x0C, metadata({"seed": "1"}))]
    for opcode, content in contents:
        # A chunk must not have a correct checksum, which would confirm it.
        changed_content = content[:-1] + bytes([content[-1] ^ 1]) if opcode == 6 else content
        for wrong in (-16, -1, 1, 3, 16, 256):
            if len(content) + wrong >= 0:
                yield struct.pack("<BQ", opcode, len(content) + wrong) + changed_content
    yield record(7, struct.pack("<HI", 1, 8) + bytes(8))
    yield record(7, struct.pack("<HI", 1, 17) + bytes(17))
    # No compression of that name.
    for name in (b"zst", b"zstdd", b"lz5", b"a"):
        yield record(6, struct.pack("<QQQI", 1, 2, 9, 3) + text(name) + struct.pack("<Q", 9) + bytes(9))


@pytest.mark.parametrize("before", [b"", bytes(20)])
def test_lookalike_record_is_passed_over(tmp_path, before):
    for decoy in inconsistent_records():
        parts = parts_of(tmp_path / "a", HEAD + RECORDS[2] + before + decoy + RECORDS[3] + RECORDS[4] + END)
        begin = len(HEAD) + len(RECORDS[2])
        spans = [(part.begin, part.end) for part in parts if isinstance(part, Unreadable)]
        assert spans == [(begin, begin + len(before) + len(decoy))], decoy
        assert [content_of(part) for part in parts if isinstance(part, Intact)] == [
            EXPECTED_CONTENTS[2],
            EXPECTED_CONTENTS[3],
            EXPECTED_CONTENTS[4],
        ]


@pytest.mark.parametrize(
    ("kind", "reason"), [(0, "a chunk: "), (3, "a chunk: "), (4, "an attachment"), (2, "the checksum of the metadata")]
)
def test_damaged_record_is_reported_wherever_it_ends(tmp_path, kind, reason):
    damaged = RECORDS[kind][:-1] + bytes([RECORDS[kind][-1] ^ 1])
    for tail in (b"", END, *RECORDS):
        parts = parts_of(tmp_path / "a", HEAD + damaged + tail)
        assert (parts[0].begin, parts[0].end) == (len(HEAD), len(HEAD) + len(damaged))
        assert parts[0].reason.startswith(reason)
    # The length is rejected if no consistent record follows.
    parts = parts_of(tmp_path / "a", HEAD + damaged + bytes(9) + RECORDS[0])
    assert (parts[0].begin, parts[0].end) == (len(HEAD), len(HEAD) + len(damaged) + 9)
    assert parts[0].reason == "no record can be identified" and content_of(parts[1]) == EXPECTED_CONTENTS[0]


@pytest.mark.parametrize("kind", [2, 4])
def test_largest_record_is_read_and_larger_rejected(tmp_path, kind, monkeypatch):
    size = len(CONTENTS[kind][1])
    monkeypatch.setattr(damaged_file_module, "LARGEST_RECORD", size)
    assert content_of(parts_of(tmp_path / "a", HEAD + RECORDS[kind] + END)[0]) == EXPECTED_CONTENTS[kind]
    monkeypatch.setattr(damaged_file_module, "LARGEST_RECORD", size - 1)
    [part] = parts_of(tmp_path / "a", HEAD + RECORDS[kind] + END)
    assert (part.begin, part.end) == (len(HEAD), len(HEAD) + len(RECORDS[kind]))


@pytest.mark.parametrize("kind", [0, 3])
def test_largest_chunk_is_read_and_larger_rejected(tmp_path, kind, monkeypatch):
    content = CONTENTS[kind][1]
    packed = len(content) - CHUNK_HEAD.size - 8 - CHUNK_HEAD.unpack_from(content)[4]
    monkeypatch.setattr(damaged_file_module, "LARGEST_CHUNK", packed)
    assert content_of(parts_of(tmp_path / "a", HEAD + RECORDS[kind] + END)[0]) == EXPECTED_CONTENTS[kind]
    monkeypatch.setattr(damaged_file_module, "LARGEST_CHUNK", packed - 1)
    [part] = parts_of(tmp_path / "a", HEAD + RECORDS[kind] + END)
    assert (part.begin, part.end) == (len(HEAD), len(HEAD) + len(RECORDS[kind]))
    assert part.reason == "a chunk that is too large"


def test_wrong_beginning_is_reported_and_records_searched(tmp_path):
    parts = parts_of(tmp_path / "a", b"not a recording" + RECORDS[0] + END)
    assert (parts[0].begin, parts[0].end) == (0, 15)
    assert "does not begin with the MCAP signature" in parts[0].reason
    assert content_of(parts[1]) == EXPECTED_CONTENTS[0] and len(parts) == 2


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (chunk(b"", INSIDE[0], crc=0), "no checksum"),
        (chunk(b"zstd", INSIDE[0], crc=1), "its checksum is wrong"),
        (chunk(b"zstd", INSIDE[0], size=60), "instead of 60"),
    ],
)
def test_chunk_without_checksum_is_not_used(tmp_path, content, why):
    parts = parts_of(tmp_path / "a", HEAD + record(6, content) + RECORDS[3] + END)
    assert (parts[0].begin, parts[0].end) == (len(HEAD), len(HEAD) + 9 + len(content))
    assert parts[0].reason.startswith("a chunk: ") and why in parts[0].reason
    assert content_of(parts[1]) == EXPECTED_CONTENTS[3]


@pytest.mark.parametrize(
    ("opcode", "content", "why"),
    [(0x0C, metadata({"seed": "1"}), "metadata"), (9, attachment(b"x")[:-1] + b"\0", "attachment")],
)
def test_records_without_right_checksum_are_not_used(tmp_path, opcode, content, why):
    parts = parts_of(tmp_path / "a", HEAD + record(opcode, content) + RECORDS[3] + END)
    assert why in parts[0].reason or isinstance(parts[0], Unreadable)
    assert [content_of(part) for part in parts if isinstance(part, Intact)] == [EXPECTED_CONTENTS[3]]


@pytest.mark.parametrize("compression", PACKERS)
def test_sound_chunk_unpacks_to_its_content(compression):
    inside = b"".join(INSIDE)
    assert unpack_chunk(memoryview(chunk(compression, inside)), checksum_needed=True) == inside
    # MCAP lets a chunk go without a checksum.
    assert unpack_chunk(memoryview(chunk(compression, inside, crc=0))) == inside
    assert unpack_chunk(memoryview(chunk(compression, b"", crc=0))) == b""


@pytest.mark.parametrize("compression", PACKERS)
def test_chunk_damaged_anywhere_is_rejected_or_equal(compression):
    inside = INSIDE[0]
    content = chunk(compression, inside)
    # The times before it are not protected by a checksum.
    for at in range(16, len(content)):
        damaged = bytearray(content)
        damaged[at] ^= 1 << at % 8
        try:
            assert unpack_chunk(memoryview(damaged), checksum_needed=True) == inside
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
    with pytest.raises(Damage, match="claims to unpack to 1001 bytes; at most 1000"):
        unpack_chunk(memoryview(chunk(b"", bytes(1001))))


@pytest.mark.parametrize("compression", [b"zstd", b"lz4"])
def test_packing_ratio_is_limited(compression, monkeypatch):
    content = chunk(compression, bytes(10_000))
    monkeypatch.setattr(chunk_module, "_MAX_RATIO", 3)
    monkeypatch.setattr(chunk_module, "_FREE_RATIO_BYTES", 10_000 - 3 * len(content))
    assert len(unpack_chunk(memoryview(content))) == 10_000
    monkeypatch.setattr(chunk_module, "_FREE_RATIO_BYTES", 10_000 - 3 * len(content) - 1)
    with pytest.raises(Damage, match="claims to unpack from"):
        unpack_chunk(memoryview(content))


def test_stated_sizes_are_limited():
    empty_size, content_size = (len(chunk(b"zstd", each)) for each in (b"", bytes(range(256)) * 9))
    for inside, size, why in (
        (b"", 2**21 + 1000 * empty_size, "instead of"),
        (b"", 2**21 + 1000 * empty_size + 1, "claims to unpack from"),
        (bytes(range(256)) * 9, 2**21 + 1000 * content_size, "instead of"),
        (bytes(range(256)) * 9, 2**21 + 1000 * content_size + 1, "claims to unpack from"),
        (b"", 2**26, "claims to unpack from"),
        (b"", 2**26 + 1, "at most 67108864"),
    ):
        with pytest.raises(Damage, match=why):
            unpack_chunk(memoryview(chunk(b"zstd", inside, size=size)))


@pytest.mark.parametrize("name", [b"zst", b"zstd2", b"lz", b"lz4 ", b"a", b"zz", b"brotli", b"x" * 16])
def test_unknown_compression_is_named(name):
    content = struct.pack("<QQQI", 1, 2, 4, zlib.crc32(b"abcd")) + text(name) + struct.pack("<Q", 4) + b"abcd"
    with pytest.raises(Damage, match=f"compression {name!r} is not known"):
        unpack_chunk(memoryview(content))


@pytest.mark.parametrize("size", [len(INSIDE[0]) - 1, len(INSIDE[0]) + 1])
@pytest.mark.parametrize("compression", PACKERS)
def test_chunk_of_another_size_is_rejected(compression, size):
    with pytest.raises(Damage, match="unpack"):
        unpack_chunk(memoryview(chunk(compression, INSIDE[0], size=size)))


@pytest.mark.parametrize("more", [-20, -1, 1, 20])
@pytest.mark.parametrize("compression", PACKERS)
def test_chunk_length_error_states_both_sizes(compression, more):
    whole = chunk(compression, INSIDE[0])
    begin = CHUNK_HEAD.size + len(compression) + 8
    packed = len(whole) - begin
    content = whole + bytes(more) if more > 0 else whole[:more]
    with pytest.raises(Damage, match=f"claims {packed} bytes of records in {packed + more}$"):
        unpack_chunk(memoryview(content))


def test_misfit_records_of_a_chunk_are_rejected():
    inside = record(4, b"channel") + INSIDE[0] + record(3, b"") + INSIDE[1]
    result = [(opcode, bytes(content)) for opcode, content in records_in(memoryview(inside), len(inside))]
    assert result == [(4, b"channel"), (5, INSIDE[0][9:]), (3, b""), (5, INSIDE[1][9:])]
    messages = messages_in(memoryview(inside), len(inside))
    assert messages[0] == Stored(1, 7, 2000, 1000, memoryview(bytes(range(40))))
    assert [bytes(each.data) for each in messages] == [bytes(range(40)), b"second " * 4]
    assert messages_in(memoryview(message(3, b"")), 31)[0].data == b""
    ends = {0, 16, 16 + len(INSIDE[0]), 25 + len(INSIDE[0]), len(inside)}
    for cut in range(len(inside)):
        if cut not in ends:
            with pytest.raises(Damage, match=r"cut short|claims"):
                list(records_in(memoryview(inside[:cut]), cut))
    for wrong in (record(6, b""), record(2, b""), record(5, bytes(21))):
        with pytest.raises(Damage, match=r"does not belong in a chunk|cut short"):
            messages_in(memoryview(wrong), len(wrong))


def test_more_records_than_bytes_are_rejected(monkeypatch):
    monkeypatch.setattr(chunk_module, "_MAX_EXCESS_RECORDS", 3)
    for stored in (0, 1, 2, 7):
        inside = memoryview(record(3, b"") * (4 + stored))
        assert len(list(records_in(inside[9:], stored))) == 3 + stored
        with pytest.raises(Damage, match=f"more than {3 + stored} records in {stored} bytes"):
            list(records_in(inside, stored))
