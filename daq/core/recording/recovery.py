"""Recovery of a complete recording from the intact parts of an incomplete or damaged file; lost samples are listed.

An incomplete recording lacks its end, for example because the process was killed. A part of a file is a chunk of
messages or a single record; it is intact if its checksum is right.
"""

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from daq.core.mcap_file.chunk import Damage, StoredMessage, messages_in, records_in
from daq.core.mcap_file.compression import zstd
from daq.core.mcap_file.damaged_file import DamagedFile, Intact, Unreadable
from daq.core.mcap_file.reader import Container
from daq.core.mcap_file.summary import parse_record, with_checksum
from daq.core.mcap_file.writer import ChunkedFile, Message
from daq.core.recording import layout
from daq.core.recording.committed_file import CommittedFile, DiskError, LostPathError, remove_unfinished
from daq.core.recording.layout import CLOCK_CHECKS, Timebase, stated_clock
from daq.core.recording.markers import Marker
from daq.core.recording.sample_block import SAMPLE_TYPE, check_block, decode
from daq.core.signal_chain.field_checks import MAX_SAMPLES, check
from rig.core.base.errors import RecordingError, add_path
from rig.core.base.escaping import escape_terminal
from rig.core.base.input_files import as_path
from rig.core.base.output_files import resolve_output
from rig.core.numerics.runs import merge_spans

# Indices of the first sample, and of the sample after the last.
SampleRange = tuple[int, int]

# Latest time that a message can have [ns].
_MAX_TIME_NS = 2**64 - 1
# Ending of the name of a recovered file until it replaces another file. It differs from `.part`, the ending of a
# recorder's file, which contains samples of its own.
_ENDING = ".recovering"
_DISK_REMEDY = "Free disk space, or choose a file on another disk with -o."


@dataclass(frozen=True)
class Recovery:
    """Result of `recover`."""

    source: Path  # the damaged file
    fixed: Path  # the complete file
    rate: float  # samples per second [Hz]
    kept: dict[str, int]  # number of samples kept, by topic
    lost: dict[str, list[SampleRange]]  # ranges of lost samples [first, stop), by topic; only topics with losses
    missing: dict[str, int]  # number of lost messages on topics without samples: markers, display, ...
    notes: list[str]  # other losses, and losses that cannot be determined

    @property
    def whole(self) -> bool:
        """Whether no loss is known."""
        return not (self.lost or self.missing or self.notes)

    def report(self) -> Iterator[str]:
        """Yield the lines that are printed for the user."""
        seconds = max(self.kept.values(), default=0) / self.rate
        yield f"{self.fixed}: {len(self.kept)} topics with samples, {seconds:.3f} s"
        if self.whole:
            yield "nothing was lost"
        topics_by_ranges: dict[tuple[SampleRange, ...], list[str]] = defaultdict(list)
        for topic, lost_ranges in self.lost.items():
            topics_by_ranges[tuple(lost_ranges)].append(topic)
        for ranges, topics in topics_by_ranges.items():
            for first, stop in ranges:
                range_s = f"{first / self.rate:.6g} s to {stop / self.rate:.6g} s"
                yield f"lost: {range_s} (samples {first} to {stop - 1}) of {', '.join(topics)}"
        for topic, count in self.missing.items():
            yield f"lost: {count} message{'s' if count > 1 else ''} of {topic}"
        yield from self.notes


def recover(path: str | Path, fixed: str | Path, overwrite: bool = False) -> Recovery:
    """Make a complete recording from an incomplete or damaged file.

    The new file contains only data whose checksum in the damaged file is right. Samples keep their numbers; lost
    samples read as NaN and are listed in `Recording.gaps`.

    Parameters
    ----------
    path : str or Path
        The damaged file; it is not changed.
    fixed : str or Path
        The file to create; it must differ from the damaged file.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    Recovery
        Kept and lost samples.

    Raises
    ------
    RecordingError
        If the file cannot be read, nothing in it can be recovered, or the new file cannot be created.
    DiskError
        If the disk has no room for the new file, or fails.
    """
    source, target = as_path(path), as_path(fixed, "fixed")
    if source.exists() and target.exists() and source.samefile(target):
        raise RecordingError(f"{source} cannot be recovered into itself. Give another name with -o.")
    with DamagedFile(source) as damaged:
        resolve_output(target, overwrite, RecordingError)
        # Two passes are needed: descriptions may follow the samples, but must be written before them.
        descriptions = _read_descriptions(source, damaged)
        remove_unfinished(resolve_output(target, overwrite, RecordingError), _ENDING)
        disk = CommittedFile(target, overwrite, _ENDING)
        with disk.removed_on_failure():
            if disk.free() < damaged.size:
                raise DiskError(
                    f"{target}: the recovered recording may take {damaged.size / 1e6:.1f} MB, and its disk has "
                    f"{disk.free() / 1e6:.1f} MB left. {_DISK_REMEDY}"
                )
            try:
                recovery = _Copy(source, target, disk, *descriptions).run(damaged)
            except LostPathError:
                raise
            except DiskError as error:
                raise DiskError(f"{error}; {source} is not changed. {_DISK_REMEDY}") from error
        disk.close()
    return recovery


def _read_descriptions(
    source: Path, damaged: DamagedFile
) -> tuple[dict[int, Schema], dict[int, Channel], dict[int, int] | None]:
    """Return schemas and channels by number, and message counts from the summary; None without an intact summary."""
    try:
        with Container(source) as container:
            summary = container.summary
            counts = dict(summary.statistics.channel_message_counts) if summary.statistics else None
            return summary.schemas, summary.channels, counts
    except RecordingError:
        records_by_id: dict[int, dict[int, Any]] = {Opcode.SCHEMA: {}, Opcode.CHANNEL: {}}
    for part in damaged.parts():
        if isinstance(part, Intact) and isinstance(part.content, memoryview):
            with suppress(Damage):
                for opcode, content in records_in(part.content, part.stored_bytes):
                    if opcode in records_by_id:
                        record = parse_record(opcode, content)
                        records_by_id[opcode][record.id] = record
            if records_by_id[Opcode.CHANNEL]:
                break
    return records_by_id[Opcode.SCHEMA], records_by_id[Opcode.CHANNEL], None


class _Copy:
    """A complete recording that is copied from the intact parts of a damaged file."""

    def __init__(
        self,
        source: Path,
        target: Path,
        disk: CommittedFile,
        schemas: dict[int, Schema],
        channels: dict[int, Channel],
        counts: dict[int, int] | None,
    ) -> None:
        self._source, self._target, self._disk = source, target, disk
        self._schemas, self._channels, self._counts = schemas, channels, counts
        self._file = ChunkedFile(disk, f"shotrig {version('shotrig')}")
        self._compressor = zstd()
        # The keys of the next four dictionaries are channel numbers of the damaged file.
        self._new_numbers: dict[int, int] = {}  # channel number in the new file
        self._sample_ranges: dict[int, list[SampleRange]] = {}  # ranges of copied samples
        self._n_messages: dict[int, int] = defaultdict(int)  # number of copied messages
        self._n_expected: dict[int, int] = defaultdict(int)  # number of messages, from their sequence numbers
        self._gaps: dict[str, list[SampleRange]] = defaultdict(list)  # marked gaps by channel; "" for all channels
        self._notes: list[str] = []
        self._n_without_topic = 0
        self._metadata: dict[str, dict[str, str]] = {}
        self._has_scene = False
        self._clock: Timebase | None = None
        schema_numbers: dict[int, int] = {0: 0}
        for number, schema in sorted(schemas.items()):
            schema_numbers[number] = self._file.add_schema(schema.name, schema.encoding, schema.data)
        for number, channel in sorted(channels.items()):
            if channel.schema_id not in schema_numbers:
                self._notes.append(f"{channel.topic} is omitted, because its schema is lost")
                continue
            self._new_numbers[number] = self._file.add_channel(
                channel.topic, channel.message_encoding, schema_numbers[channel.schema_id], channel.metadata
            )
            if channel.schema_id and schemas[channel.schema_id].name in SAMPLE_TYPE:
                self._sample_ranges[number] = []
                with suppress(RecordingError):
                    self._clock = self._clock or stated_clock(channel.metadata)

    def run(self, damaged: DamagedFile) -> Recovery:
        """Write the complete recording; return its content and the losses."""
        for part in damaged.parts():
            if isinstance(part, Unreadable):
                self._notes.append(f"bytes {part.begin} to {part.end - 1} of {self._source}: {part.reason}")
            elif isinstance(part.content, memoryview):
                self._copy_chunk(part.content, part.stored_bytes)
            else:
                self._copy_record(part.content)
            self._disk.commit()
        if not any(self._sample_ranges.values()) or self._clock is None:
            reason = f" ({self._notes[0]})" if self._notes else ""
            raise RecordingError(
                f"{self._source}: nothing can be recovered, no block of samples is intact{reason}. Record it again."
            )
        recovery = self._determine_losses(self._clock)
        self._finish(recovery)
        return recovery

    def _copy_chunk(self, records: memoryview, stored_bytes: int) -> None:
        try:
            messages = messages_in(records, stored_bytes)
        except Damage as damage:
            self._notes.append(f"a chunk with a correct checksum is omitted, because it is malformed: {damage}")
            return
        readable_messages = []
        for message in messages:
            if message.channel not in self._new_numbers:
                self._n_without_topic += 1
            elif self._is_readable(message):
                number, times = self._new_numbers[message.channel], (message.log_time, message.publish_time)
                readable_messages.append(Message(number, *times, bytes(message.data), message.sequence))
                self._n_messages[message.channel] += 1
                self._n_expected[message.channel] = max(self._n_expected[message.channel], message.sequence + 1)
        self._file.add_chunk(readable_messages, self._compressor)

    def _is_readable(self, message: StoredMessage) -> bool:
        """Register the content of a message; if it cannot be read, add a note and return False."""
        channel = self._channels[message.channel]
        try:
            with add_path(channel.topic):
                self._register(message, channel)
        except RecordingError as error:
            self._notes.append(str(error))
            return False
        return True

    def _register(self, message: StoredMessage, channel: Channel) -> None:
        """Register the samples or the gap that a message contains."""
        if message.channel in self._sample_ranges:
            block = decode(message.data, self._schemas[channel.schema_id].name)
            if self._clock is None:
                check({"rate": block.rate, "start_ns": block.clock.start_ns}, CLOCK_CHECKS)
                self._clock = block.clock
            check_block(block, message.log_time, self._clock)
            ranges, first = self._sample_ranges[message.channel], block.first_sample
            if ranges and first < ranges[-1][1]:
                # Samples may repeat if a damaged file system repeats parts of a file.
                raise RecordingError(
                    f"samples {first} to {block.stop - 1} are omitted, because later samples precede them"
                )
            if ranges and ranges[-1][1] == first:
                first = ranges.pop()[0]
            ranges.append((first, block.stop))
        elif channel.topic == layout.MARKERS:
            marker = Marker.from_json(message.data)
            if marker.kind in ("gap", "lost"):
                for name in marker.fields.get("channels", [""]):
                    self._gaps[name].append((marker.first_sample, marker.end + 1))

    def _copy_record(self, record: Metadata | Attachment) -> None:
        """Copy a metadata record or an attachment; the record `outcome` may change and is written by `_finish`."""
        if isinstance(record, Attachment):
            self._has_scene |= record.name == layout.SCENE_FILE
            times = record.create_time, record.log_time
            self._file.add_attachment(*times, record.name, record.media_type, record.data)
            return
        self._metadata[record.name] = record.metadata
        if record.name != "outcome":
            self._file.add_metadata(record.name, record.metadata)

    # -- losses ------------------------------------------------------------------------------------------

    def _determine_losses(self, clock: Timebase) -> Recovery:
        """Compare the copied samples and messages with the numbers that the file states; return the differences."""
        channels, outcome = self._channels, self._metadata.get("outcome", {})
        end = max(ranges[-1][1] for ranges in self._sample_ranges.values() if ranges)
        # Number of samples stated at the end of the file; None if the end is missing.
        stated_end = int(outcome["samples"]) if _is_plausible_count(outcome.get("samples", "")) else None
        if stated_end is None and self._counts is None:
            self._notes.append(f"the file has no end: any samples after {end / clock.rate:.6g} s are lost")
        end = max(end, stated_end or 0)
        lost, recovered = {}, {}
        for number, ranges in self._sample_ranges.items():
            topic = channels[number].topic
            recovered[topic] = sum(stop - first for first, stop in ranges)
            names = ("", topic.removeprefix(layout.RAW)) if topic.startswith(layout.RAW) else ()
            gaps = merge_spans(gap for name in names for gap in self._gaps.get(name, ()))
            missing = list(_subtract(_subtract([(0, end)], ranges), gaps))
            if missing:
                lost[topic] = missing
        missing_messages = {}
        for number in self._new_numbers:
            if number in self._sample_ranges:
                continue
            # The messages of a topic are numbered, and counted in the summary and the outcome.
            expected = max(self._n_expected[number], (self._counts or {}).get(number, 0))
            if channels[number].topic == layout.MARKERS and _is_plausible_count(outcome.get("markers", "")):
                expected = max(expected, int(outcome["markers"]))
            if expected > self._n_messages[number]:
                missing_messages[channels[number].topic] = expected - self._n_messages[number]
        if self._n_without_topic:
            self._notes.append(
                f"{self._n_without_topic} messages are omitted, because the description of their topics is lost"
            )
        if not self._has_scene:
            self._notes.append(f"the scene ({layout.SCENE_FILE}) is lost")
        return Recovery(self._source, self._target, clock.rate, recovered, lost, missing_messages, self._notes)

    def _finish(self, recovery: Recovery) -> None:
        """Mark the losses in the file, and end it."""
        marker_channels = [self._new_numbers[n] for n in self._new_numbers if self._channels[n].topic == layout.MARKERS]
        channels_by_range: dict[SampleRange, list[str]] = defaultdict(list)
        for topic, ranges in recovery.lost.items():
            for sample_range in ranges:
                channels_by_range[sample_range].append(topic.removeprefix(layout.RAW))
        assert self._clock is not None
        lost = []
        for (first, stop), names in sorted(channels_by_range.items()):
            fields = {"channels": names, "reason": "lost with the damaged file"}
            content = Marker("lost", first, stop - 1, fields).to_json()
            end_ns, start_ns = (min(self._clock.time_ns(sample), _MAX_TIME_NS) for sample in (stop - 1, first))
            lost += [Message(number, end_ns, start_ns, content, 0) for number in marker_channels]
        self._file.add_chunk(lost, self._compressor)
        outcome = self._metadata.get("outcome")
        if outcome is None or not recovery.whole:
            earlier = {} if outcome is None else {key: outcome.get(key, "") for key in ("status", "reason")}
            outcome = with_checksum(
                {f"before.{key}": text for key, text in earlier.items()}
                | {"status": "recovered", "reason": f"recovered from {escape_terminal(self._source.name)}"}
                | {"samples": str(max(ranges[-1][1] for ranges in self._sample_ranges.values() if ranges))}
                | {"report": json.dumps(list(recovery.report()))}
            )
        self._file.add_metadata("outcome", outcome)
        self._file.finish()
        self._disk.finish()


def _is_plausible_count(text: str) -> bool:
    """Return whether a text in the file is a whole number of at most `MAX_SAMPLES`."""
    return text.isascii() and text.isdecimal() and len(text) < 17 and int(text) <= MAX_SAMPLES


def _subtract(ranges: Iterable[SampleRange], excluded: Sequence[SampleRange]) -> Iterator[SampleRange]:
    """Yield the parts of `ranges` outside the ranges `excluded`; each list is ascending and without overlaps.

    >>> list(_subtract([(0, 30), (40, 100)], [(10, 20), (25, 45), (90, 100)]))
    [(0, 10), (20, 25), (45, 90)]
    """
    index = 0
    for first, stop in ranges:
        while index < len(excluded) and excluded[index][0] < stop:
            begin, end = excluded[index]
            if begin > first:
                yield first, begin
            first = max(first, end)
            if end > stop:
                break
            index += 1
        if first < stop:
            yield first, stop
