"""The intact parts of an MCAP file that is torn or damaged, by its records alone.

Only records with a checksum are used: chunks, attachments, and the metadata records of our recordings. Where a record's
length is damaged, the next consistent record is searched.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

from mcap.opcode import Opcode

from daq.mcap_file.chunk import CHUNK_HEAD, LARGEST_CHUNK, MAGIC, RECORD_HEAD, Damage, unpack_chunk
from daq.mcap_file.reader import LARGEST_RECORD
from daq.mcap_file.summary import parse
from rig.errors import RecordingError

if TYPE_CHECKING:
    from mcap.records import Attachment, Metadata

# The next record is searched in pieces of this size, bytes.
_PIECE_BYTES = 1 << 20
# A record begins with its opcode and a length of eight bytes, the last four of which are zero.
_BEGIN = re.compile(rb"(?=[\x06\x07\x09\x0c\x0f].{4}\0{4})", re.DOTALL)
_COMPRESSIONS = (b"", b"zstd", b"lz4")
_MAX_NAME_BYTES = max(map(len, _COMPRESSIONS))
# Size of the records of a chunk in the file, behind the name of the compression.
_PACKED_SIZE = struct.Struct("<Q")
# Channel, and size of the entries, of a message index; size of an entry: log time and place, bytes.
_INDEX_HEAD = struct.Struct("<HI")
_ENTRY_BYTES = 16
# Size of a text or a map, in front of its content.
_TEXT_SIZE = struct.Struct("<I")
# Length of the record at the end of the data section: a checksum, bytes.
_DATA_END_BYTES = 4
# Bytes that are read to check the beginning of a record.
_CHECKED_BYTES = 64


@dataclass(frozen=True)
class Intact:
    """A part of the file that passed its checksum: a chunk's records, a metadata record, or an attachment."""

    content: memoryview | Metadata | Attachment
    stored: int  # Its size in the file, bytes


@dataclass(frozen=True)
class Unreadable:
    """Bytes of the file that cannot be read, and why."""

    begin: int
    end: int
    reason: str


class DamagedFile:
    """A file whose records are read one by one; raises `RecordingError` if it cannot be opened."""

    def __init__(self, path: Path) -> None:
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path}: not a file. Give the path of a recording.")
        try:
            self._file = path.open("rb", buffering=0)
            self.size = path.stat().st_size
        except OSError as error:
            raise RecordingError(f"{path}: cannot open ({error.strerror}). Check the path.") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _read(self, place: int, length: int) -> memoryview:
        """Read bytes; none where the disk cannot."""
        try:
            self._file.seek(place)
            return memoryview(self._file.read(max(0, min(length, self.size - place))))
        except OSError:
            return memoryview(b"")

    def parts(self) -> Iterator[Intact | Unreadable]:
        """Yield the parts of the data section in order, up to its end or that of the file."""
        place = len(MAGIC)
        if self._read(0, place) != MAGIC:
            place = self._next_record(0)
            yield Unreadable(0, place, "it does not begin with the MCAP signature")
        while place < self.size:
            if self._read(place, RECORD_HEAD.size) == RECORD_HEAD.pack(Opcode.DATA_END, _DATA_END_BYTES):
                return
            part, end = self._part(place)
            if end is None:
                end = self._next_record(place + 1)
                part = Unreadable(place, end, "no record can be identified")
            if part is not None:
                yield part
            place = end

    def _part(self, place: int) -> tuple[Intact | Unreadable | None, int | None]:
        """Identify the record at a place, and its end: None if it cannot be identified."""
        head = self._read(place, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return Unreadable(place, self.size, "the file ends within a record"), self.size
        opcode, length = RECORD_HEAD.unpack(head)
        end = place + RECORD_HEAD.size + length
        chunk = self._chunk(place, length)
        if chunk is not None:
            return chunk
        # The checksum of fields does not cover the length; too large a length would include the next records.
        sized = opcode == Opcode.ATTACHMENT or (opcode == Opcode.METADATA and self._is_consistent(place))
        if sized and length <= LARGEST_RECORD and end <= self.size:
            try:
                return Intact(parse(opcode, self._read(place + RECORD_HEAD.size, length), True), length), end
            except Damage as damage:
                return (Unreadable(place, end, str(damage)), end) if self._is_consistent(end) else (None, None)
        if opcode in (Opcode.HEADER, Opcode.MESSAGE_INDEX) and self._is_consistent(place) and end <= self.size:
            return None, end
        if (
            end > self.size
            and opcode in (Opcode.CHUNK, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX)
            and self._is_consistent(place)
        ):
            return Unreadable(place, self.size, "the file ends within a record"), self.size
        return None, None

    def _chunk(self, place: int, length: int) -> tuple[Intact | Unreadable, int] | None:
        """Try to read a chunk at a place; its length is stated twice, and either may be damaged."""
        begin = place + RECORD_HEAD.size
        head = self._read(begin, CHUNK_HEAD.size + _MAX_NAME_BYTES + _PACKED_SIZE.size)
        if len(head) < CHUNK_HEAD.size + _PACKED_SIZE.size:
            return None
        name_length = CHUNK_HEAD.unpack_from(head)[4]
        fixed = CHUNK_HEAD.size + name_length + _PACKED_SIZE.size
        if len(head) < fixed:
            return None
        (packed,) = _PACKED_SIZE.unpack_from(head, fixed - _PACKED_SIZE.size)
        reason = ""
        for content_length in sorted({length, fixed + packed}, key=lambda candidate: candidate != length):
            if not fixed <= content_length <= LARGEST_CHUNK + fixed or begin + content_length > self.size:
                continue
            content = bytearray(self._read(begin, content_length))
            if len(content) == content_length:
                _PACKED_SIZE.pack_into(content, fixed - _PACKED_SIZE.size, content_length - fixed)
            try:
                records = unpack_chunk(memoryview(content), checksum_needed=True)
                return Intact(records, content_length), begin + content_length
            except Damage as damage:
                reason = f"a chunk: {damage}"
        if length == fixed + packed and begin + length <= self.size and self._is_consistent(begin + length):
            return Unreadable(place, begin + length, reason or "a chunk that is too large"), begin + length
        return None

    def _is_consistent(self, place: int) -> bool:
        """Whether a consistent record begins at a place, or the file ends there."""
        if place == self.size:
            return True
        head = self._read(place, _CHECKED_BYTES)
        if len(head) < RECORD_HEAD.size:
            return False
        opcode, length = RECORD_HEAD.unpack_from(head)
        content = head[RECORD_HEAD.size :]
        try:
            if opcode == Opcode.CHUNK:
                name_length = CHUNK_HEAD.unpack_from(content)[4]
                name = bytes(content[CHUNK_HEAD.size :][:name_length])
                name_end = CHUNK_HEAD.size + name_length
                (packed,) = _PACKED_SIZE.unpack_from(content, name_end)
                return name in _COMPRESSIONS and bool(length == name_end + _PACKED_SIZE.size + packed)
            if opcode == Opcode.MESSAGE_INDEX:
                _, entries_size = _INDEX_HEAD.unpack_from(content)
                return bool(length == _INDEX_HEAD.size + entries_size and entries_size % _ENTRY_BYTES == 0)
            if opcode == Opcode.DATA_END:
                return bool(length == _DATA_END_BYTES)
            if opcode in (Opcode.METADATA, Opcode.HEADER):
                # Two texts, or a text and a map.
                (first,) = _TEXT_SIZE.unpack_from(content)
                second_place = place + RECORD_HEAD.size + _TEXT_SIZE.size + first
                (second,) = _TEXT_SIZE.unpack(self._read(second_place, _TEXT_SIZE.size))
                return bool(length == 2 * _TEXT_SIZE.size + first + second)
            if opcode == Opcode.ATTACHMENT and length <= LARGEST_RECORD:
                parse(opcode, self._read(place + RECORD_HEAD.size, length), True)
                return True
        except (struct.error, Damage):
            return False
        return False

    def _next_record(self, place: int) -> int:
        """Return the place of the next consistent record; the end of the file if there is none."""
        while place < self.size:
            piece = self._read(place, _PIECE_BYTES)
            for match in _BEGIN.finditer(piece):
                if self._is_consistent(place + match.start()):
                    return place + match.start()
            place += _PIECE_BYTES - RECORD_HEAD.size
        return self.size
