"""Finding what is intact in an MCAP file that is torn or damaged, from its records alone.

Nothing is believed without a checksum: chunks and attachments have one, and the metadata records of this
project's recordings. Where a record's length is damaged, the next record that agrees with itself is sought.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from daq.mcap_file.chunk import CHUNK_HEAD, LARGEST_CHUNK, RECORD_HEAD, Damage, unpack_chunk
from daq.mcap_file.metadata_checksum import is_intact
from daq.mcap_file.reader import LARGEST_RECORD, MAGIC
from daq.mcap_file.summary import ATTACHMENT, CHUNK, DATA_END, HEADER, MESSAGE_INDEX, METADATA, parse
from rig.errors import RecordingError

if TYPE_CHECKING:
    from mcap.records import Attachment, Metadata

_WINDOW = 1 << 20
# A record begins with its opcode and a length, of which more than four bytes are never used.
_BEGIN = re.compile(rb"(?=[\x06\x07\x09\x0c\x0f].{4}\0{4})", re.DOTALL)
_COMPRESSIONS = (b"", b"zstd", b"lz4")


@dataclass(frozen=True)
class Intact:
    """A part of the file that passed its checksum: a chunk's records, a metadata record, or an attachment.

    `stored` says how many bytes it takes in the file.
    """

    content: memoryview | Metadata | Attachment
    stored: int


@dataclass(frozen=True)
class Unreadable:
    """Bytes of the file from which nothing could be had, and why."""

    begin: int
    end: int
    reason: str


class DamagedFile:
    """A file whose records are walked through one by one.

    Raises
    ------
    RecordingError
        If it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path} is no file")
        try:
            self._file = path.open("rb", buffering=0)
            self.size = path.stat().st_size
        except OSError as error:
            raise RecordingError(f"cannot open {path}: {error.strerror}") from error

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
        """Yield what the file's data consist of, in order, up to their end or that of the file."""
        place = len(MAGIC)
        if self._read(0, place) != MAGIC:
            place = self._next_record(0)
            yield Unreadable(0, place, "it does not begin like an MCAP file")
        while place < self.size:
            if self._is_data_end(place):
                return
            part, end = self._part(place)
            if end is None:
                end = self._next_record(place + 1)
                part = Unreadable(place, end, "no record is to be made out")
            if part is not None:
                yield part
            place = end

    def _is_data_end(self, place: int) -> bool:
        return self._read(place, RECORD_HEAD.size) == RECORD_HEAD.pack(DATA_END, 4)

    def _part(self, place: int) -> tuple[Intact | Unreadable | None, int | None]:
        """Make out the record at a place, and where it ends: None if it cannot be made out."""
        head = self._read(place, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return Unreadable(place, self.size, "the file ends within a record"), self.size
        opcode, length = RECORD_HEAD.unpack(head)
        end = place + RECORD_HEAD.size + length
        chunk = self._chunk(place, length)
        if chunk is not None:
            return chunk
        # A checksum of fields says nothing of the length; one too large would take in what follows.
        sized = opcode == ATTACHMENT or (opcode == METADATA and self._agrees(place))
        if sized and length <= LARGEST_RECORD and end <= self.size:
            try:
                return Intact(_verified(opcode, self._read(place + RECORD_HEAD.size, length)), length), end
            except Damage as damage:
                return (Unreadable(place, end, str(damage)), end) if self._agrees(end) else (None, None)
        if opcode in (HEADER, MESSAGE_INDEX) and self._agrees(place) and end <= self.size:
            return None, end
        if end > self.size and opcode in (CHUNK, METADATA, ATTACHMENT, MESSAGE_INDEX) and self._agrees(place):
            return Unreadable(place, self.size, "the file ends within a record"), self.size
        return None, None

    def _chunk(self, place: int, length: int) -> tuple[Intact | Unreadable, int] | None:
        """Try to have a chunk at a place; its length stands there twice, and either may be damaged."""
        begin = place + RECORD_HEAD.size
        head = self._read(begin, CHUNK_HEAD.size + 12)
        if len(head) < CHUNK_HEAD.size + 8:
            return None
        name_length = CHUNK_HEAD.unpack_from(head)[4]
        fixed = CHUNK_HEAD.size + name_length + 8
        if len(head) < fixed:
            return None
        (packed,) = struct.unpack_from("<Q", head, fixed - 8)
        reason = ""
        for content_length in sorted({length, fixed + packed}, key=lambda it: it != length):
            if not fixed <= content_length <= LARGEST_CHUNK + fixed or begin + content_length > self.size:
                continue
            content = bytearray(self._read(begin, content_length))
            if len(content) == content_length:
                struct.pack_into("<Q", content, fixed - 8, content_length - fixed)
            try:
                records = unpack_chunk(memoryview(content), checksum_needed=True)
                return Intact(records, content_length), begin + content_length
            except Damage as damage:
                reason = f"a chunk: {damage}"
        if length == fixed + packed and begin + length <= self.size and self._agrees(begin + length):
            return Unreadable(place, begin + length, reason or "a chunk that is too large"), begin + length
        return None

    def _agrees(self, place: int) -> bool:
        """Say whether what begins at a place agrees with itself as a record begins, or is the end."""
        if place == self.size:
            return True
        head = self._read(place, 64)
        if len(head) < RECORD_HEAD.size:
            return False
        opcode, length = RECORD_HEAD.unpack_from(head)
        content = head[RECORD_HEAD.size :]
        try:
            if opcode == CHUNK:
                name_length = CHUNK_HEAD.unpack_from(content)[4]
                name = bytes(content[CHUNK_HEAD.size :][:name_length])
                (packed,) = struct.unpack_from("<Q", content, CHUNK_HEAD.size + name_length)
                return name in _COMPRESSIONS and bool(length == CHUNK_HEAD.size + name_length + 8 + packed)
            if opcode == MESSAGE_INDEX:
                entries = struct.unpack_from("<HI", content)[1]
                return bool(length == 6 + entries and entries % 16 == 0)
            if opcode == DATA_END:
                return bool(length == 4)
            if opcode in (METADATA, HEADER):
                first = struct.unpack_from("<I", content)[0]
                second = struct.unpack("<I", self._read(place + RECORD_HEAD.size + 4 + first, 4))[0]
                return bool(length == 8 + first + second)
            if opcode == ATTACHMENT and length <= LARGEST_RECORD:
                _verified(opcode, self._read(place + RECORD_HEAD.size, length))
                return True
        except (struct.error, Damage):
            return False
        return False

    def _next_record(self, place: int) -> int:
        """Find the next place from which a record can be had; the end of the file if there is none."""
        while place < self.size:
            window = self._read(place, _WINDOW)
            for match in _BEGIN.finditer(window):
                if self._agrees(place + match.start()):
                    return place + match.start()
            place += _WINDOW - RECORD_HEAD.size
        return self.size


def _verified(opcode: int, content: memoryview) -> Any:
    """Parse a metadata record or an attachment; raise `Damage` unless its checksum is there and right."""
    record = parse(opcode, content)
    if opcode == METADATA and not is_intact(record.metadata):
        raise Damage("a metadata record without a right checksum")
    if (
        opcode == ATTACHMENT
        and zlib.crc32(content[:-4]) != struct.unpack_from("<I", content, len(content) - 4)[0]
    ):
        raise Damage("an attachment without a right checksum")
    return record
