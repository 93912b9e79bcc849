"""Check of every record of an MCAP file (https://mcap.dev/spec): its checksum, and its agreement with other records.

MCAP has checksums for chunks, attachments and the summary. Records without a checksum are compared with the data that
they repeat: message indexes and the times of a chunk with the messages of the chunk, the summary with the file. Two
kinds of damage have no effect and are not detected: a changed program name in the header, and packed bytes that unpack
to the same records. A checksum of the data section covers both and is verified if it exists.
"""

import struct
import zlib
from array import array
from collections import Counter
from typing import Any

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from daq.core.mcap_file.chunk import (
    CHUNK_HEAD,
    LARGEST_CHUNK,
    MAGIC,
    RECORD_HEAD,
    Damage,
    parse_message,
    record_at,
    records_in,
    unpack_chunk,
)
from daq.core.mcap_file.reader import Container
from daq.core.mcap_file.summary import parse_record

# Opcodes from this number on are reserved for applications; readers ignore such records.
_FIRST_PRIVATE_OPCODE = 0x80
_ENTRY = np.dtype([("log_time", "<u8"), ("position", "<u8")])
# The checksum of the data section is computed in pieces of this size.
_PIECE_BYTES = 1 << 20


def check_file(container: Container) -> None:
    """Read a whole file and check every record; raise `RecordingError` at the first damage or contradiction."""
    check = _Check(container)
    try:
        check.run()
    except Damage as damage:
        raise container.error(f"is damaged at byte {check.position}: {damage}") from damage


def _fingerprint(record: Any) -> int:
    """Return a hash of the fields of an index record."""
    fields = vars(record).values()
    return hash(tuple(frozenset(each.items()) if isinstance(each, dict) else each for each in fields))


class _Check:
    """The check of one file."""

    def __init__(self, container: Container) -> None:
        self.position = 0  # position of the first byte of the current record
        self._file = container
        # Files of shotrig have a checksum for every record and a complete summary; those of other programs may not.
        self._is_own_file = container.checksums_needed
        self._descriptions: dict[int, dict[int, Any]] = {Opcode.SCHEMA: {}, Opcode.CHANNEL: {}}
        # Records that the summary must list: opcode of the index -> position of the record -> hash of its index. A hash
        # saves memory: the index fields of a million empty chunks would take a gigabyte.
        self._unlisted: dict[int, dict[int, int]] = {
            Opcode.CHUNK_INDEX: {}, Opcode.ATTACHMENT_INDEX: {}, Opcode.METADATA_INDEX: {}
        }  # fmt: skip
        self._listed: Counter[int] = Counter()
        self._counts: Counter[int] = Counter()
        self._times: tuple[int, int] | None = None
        # Expected index of the latest chunk in the summary, and expected entries of its message indexes by channel.
        self._chunk: records.ChunkIndex | None = None
        self._messages: dict[int, NDArray[Any]] = {}

    def run(self) -> None:
        """Check the data section and the summary."""
        self.position = len(MAGIC)
        opcode, content = self._read_record()
        if opcode != Opcode.HEADER:
            raise Damage("the file does not begin with a header")
        self._check_record(parse_record(Opcode.HEADER, content), content)
        while opcode != Opcode.DATA_END:
            begin = self.position
            opcode, content = self._read_record(advance=False)
            if opcode != Opcode.MESSAGE_INDEX:
                self._end_chunk()
            self._data_record(opcode, content)
            self.position = begin + RECORD_HEAD.size + len(content)
        expected = parse_record(Opcode.DATA_END, content).data_section_crc
        crc = 0
        for start in range(0, begin if expected else 0, _PIECE_BYTES):
            crc = zlib.crc32(self._file.read(start, min(_PIECE_BYTES, begin - start)), crc)
        if crc != expected:
            raise Damage("the checksum of the data section is wrong")
        self._summary()

    def _read_record(self, advance: bool = True) -> tuple[int, memoryview]:
        """Return opcode and content of the record at `position`; by default, advance to the next record."""
        opcode, content = record_at(self._file.read, self.position, self._file.size, LARGEST_CHUNK + (1 << 16))
        if advance:
            self.position += RECORD_HEAD.size + len(content)
        return opcode, content

    # -- the data section --------------------------------------------------------------------------------

    def _data_record(self, opcode: int, content: memoryview) -> None:
        length = RECORD_HEAD.size + len(content)
        if opcode == Opcode.CHUNK:
            self._begin_chunk(content)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._message_index(content)
        elif opcode == Opcode.ATTACHMENT:
            record = parse_record(opcode, content, self._is_own_file)
            index = records.AttachmentIndex(
                self.position,
                length,
                record.log_time,
                record.create_time,
                len(record.data),
                record.name,
                record.media_type,
            )
            self._unlisted[Opcode.ATTACHMENT_INDEX][self.position] = _fingerprint(index)
        elif opcode == Opcode.METADATA:
            record = parse_record(opcode, content, self._is_own_file)
            self._check_record(record, content)
            self._unlisted[Opcode.METADATA_INDEX][self.position] = _fingerprint(
                records.MetadataIndex(self.position, length, record.name)
            )
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and not self._is_own_file:
            self._add_description(opcode, content)
        elif opcode == Opcode.MESSAGE and not self._is_own_file:
            message = parse_message(content)
            self._counts[message.channel] += 1
            self._extend_times(message.log_time, message.log_time)
        elif opcode != Opcode.DATA_END and (opcode < _FIRST_PRIVATE_OPCODE or self._is_own_file):
            raise Damage(f"a record with opcode {opcode} does not belong at this position")

    def _check_record(self, record: Any, content: memoryview) -> None:
        """Reject a record that shotrig's writer would encode differently: no checksum covers the length fields."""
        builder = RecordBuilder()
        record.write(builder)
        if self._is_own_file and builder.end()[RECORD_HEAD.size :] != content:
            raise Damage(f"a {type(record).__name__} record is malformed")

    def _add_description(self, opcode: int, content: memoryview) -> None:
        """Store a schema or channel; records with the same number must be equal."""
        record = parse_record(opcode, content)
        if self._descriptions[opcode].setdefault(record.id, record) != record:
            raise Damage(f"two different schemas or channels have the number {record.id}")

    def _begin_chunk(self, content: memoryview) -> None:
        unpacked = unpack_chunk(content, self._is_own_file)
        start, end, size, _, name_length = CHUNK_HEAD.unpack_from(content)
        name = bytes(content[CHUNK_HEAD.size : CHUNK_HEAD.size + name_length]).decode()
        entries: dict[int, array[int]] = {}
        position = 0
        for opcode, inside in records_in(unpacked, len(content)):
            if opcode == Opcode.MESSAGE:
                message = parse_message(inside)
                entries.setdefault(message.channel, array("Q")).extend((message.log_time, position))
            else:
                self._add_description(opcode, inside)
            position += RECORD_HEAD.size + len(inside)
        self._messages = {channel: np.frombuffer(pairs, _ENTRY) for channel, pairs in entries.items()}
        self._counts.update({channel: messages.size for channel, messages in self._messages.items()})
        times = [messages["log_time"] for messages in self._messages.values()]
        stamps = [int(stamp) for each in times for stamp in (each.min(), each.max())]
        if (start, end) != ((min(stamps), max(stamps)) if stamps else (0, 0)):
            raise Damage("the times that the chunk states differ from the times of its messages")
        if stamps:
            self._extend_times(start, end)
        packed = len(content) - CHUNK_HEAD.size - name_length - 8
        self._chunk = records.ChunkIndex(
            chunk_length=RECORD_HEAD.size + len(content),
            chunk_start_offset=self.position,
            compression=name,
            compressed_size=packed,
            message_end_time=end,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=start,
            uncompressed_size=size,
        )

    def _extend_times(self, start: int, end: int) -> None:
        first, last = self._times or (start, end)
        self._times = min(first, start), max(last, end)

    def _message_index(self, content: memoryview) -> None:
        """Compare a message index with the messages of the preceding chunk."""
        chunk = self._chunk
        if chunk is None or len(content) < 6:
            raise Damage("a message index does not follow a chunk")
        channel, size = struct.unpack_from("<HI", content)
        if size != len(content) - 6 or size % _ENTRY.itemsize or channel in chunk.message_index_offsets:
            raise Damage("a message index is malformed")
        listed = np.frombuffer(content, _ENTRY, offset=6)
        entries = self._messages.get(channel, np.empty(0, _ENTRY))
        if not np.array_equal(np.sort(listed, order="position"), entries):
            raise Damage(f"the message index of channel {channel} does not agree with the preceding chunk")
        chunk.message_index_offsets[channel] = self.position
        chunk.message_index_length += RECORD_HEAD.size + len(content)

    def _end_chunk(self) -> None:
        """Complete the check of the latest chunk after its message indexes."""
        chunk, self._chunk = self._chunk, None
        if chunk is None:
            return
        indexed = chunk.message_index_offsets
        missing = self._messages.keys() - indexed.keys()
        if missing and (self._is_own_file or indexed):
            raise Damage(f"the preceding chunk has no message index of channel {min(missing)}")
        self._unlisted[Opcode.CHUNK_INDEX][chunk.chunk_start_offset] = _fingerprint(chunk)

    # -- the summary -------------------------------------------------------------------------------------

    def _summary(self) -> None:
        """Compare the summary, whose checksum was verified when the file was opened, with the data section."""
        written = {kind: len(positions) for kind, positions in self._unlisted.items()}
        groups: dict[int, tuple[int, int]] = {}
        begin, offsets = self.position, 0
        while True:
            position = self.position
            opcode, content = self._read_record()
            if opcode == Opcode.FOOTER:
                footer = parse_record(Opcode.FOOTER, content)
                break
            if opcode == Opcode.SUMMARY_OFFSET:
                offsets = offsets or position
                offset = parse_record(opcode, content)
                stated = offset.group_start, offset.group_length
                if groups.get(offset.group_opcode, (offset.group_start, 0)) != stated:
                    raise Damage("a summary offset does not agree with the summary")
                continue
            first, _ = groups.get(opcode, (position, 0))
            groups[opcode] = first, self.position - first
            if opcode < _FIRST_PRIVATE_OPCODE:
                self._summary_record(opcode, parse_record(opcode, content), written)
        if self.position != self._file.size - len(MAGIC) or footer.summary_start not in (0, begin):
            raise Damage("the footer is not at the end of the file, or states a wrong position of the summary")
        if footer.summary_offset_start not in (0, offsets or self.position):
            raise Damage("the footer states a wrong position of the summary offsets")
        for kind, unlisted in self._unlisted.items():
            # Files of other programs may lack a kind of index.
            if unlisted and (self._is_own_file or self._listed[kind]):
                raise Damage(f"the summary does not list the record at byte {min(unlisted)}")

    def _summary_record(self, opcode: int, record: Any, written: dict[int, int]) -> None:
        """Compare a record of the summary with the record that it repeats."""
        if opcode in self._unlisted:
            position = record.chunk_start_offset if opcode == Opcode.CHUNK_INDEX else record.offset
            self._listed[opcode] += 1
            if self._unlisted[opcode].pop(position, None) != _fingerprint(record):
                raise Damage(f"an index of the summary does not agree with the record at byte {position}")
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            if self._descriptions[opcode].get(record.id, record) != record:
                raise Damage(f"the summary describes the schema or channel {record.id} differently from the data")
        elif opcode == Opcode.STATISTICS:
            self._statistics(record, written)

    def _statistics(self, statistics: Any, written: dict[int, int]) -> None:
        stated = {number: count for number, count in statistics.channel_message_counts.items() if count}
        counts = statistics.chunk_count, statistics.attachment_count, statistics.metadata_count
        if (
            (stated and stated != self._counts)
            or statistics.message_count != self._counts.total()
            or counts != tuple(written.values())
            or (statistics.message_start_time, statistics.message_end_time) != (self._times or (0, 0))
        ):
            raise Damage("the statistics of the summary do not agree with the file")
