"""The intact parts of an MCAP file that is truncated or damaged, read record by record, without its summary.

Only records with a checksum are used: chunks, attachments, and the metadata records of shotrig's recordings. If the
length of a record is damaged, the file is searched for the next consistent record.

The computing time is linear in the size of the file. If another record follows a record with a wrong checksum, the
search continues at the following record. If none follows, the search continues inside the damaged record; the total
size of such records is limited.
"""

import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from daq.core.mcap_file.chunk import CHUNK_HEAD, LARGEST_CHUNK, MAGIC, RECORD_HEAD, Damage, unpack_chunk
from daq.core.mcap_file.reader import LARGEST_RECORD, open_file
from daq.core.mcap_file.summary import parse_record

# The file is searched in blocks of this size.
_SEARCH_BYTES = 1 << 20
# A record begins with its opcode and a length of eight bytes, the last four of which are zero.
_BEGIN = re.compile(rb"(?=[\x06\x07\x09\x0c\x0f].{4}\0{4})", re.DOTALL)
_COMPRESSIONS = (b"", b"zstd", b"lz4")
_MAX_NAME_BYTES = max(map(len, _COMPRESSIONS))
# Field of a chunk with the size of its packed records; it follows the name of the compression.
_PACKED_SIZE = struct.Struct("<Q")
# Message index: channel and size of the entries.
_INDEX_HEAD = struct.Struct("<HI")
# Entry of a message index: log time and position.
_ENTRY_BYTES = 16
# Size of a text or a map; this field precedes the content.
_TEXT_SIZE = struct.Struct("<I")
# Length of the record at the end of the data section: a checksum.
_DATA_END_BYTES = 4
# Number of bytes that are read to check the beginning of a record: its header and the first fields.
_CHECKED_BYTES = 64
# First fields of an attachment: two times, and the size of its name.
_ATTACHMENT_HEAD = struct.Struct("<QQI")
# Field before the data of an attachment: their size.
_DATA_SIZE = struct.Struct("<Q")
_CHECKSUM_BYTES = 4
# Maximum total size of the records whose checksum is computed although no valid record follows [bytes], in addition to
# `_MAX_UNCONFIRMED_RATIO` of the file. It limits the time of a search.
_MAX_UNCONFIRMED_BYTES = 1 << 26
# Multiple of the size of the file in the same maximum.
_MAX_UNCONFIRMED_RATIO = 8


@dataclass(frozen=True)
class Intact:
    """Content of the file with a right checksum: the records of a chunk, a metadata record, or an attachment."""

    content: memoryview | Metadata | Attachment
    stored_bytes: int  # size in the file


@dataclass(frozen=True)
class Unreadable:
    """Bytes of the file that cannot be read."""

    begin: int  # first byte
    end: int  # byte after the last
    reason: str


class DamagedFile:
    """An MCAP file whose records are read one by one; raises `RecordingError` if the file cannot be opened."""

    def __init__(self, path: Path) -> None:
        self._file = open_file(path)
        self.size = os.fstat(self._file.fileno()).st_size
        self._unconfirmed_bytes_left = _MAX_UNCONFIRMED_BYTES + _MAX_UNCONFIRMED_RATIO * self.size

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _read(self, position: int, length: int) -> memoryview:
        """Return bytes of the file; no bytes if the disk cannot read them."""
        try:
            self._file.seek(position)
            return memoryview(self._file.read(max(0, min(length, self.size - position))))
        except OSError:
            return memoryview(b"")

    def parts(self) -> Iterator[Intact | Unreadable]:
        """Yield intact and unreadable parts of the data section in order, up to its end or the end of the file."""
        position = len(MAGIC)
        if self._read(0, position) != MAGIC:
            position = self._next_record(0)
            yield Unreadable(0, position, "the file does not begin with the MCAP signature")
        while position < self.size:
            if self._read(position, RECORD_HEAD.size) == RECORD_HEAD.pack(Opcode.DATA_END, _DATA_END_BYTES):
                return
            part, end = self._part(position)
            if end is None:
                end = self._next_record(position + 1)
                part = Unreadable(position, end, "no record can be identified")
            if part is not None:
                yield part
            position = end

    def _part(self, position: int) -> tuple[Intact | Unreadable | None, int | None]:
        """Return the part at a position (None: header or message index) and its end (None: no record identified)."""
        head = self._read(position, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return Unreadable(position, self.size, "the file ends within a record"), self.size
        opcode, length = RECORD_HEAD.unpack(head)
        end = position + RECORD_HEAD.size + length
        chunk = self._chunk(position, length)
        if chunk is not None:
            return chunk
        # The checksum of a metadata record does not cover the length, which is therefore compared with the fields.
        has_valid_length = opcode == Opcode.ATTACHMENT or (opcode == Opcode.METADATA and self._is_consistent(position))
        if has_valid_length and length <= LARGEST_RECORD and end <= self.size:
            is_confirmed = self._is_consistent(end)
            try:
                if is_confirmed or self._spend_unconfirmed(length):
                    record = parse_record(opcode, self._read(position + RECORD_HEAD.size, length), True)
                    return Intact(record, length), end
            except Damage as damage:
                return (Unreadable(position, end, str(damage)), end) if is_confirmed else (None, None)
        if opcode in (Opcode.HEADER, Opcode.MESSAGE_INDEX) and self._is_consistent(position) and end <= self.size:
            return None, end
        if (
            end > self.size
            and opcode in (Opcode.CHUNK, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX)
            and self._is_consistent(position)
        ):
            return Unreadable(position, self.size, "the file ends within a record"), self.size
        return None, None

    def _spend_unconfirmed(self, length: int) -> bool:
        """Count a record that no valid record follows; return whether the total is still within the limit."""
        self._unconfirmed_bytes_left -= length
        return self._unconfirmed_bytes_left >= 0

    def _chunk(self, position: int, length: int) -> tuple[Intact | Unreadable, int] | None:
        """Return the chunk at a position and its end; None if there is no chunk."""
        # The chunk states its length twice, in the record's head and as packed size; both values are tried.
        begin = position + RECORD_HEAD.size
        head = self._read(begin, CHUNK_HEAD.size + _MAX_NAME_BYTES + _PACKED_SIZE.size)
        if len(head) < CHUNK_HEAD.size + _PACKED_SIZE.size:
            return None
        name_length = CHUNK_HEAD.unpack_from(head)[4]
        fields_size = CHUNK_HEAD.size + name_length + _PACKED_SIZE.size
        if len(head) < fields_size:
            return None
        (packed,) = _PACKED_SIZE.unpack_from(head, fields_size - _PACKED_SIZE.size)
        reason = ""
        is_confirmed = (
            length == fields_size + packed and begin + length <= self.size and self._is_consistent(begin + length)
        )
        for content_length in sorted({length, fields_size + packed}, key=lambda candidate: candidate != length):
            is_possible = fields_size <= content_length <= LARGEST_CHUNK + fields_size
            if not is_possible or begin + content_length > self.size:
                continue
            if not (is_confirmed or self._spend_unconfirmed(content_length)):
                continue
            content = bytearray(self._read(begin, content_length))
            if len(content) == content_length:
                _PACKED_SIZE.pack_into(content, fields_size - _PACKED_SIZE.size, content_length - fields_size)
            try:
                records = unpack_chunk(memoryview(content), checksum_needed=True)
                return Intact(records, content_length), begin + content_length
            except Damage as damage:
                reason = str(damage)
        if is_confirmed:
            return Unreadable(position, begin + length, reason or "the chunk is too large"), begin + length
        return None

    def _is_consistent(self, position: int) -> bool:
        """Return whether a consistent record begins at a position, or the file ends there."""
        if position == self.size:
            return True
        head = self._read(position, _CHECKED_BYTES)
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
                (first_size,) = _TEXT_SIZE.unpack_from(content)
                second_position = position + RECORD_HEAD.size + _TEXT_SIZE.size + first_size
                (second_size,) = _TEXT_SIZE.unpack(self._read(second_position, _TEXT_SIZE.size))
                return bool(length == 2 * _TEXT_SIZE.size + first_size + second_size)
            if opcode == Opcode.ATTACHMENT:
                return self._is_attachment(position + RECORD_HEAD.size, length)
        except struct.error:
            return False
        return False

    def _is_attachment(self, begin: int, length: int) -> bool:
        """Return whether the sizes of name, media type and data of an attachment agree with its length."""
        *_, name_size = _ATTACHMENT_HEAD.unpack(self._read(begin, _ATTACHMENT_HEAD.size))
        type_begin = begin + _ATTACHMENT_HEAD.size + name_size
        (type_size,) = _TEXT_SIZE.unpack(self._read(type_begin, _TEXT_SIZE.size))
        data_begin = type_begin + _TEXT_SIZE.size + type_size
        (data_size,) = _DATA_SIZE.unpack(self._read(data_begin, _DATA_SIZE.size))
        return bool(begin + length == data_begin + _DATA_SIZE.size + data_size + _CHECKSUM_BYTES)

    def _next_record(self, position: int) -> int:
        """Return the position of the next consistent record; the end of the file if there is none."""
        while position < self.size:
            block = self._read(position, _SEARCH_BYTES)
            for match in _BEGIN.finditer(block):
                if self._is_consistent(position + match.start()):
                    return position + match.start()
            position += _SEARCH_BYTES - RECORD_HEAD.size
        return self.size
