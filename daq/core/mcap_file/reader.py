"""Reader of an MCAP file that was closed properly; the summary at its end gives the positions of all records.

Chunks, metadata and attachments are read on request. Every length is limited, every checksum verified.
"""

import os
import shlex
import struct
import weakref
import zlib
from io import FileIO
from pathlib import Path
from typing import Self

from mcap.opcode import Opcode

from daq.core.mcap_file.chunk import LARGEST_CHUNK, MAGIC, RECORD_HEAD, Damage, StoredMessage, messages_in, unpack_chunk
from daq.core.mcap_file.summary import Summary, parse_record, read_summary
from rig.core.base.errors import RecordingError

# Largest accepted size [bytes] of a record outside the chunks; a damaged length must not exhaust the memory.
LARGEST_RECORD = 1 << 24
# Largest accepted size [bytes] of a summary; a damaged length must not exhaust the memory.
LARGEST_SUMMARY = 1 << 28

FOOTER_RECORD = struct.Struct("<BQQQI")


def open_file(path: Path) -> FileIO:
    """Open a file for reading without a buffer; raise `RecordingError` if this is not possible."""
    if path.exists() and not path.is_file():
        raise RecordingError(f"{path}: not a file. Give the path of a recording.")
    try:
        return path.open("rb", buffering=0)
    except OSError as error:
        raise RecordingError(f"{path} cannot be opened ({error.strerror}). Check the path.") from error


class Container:
    """An MCAP file that was closed properly, open for reading; raises `RecordingError` for any other file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # Whether a record without a checksum counts as damaged; shotrig's writer adds a checksum to every record.
        self.checksums_needed = False
        self._file = open_file(path)
        # Close the file when there is no reference to this object.
        weakref.finalize(self, self._file.close)
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            self.summary = self._summary()
        except Damage as damage:
            self.close()
            raise self.error(f"is damaged: {damage}") from damage
        except BaseException:
            self.close()
            raise

    def need_checksums(self) -> None:
        """Treat records without a checksum as damaged; raise `RecordingError` if the summary has none."""
        self.checksums_needed = True
        if not self._summary_has_checksum:
            raise self.error("is damaged: its summary has no checksum")

    def error(self, problem: str) -> RecordingError:
        """Return an error that names the problem and the remedy for a damaged file."""
        return RecordingError(
            f"{self.path}: the file {problem}. Run `daq recover {self.path} -o FIXED.mcap` to recover the intact part."
        )

    def _summary(self) -> Summary:
        tail = FOOTER_RECORD.size + len(MAGIC)
        if self.size == 0:
            raise RecordingError(f"{self.path}: the file is empty. Remove it, and record again.")
        if self.read(0, len(MAGIC)) != MAGIC:
            remedy = "Give the path of a recording; `daq import` makes one from a file of another program."
            if self.path.suffix.lower() in (".yaml", ".yml"):
                remedy = f"A scene must be recorded first: `daq record {shlex.quote(str(self.path))}`."
            raise RecordingError(f"{self.path}: not an MCAP file (no MCAP signature). {remedy}")
        data = self.read(max(self.size - tail, 0), tail)
        if len(data) < tail or not data.endswith(MAGIC) or data[0] != Opcode.FOOTER:
            raise self.error("was not closed properly (it has no end; the recording may have been interrupted)")
        _, length, start, _, checksum = FOOTER_RECORD.unpack_from(data)
        if length != FOOTER_RECORD.size - RECORD_HEAD.size:
            raise Damage("its footer is malformed")
        if start == 0:
            raise self.error("has no summary")
        if not len(MAGIC) <= start <= self.size - tail:
            raise Damage("its footer points outside the file")
        if self.size - tail - start > LARGEST_SUMMARY:
            raise Damage(f"its summary has {self.size - tail - start} bytes; at most {LARGEST_SUMMARY} are read")
        section = self.read(start, self.size - tail - start)
        self._summary_has_checksum = checksum != 0
        if checksum and checksum != zlib.crc32(data[: FOOTER_RECORD.size - 4], zlib.crc32(section)):
            raise Damage("the checksum of its summary is wrong")
        return read_summary(memoryview(section), self.size)

    def read(self, offset: int, length: int) -> bytes:
        """Return bytes of the file; at the end of the file, fewer than requested."""
        if self._file.closed:
            raise RecordingError(f"{self.path}: the recording is closed. Open it again.")
        try:
            self._file.seek(offset)
            return self._file.read(length)
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be read ({error.strerror}). Check the disk.") from error

    def _record(self, opcode: int, offset: int, length: int, largest: int) -> memoryview:
        """Return the content of a record, given its position and length from the index."""
        if length > largest:
            raise Damage(f"a record at byte {offset} states a length of {length} bytes; at most {largest} are accepted")
        if offset > self.size - length:
            raise Damage(f"a record of {length} bytes at byte {offset} lies beyond the end of the file")
        data = memoryview(self.read(offset, length))
        if len(data) != length or length < RECORD_HEAD.size:
            raise Damage(f"the record at byte {offset} is truncated")
        if RECORD_HEAD.unpack_from(data) != (opcode, length - RECORD_HEAD.size):
            raise Damage(f"the record at byte {offset} does not agree with the summary")
        return data[RECORD_HEAD.size :]

    def records(self, number: int) -> memoryview:
        """Return the records of a chunk, given its number in the summary; raise `RecordingError` if it is damaged."""
        offset, length = int(self.summary.offsets[number]), int(self.summary.lengths[number])
        try:
            record = self._record(Opcode.CHUNK, offset, length, LARGEST_CHUNK + (1 << 16))
            return unpack_chunk(record, self.checksums_needed)
        except Damage as damage:
            raise self._chunk_error(number, damage) from damage

    def messages(self, number: int, records: memoryview | None = None) -> list[StoredMessage]:
        """Return the messages of a chunk by its number (`records`: if read already); `RecordingError` if damaged."""
        try:
            return messages_in(self.records(number) if records is None else records, int(self.summary.lengths[number]))
        except Damage as damage:
            raise self._chunk_error(number, damage) from damage

    def _chunk_error(self, number: int, damage: Damage) -> RecordingError:
        offset = int(self.summary.offsets[number])
        return self.error(f"is damaged at byte {offset}: {damage}")

    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the fields of metadata records by name; of records with equal names, the last."""
        try:
            metadata = {}
            for index in self.summary.metadata:
                content = self._record(Opcode.METADATA, index.offset, index.length, LARGEST_RECORD)
                record = parse_record(Opcode.METADATA, content, self.checksums_needed)
                metadata[record.name] = record.metadata
            return metadata
        except Damage as damage:
            raise self.error(f"is damaged: {damage}") from damage

    def attachment(self, name: str) -> bytes | None:
        """Return an attachment; None if there is none of that name."""
        for index in self.summary.attachments:
            if index.name == name:
                try:
                    content = self._record(Opcode.ATTACHMENT, index.offset, index.length, LARGEST_RECORD)
                    return bytes(parse_record(Opcode.ATTACHMENT, content, self.checksums_needed).data)
                except Damage as damage:
                    raise self.error(f"is damaged: {damage}") from damage
        return None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
