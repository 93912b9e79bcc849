"""`DamagedFile` recovers every intact record of a damaged MCAP file, and no other data.

The file of these tests has six small records: a chunk of each compression, a message index, a metadata record and an
attachment. Each test damages a byte, cuts the file, or puts foreign bytes between the records.
"""

import struct
from dataclasses import dataclass

import pytest
from mcap.opcode import Opcode

from daq.core.mcap_file import damaged_file as damaged_file_module
from daq.core.mcap_file.chunk import CHUNK_HEAD, MAGIC, RECORD_HEAD
from daq.core.mcap_file.damaged_file import DamagedFile, Intact, Unreadable
from daq.core.mcap_file.summary import with_checksum
from tests.daq.mcap_file.mcap_records import DATA_END, attachment, beginning, chunk, message, record, text

BEGINNING = beginning(b"hand")
MESSAGES = [message(1, bytes(range(40))), message(2, b"second " * 4), message(1, b"\x06\x0c\x0f" * 9)]
FIELDS = with_checksum({"seed": "1", "rate": "5120"})


def metadata(fields):
    """Return the content of a metadata record named run."""
    return text(b"run") + text(b"".join(text(key.encode()) + text(value.encode()) for key, value in fields.items()))


@dataclass(frozen=True)
class FileRecord:
    """A record of the file."""

    name: str
    opcode: int
    content: bytes  # Without opcode and length.
    recovered: bytes | dict[str, str] | None  # Expected of `DamagedFile`; None for an index, which holds no data.
    bytes_to_identify: int  # Number of its first bytes that confirm its opcode and length.
    begin: int  # Position in the file, bytes.

    @property
    def stored(self):
        return record(self.opcode, self.content)

    @property
    def end(self):
        return self.begin + len(self.stored)

    def __str__(self):
        return self.name


def make_records():
    head, chunk_head = RECORD_HEAD.size, CHUNK_HEAD.size
    index = struct.pack("<HI", 1, 16) + struct.pack("<QQ", 5, 6)
    scene = attachment(b"scene", b"structure: {}")
    records = []
    for name, opcode, content, recovered, bytes_to_identify in (
        ("plain chunk", Opcode.CHUNK, chunk(b"", MESSAGES[0]), MESSAGES[0], head + chunk_head + 8),
        ("index", Opcode.MESSAGE_INDEX, index, None, head + 6),
        ("metadata", Opcode.METADATA, metadata(FIELDS), FIELDS, head + len(text(b"run")) + 4),
        ("zstd chunk", Opcode.CHUNK, chunk(b"zstd", MESSAGES[1]), MESSAGES[1], head + chunk_head + len(b"zstd") + 8),
        ("attachment", Opcode.ATTACHMENT, scene, b"structure: {}", head + len(scene) - len(b"structure: {}") - 4),
        ("lz4 chunk", Opcode.CHUNK, chunk(b"lz4", MESSAGES[2]), MESSAGES[2], head + chunk_head + len(b"lz4") + 8),
    ):
        begin = records[-1].end if records else len(BEGINNING)
        records.append(FileRecord(name, opcode, content, recovered, bytes_to_identify, begin))
    return records


RECORDS = make_records()
PLAIN_CHUNK, INDEX, METADATA, ZSTD_CHUNK, ATTACHMENT, LZ4_CHUNK = RECORDS
RECORDS_WITH_DATA = [each for each in RECORDS if each is not INDEX]
RECORDS_END = LZ4_CHUNK.end
FILE = BEGINNING + b"".join(each.stored for each in RECORDS) + DATA_END + record(Opcode.FOOTER, bytes(20)) + MAGIC


def parts_of(path, data):
    """Write a file; return the parts that `DamagedFile` identifies."""
    path.write_bytes(data)
    with DamagedFile(path) as file:
        return list(file.parts())


def recovered_from(parts):
    """Return the contents of the intact parts, as bytes or as fields."""
    contents = [part.content for part in parts if isinstance(part, Intact)]
    return [
        bytes(each) if isinstance(each, memoryview) else getattr(each, "metadata", None) or bytes(each.data)
        for each in contents
    ]


def unreadable_in(parts):
    return [part for part in parts if isinstance(part, Unreadable)]


def unreadable_spans(parts):
    """Return first byte and end of each unreadable part."""
    return [(part.begin, part.end) for part in unreadable_in(parts)]


def expected_of(*records):
    """Return the contents that `DamagedFile` recovers of records."""
    return [each.recovered for each in records if each.recovered is not None]


def with_damaged_last_byte(data):
    return data[:-1] + bytes([data[-1] ^ 1])


def test_intact_file_is_read_in_order(tmp_path):
    parts = parts_of(tmp_path / "a", FILE)
    assert unreadable_in(parts) == []
    assert recovered_from(parts) == expected_of(*RECORDS)
    assert [part.stored_bytes for part in parts] == [len(each.content) for each in RECORDS_WITH_DATA]


def positions_of_chunk_lengths():
    """Return the positions of the bytes of a chunk's length, which is stated twice."""
    positions = set()
    for each in (PLAIN_CHUNK, ZSTD_CHUNK, LZ4_CHUNK):
        name_length = CHUNK_HEAD.unpack_from(each.content)[4]
        for first in (each.begin + 1, each.begin + RECORD_HEAD.size + CHUNK_HEAD.size + name_length):
            positions.update(range(first, first + 8))
    return positions


@pytest.mark.parametrize("damage", ["flipped bit", "all bits set"])
def test_damaged_byte_affects_only_its_record(tmp_path, damage):
    for position in range(RECORDS_END):
        data = bytearray(FILE)
        data[position] = data[position] ^ (1 << position % 8) if damage == "flipped bit" else 0xFF
        if data == FILE:
            continue
        parts = parts_of(tmp_path / "a", data)
        recovered = recovered_from(parts)
        lost = [each for each in RECORDS_WITH_DATA if each.recovered not in recovered]
        assert recovered == expected_of(*[each for each in RECORDS if each not in lost])
        assert all(each.begin <= position < each.end for each in lost)
        assert not (lost and position in positions_of_chunk_lengths())
        unreadable = unreadable_in(parts)
        assert len(unreadable) <= 1
        if lost:
            assert unreadable_spans(parts) == [(lost[0].begin, lost[0].end)]
            assert unreadable[0].reason


def test_truncated_file_keeps_all_complete_records(tmp_path):
    # Around the beginning of each record, every third byte.
    cuts = {
        boundary + offset
        for each in RECORDS
        for boundary in (each.begin, each.end)
        for offset in (0, *range(-10, 70, 3))
    }
    for cut in sorted(cut for cut in cuts if len(BEGINNING) <= cut <= RECORDS_END):
        parts = parts_of(tmp_path / "a", FILE[:cut])
        assert recovered_from(parts) == expected_of(*[each for each in RECORDS if each.end <= cut])
        expected = []
        for each in RECORDS:
            if each.begin < cut < each.end:
                bytes_left = cut - each.begin
                is_identified = bytes_left < RECORD_HEAD.size or bytes_left >= each.bytes_to_identify
                reason = "the file ends within a record" if is_identified else "no record can be identified"
                expected.append(Unreadable(each.begin, cut, reason))
        assert unreadable_in(parts) == expected


# Around the size of the blocks in which the next record is searched, 1 MiB.
@pytest.mark.parametrize("length", [1, 8, 9, 200, (1 << 20) - 9, (1 << 20) + 5])
def test_record_after_foreign_bytes_is_located(tmp_path, length):
    for pattern in (b"\0", b"\xff", b"\x06\x0c\x0f\x07"):
        foreign = (pattern * length)[:length]
        data = BEGINNING + PLAIN_CHUNK.stored + foreign + ZSTD_CHUNK.stored + ATTACHMENT.stored + DATA_END
        parts = parts_of(tmp_path / "a", data)
        assert unreadable_spans(parts) == [(PLAIN_CHUNK.end, PLAIN_CHUNK.end + length)]
        assert recovered_from(parts) == expected_of(PLAIN_CHUNK, ZSTD_CHUNK, ATTACHMENT)


@pytest.mark.parametrize("first", RECORDS, ids=str)
def test_any_record_after_foreign_bytes_is_located(tmp_path, first):
    foreign_span = (len(BEGINNING), len(BEGINNING) + 20)
    for following, is_chunk_next in ((ZSTD_CHUNK.stored + DATA_END, True), (DATA_END, False), (b"", False)):
        parts = parts_of(tmp_path / "a", BEGINNING + bytes(20) + first.stored + following)
        assert (parts[0].begin, parts[0].end) == foreign_span
        assert recovered_from(parts[1:]) == expected_of(first, *([ZSTD_CHUNK] if is_chunk_next else []))
        assert unreadable_in(parts[1:]) == []
    # Records after the end of the data section are not read.
    parts = parts_of(tmp_path / "a", BEGINNING + bytes(20) + DATA_END + first.stored)
    assert [(part.begin, part.end) for part in parts] == [foreign_span]


def inconsistent_records():
    """Yield bytes that resemble a record, but whose length or compression is slightly wrong."""
    wrong_attachment = with_damaged_last_byte(attachment(b"scene", b"x"))
    contents = [(each.opcode, each.content) for each in (PLAIN_CHUNK, INDEX, METADATA, ZSTD_CHUNK)]
    contents += [
        (Opcode.ATTACHMENT, wrong_attachment),
        (Opcode.DATA_END, bytes(4)),
        (Opcode.METADATA, metadata({"seed": "1"})),
    ]
    for opcode, content in contents:
        # A correct checksum would confirm the chunk.
        stored_content = with_damaged_last_byte(content) if opcode == Opcode.CHUNK else content
        for excess in (-16, -1, 1, 3, 16, 256):
            if len(content) + excess >= 0:
                yield struct.pack("<BQ", opcode, len(content) + excess) + stored_content
    # Entries of an index have 16 bytes.
    for size in (8, 17):
        yield record(Opcode.MESSAGE_INDEX, struct.pack("<HI", 1, size) + bytes(size))
    for unknown_compression in (b"zst", b"zstdd", b"lz5", b"a"):
        head = struct.pack("<QQQI", 1, 2, 9, 3)
        yield record(Opcode.CHUNK, head + text(unknown_compression) + struct.pack("<Q", 9) + bytes(9))


@pytest.mark.parametrize("foreign", [b"", bytes(20)])
def test_inconsistent_record_is_skipped(tmp_path, foreign):
    for inconsistent in inconsistent_records():
        wrong_bytes = foreign + inconsistent
        data = BEGINNING + METADATA.stored + wrong_bytes + ZSTD_CHUNK.stored + ATTACHMENT.stored + DATA_END
        parts = parts_of(tmp_path / "a", data)
        begin = len(BEGINNING) + len(METADATA.stored)
        assert unreadable_spans(parts) == [(begin, begin + len(wrong_bytes))], inconsistent
        assert recovered_from(parts) == expected_of(METADATA, ZSTD_CHUNK, ATTACHMENT)


@pytest.mark.parametrize(
    ("damaged", "reason"),
    [
        (PLAIN_CHUNK, "the checksum of the chunk"),
        (ZSTD_CHUNK, "the chunk "),
        (ATTACHMENT, "an attachment"),
        (METADATA, "the checksum of the metadata"),
    ],
    ids=str,
)
def test_damaged_record_is_reported_before_any_record(tmp_path, damaged, reason):
    damaged_bytes = with_damaged_last_byte(damaged.stored)
    begin, end = len(BEGINNING), len(BEGINNING) + len(damaged_bytes)
    for following in (b"", DATA_END, *[each.stored for each in RECORDS]):
        first_part = parts_of(tmp_path / "a", BEGINNING + damaged_bytes + following)[0]
        assert (first_part.begin, first_part.end) == (begin, end)
        assert first_part.reason.startswith(reason)
    # Without a record after it, the length is not confirmed.
    parts = parts_of(tmp_path / "a", BEGINNING + damaged_bytes + bytes(9) + PLAIN_CHUNK.stored)
    assert parts[0] == Unreadable(begin, end + 9, "no record can be identified")
    assert recovered_from(parts[1:]) == expected_of(PLAIN_CHUNK)


@pytest.mark.parametrize("largest", [METADATA, ATTACHMENT], ids=str)
def test_largest_record_is_read_and_larger_rejected(tmp_path, largest, monkeypatch):
    data = BEGINNING + largest.stored + DATA_END
    monkeypatch.setattr(damaged_file_module, "LARGEST_RECORD", len(largest.content))
    assert recovered_from(parts_of(tmp_path / "a", data)) == expected_of(largest)
    monkeypatch.setattr(damaged_file_module, "LARGEST_RECORD", len(largest.content) - 1)
    [part] = parts_of(tmp_path / "a", data)
    assert (part.begin, part.end) == (len(BEGINNING), len(BEGINNING) + len(largest.stored))


@pytest.mark.parametrize("largest", [PLAIN_CHUNK, ZSTD_CHUNK], ids=str)
def test_largest_chunk_is_read_and_larger_rejected(tmp_path, largest, monkeypatch):
    data = BEGINNING + largest.stored + DATA_END
    name_length = CHUNK_HEAD.unpack_from(largest.content)[4]
    packed_size = len(largest.content) - CHUNK_HEAD.size - name_length - 8
    monkeypatch.setattr(damaged_file_module, "LARGEST_CHUNK", packed_size)
    assert recovered_from(parts_of(tmp_path / "a", data)) == expected_of(largest)
    monkeypatch.setattr(damaged_file_module, "LARGEST_CHUNK", packed_size - 1)
    end = len(BEGINNING) + len(largest.stored)
    assert parts_of(tmp_path / "a", data) == [Unreadable(len(BEGINNING), end, "the chunk is too large")]


def test_wrong_beginning_is_reported_and_records_searched(tmp_path):
    parts = parts_of(tmp_path / "a", b"not a recording" + PLAIN_CHUNK.stored + DATA_END)
    assert unreadable_spans(parts) == [(0, len(b"not a recording"))]
    assert "does not begin with the MCAP signature" in parts[0].reason
    assert recovered_from(parts) == expected_of(PLAIN_CHUNK)


@pytest.mark.parametrize(
    ("opcode", "content", "reason"),
    [
        (Opcode.CHUNK, chunk(b"", MESSAGES[0], checksum=0), "no checksum"),
        (Opcode.CHUNK, chunk(b"zstd", MESSAGES[0], checksum=1), "checksum of the chunk is wrong"),
        (Opcode.CHUNK, chunk(b"zstd", MESSAGES[0], size=60), "instead of 60"),
        (Opcode.METADATA, metadata({"seed": "1"}), ""),
    ],
)
def test_unverified_record_is_not_used(tmp_path, opcode, content, reason):
    wrong = record(opcode, content)
    parts = parts_of(tmp_path / "a", BEGINNING + wrong + ZSTD_CHUNK.stored + DATA_END)
    assert unreadable_spans(parts) == [(len(BEGINNING), len(BEGINNING) + len(wrong))]
    assert reason in parts[0].reason
    assert recovered_from(parts) == expected_of(ZSTD_CHUNK)


def nested_records(head, count):
    """Return a file of records that contain all later ones, and are followed by no record.

    `head`: function that returns the beginning of a record's content of a given length.
    """
    length, size = 100, 100 * count
    records = []
    for begin in range(0, size, length):
        opcode, content = head(size - begin - RECORD_HEAD.size)
        records.append((RECORD_HEAD.pack(opcode, size - begin - RECORD_HEAD.size) + content).ljust(length, b"\1"))
    return MAGIC + b"".join(records) + bytes(7)


def nested_chunk(length):
    packed = length - CHUNK_HEAD.size - 8
    return Opcode.CHUNK, CHUNK_HEAD.pack(0, 0, max(packed, 0), 1, 0) + struct.pack("<Q", max(packed, 0))


def nested_attachment(length):
    head = struct.pack("<QQ", 1, 2) + text(b"a") + text(b"b")
    return Opcode.ATTACHMENT, head + struct.pack("<Q", max(length - len(head) - 12, 0))


def nested_metadata(length):
    return Opcode.METADATA, text(b"a") + struct.pack("<I", max(length - 9, 0))


@pytest.mark.parametrize("head", [nested_chunk, nested_attachment, nested_metadata])
def test_search_is_linear_in_the_size(tmp_path, monkeypatch, head):
    monkeypatch.setattr(damaged_file_module, "_MAX_UNCONFIRMED_BYTES", 0)
    read, n_bytes = DamagedFile._read, []

    def counting_read(self, position, length):
        n_bytes[-1] += length
        return read(self, position, length)

    monkeypatch.setattr(DamagedFile, "_read", counting_read)
    for count in (200, 400):
        n_bytes.append(0)
        parts = parts_of(tmp_path / "a", nested_records(head, count) + FILE[len(BEGINNING) :])
        assert recovered_from(parts) == expected_of(*RECORDS)
    assert n_bytes[1] < 2.1 * n_bytes[0]
