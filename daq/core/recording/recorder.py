"""Recorder: writes an MCAP file that is readable up to its last commit, even after a crash.

A commit writes a group of samples (about half a second), with its markers, to the disk.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import metadata
from itertools import chain
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from daq.core.mcap_file.compression import lz4, zstd, zstd_for_samples
from daq.core.mcap_file.protobuf import Schema
from daq.core.mcap_file.summary import with_checksum
from daq.core.mcap_file.writer import ChunkedFile, Message, Messages
from daq.core.recording import layout
from daq.core.recording.committed_file import RESERVE, CommittedFile, DiskError, LostPathError
from daq.core.recording.layout import Timebase
from daq.core.recording.markers import MARKER_SCHEMA, Marker
from daq.core.recording.recorded_test import SceneOutline, TestKind
from daq.core.recording.sample_block import SCHEMAS, block_schema, encode, stored_as
from daq.core.recording.sample_groups import Group, Grouping
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.base.ending_signals import delayed_interrupt
from rig.core.base.errors import RecordingError, RunError
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.simulation.motion import Motion

# Size of the index of a chunk at the end of the file [bytes].
_INDEX_BYTES_PER_CHUNK = 256
# The version is read once, because reading it takes longer than writing ten groups of samples.
_version = cache(metadata.version)


class Recorder:
    """Writes samples, markers (events of the test) and true (simulated) motion to a new recording.

    Samples are collected into blocks, and into groups of about half a second that are committed to the disk together.
    A killed process loses less than one group. Blocks and groups lie on a fixed grid of sample indices, so the
    file does not depend on how samples are split among calls of `write`. An exception within the context closes the
    file and is recorded in it.

    Parameters
    ----------
    path : str or Path
        File to create, in an existing folder.
    scene : Scene, str, Path or mapping
        Scene to store in the file, or an argument of `rig.load`; its `recording` specifies how samples are stored and
        what else is recorded.
    channels : sequence of ChannelInfo
        Description of each row of the samples.
    rate : float
        Samples per second [Hz].
    start_ns : int
        Time of sample 0, nanoseconds since an epoch of the user's choice; 0 keeps recordings reproducible.
    overwrite : bool
        Whether an existing file may be replaced.
    source : str
        Names of the files that the samples were imported from; empty for the virtual rig.
    test_kind : TestKind, optional
        Kind of the recorded test; if omitted, readers determine it from the markers.

    Raises
    ------
    RecordingError
        If there are no channels, or the file exists or cannot be created.
    DiskError
        If the disk is full or fails.
    """

    def __init__(
        self,
        path: str | Path,
        scene: SceneLike,
        channels: Sequence[ChannelInfo],
        rate: float,
        start_ns: int = 0,
        overwrite: bool = False,
        source: str = "",
        test_kind: TestKind | None = None,
    ) -> None:
        self.path = Path(path)
        self.channels, scene = tuple(channels), scene_of(scene)
        if not self.channels:
            raise RecordingError(f"{self.path}: no channels. Give a ChannelInfo for each row of the samples.")
        self.clock = Timebase(rate, start_ns)
        self.closed = False
        self._scene, self._source, self._test_kind = scene, source, test_kind
        self._block_samples, self._group_samples = layout.block_length(rate), layout.flush_length(rate)
        self._storage_type = stored_as(scene, self.channels)
        # Factor from a stored number to the unit of its channel.
        counts = self._storage_type == "counts"
        scales = [info.unit_per_count if counts else 1.0 / info.sensitivity for info in self.channels]
        self._scale = np.array(scales)[:, None]
        self._raw_groups = Grouping(len(self.channels), self._group_samples, SCHEMAS[self._storage_type][2])
        self._pending_markers = [Marker("start", 0)]
        self._marker_count = self._chunk_count = self._samples_written = 0
        self._disk_is_full = False
        self._schema_numbers: dict[str, int] = {}
        self._disk = CommittedFile(self.path, overwrite)
        with self._disk.removed_on_failure():
            self._write_beginning()

    @property
    def position(self) -> int:
        """Index of the next sample to be written."""
        return self._raw_groups.position

    @property
    def current_path(self) -> Path:
        """Path of the file now; it differs from `path` until the file replaces another."""
        return self._disk.current_path

    @property
    def size(self) -> int:
        """Length of the file so far [bytes]."""
        return self._disk.tell()

    @property
    def free(self) -> int:
        """Free space of the file's disk in bytes, without the space that is reserved for the end of the file."""
        return max(0, self._disk.free() - RESERVE - _INDEX_BYTES_PER_CHUNK * self._chunk_count)

    @property
    def accepts_samples(self) -> bool:
        """Whether samples can be written: the file is open and its disk is not full."""
        return not (self.closed or self._disk_is_full or self._disk.failed)

    def write(self, samples: Array | NDArray[np.int32]) -> None:
        """Write the next samples of all channels.

        A group is committed with its last sample. If the true motion is recorded, it must be written first.

        Parameters
        ----------
        samples : ndarray, (channels, any number)
            Converter counts (integers) or volts.

        Raises
        ------
        RunError
            If the true motion of the samples is missing, or volts are given where counts are stored.
        DiskError
            If the disk is full or fails; the file then contains all samples up to the previous commit.
        """
        self._require_open()
        if samples.ndim != 2 or samples.shape[0] != len(self.channels):
            raise ValueError(f"samples: got shape {samples.shape}; expected ({len(self.channels)}, n).")
        self._require_truth(samples.shape[1])
        are_counts = np.issubdtype(samples.dtype, np.integer)
        if self._storage_type == "counts" and not are_counts:
            raise RunError(
                "recording.samples: counts, but the samples are volts. Set converter.bits and converter.range."
            )
        if self._storage_type != "counts" and are_counts:
            samples = samples * np.array([[info.volts_per_count or 1.0] for info in self.channels])
        consumed = 0
        while consumed < samples.shape[1]:
            group_end = consumed + self._group_samples - self._raw_groups.position % self._group_samples
            part, consumed = samples[:, consumed:group_end], group_end
            self._raw_groups.add(part)
            if self._raw_groups.complete:
                self._write_groups(self._raw_groups.position // self._group_samples)

    def gap(self, lost_samples: int) -> None:
        """Skip samples that were not acquired: they read as NaN, and a marker `gap` reports them."""
        self._require_open()
        if lost_samples < 1:
            raise ValueError(f"lost_samples: got {lost_samples}; expected at least 1.")
        self._require_truth(lost_samples)
        first = self._raw_groups.position
        self._raw_groups.skip(lost_samples)
        self.mark("gap", first, first + lost_samples - 1)
        self._write_groups(self._raw_groups.position // self._group_samples)

    def mark(self, kind: str, first_sample: int, last_sample: int | None = None, **fields: Any) -> None:
        """Mark an event at a sample, or over a range of samples, both ends inclusive.

        `kind`: kind of the marker, such as `settle`, `measure` or `hit`; `fields`: further data in SI units. For a
        reproducible file, mark the event at the same `position` each time.
        """
        self._require_open()
        marker = Marker(kind, int(first_sample), None if last_sample is None else int(last_sample), fields)
        marker.to_json()
        self._pending_markers.append(marker)

    def write_truth(self, motion: Motion) -> None:
        """Write the next samples of the true motion, if the scene records it."""
        self._require_open()
        if self._truth is None:
            raise ValueError("recording.truth: not set. Set recording: {truth: true} in the scene.")
        self._truth.add(motion)

    def close(self, status: str = "complete", reason: str = "") -> None:
        """Write the remaining samples and end the file.

        Parameters
        ----------
        status : {'complete', 'interrupted', 'failed'}
            How the test ended; stored in the file's `outcome`.
        reason : str
            Reason for the end of the test, for the user.

        Raises
        ------
        DiskError
            If the disk is full or fails; `daq recover` can then complete the file.
        """
        if self.closed:
            return
        self.closed = True
        try:
            if not self._disk.failed:
                with delayed_interrupt():
                    self._write_end(status, reason)
        finally:
            self._disk.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, *__: object) -> None:
        if error is None:
            self.close()
            return
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        if status == "failed":
            self._disk.keep_old()
        try:
            self.close(status, str(error) or type(error).__name__)
        except RunError as another:
            if isinstance(error, DiskError):
                # The error of closing includes the first error, and adds the remedy for a file without an end.
                raise another from error
            error.add_note(str(another))

    def _require_open(self) -> None:
        if not self.accepts_samples:
            raise RunError(f"{self.path}: the recording has ended. Start another recording for more samples.")

    def _require_truth(self, samples: int) -> None:
        """Raise `RunError` unless the true motion of the next samples was written: it is committed with the samples."""
        if self._truth is not None and self._truth.position < self._raw_groups.position + samples:
            raise RunError("recording.truth: the true motion of these samples is missing. Call write_truth first.")

    # -- the beginning and the end of the file -----------------------------------------------------------

    def _write_beginning(self) -> None:
        """Write all descriptions before the first sample so that an incomplete file contains them."""
        self._file = ChunkedFile(self._disk, f"shotrig {_version('shotrig')}")
        self._zstd = zstd()
        self._samples_compressor = lz4() if self._storage_type == "float64" else zstd_for_samples()
        self._marker_topic = self._register(layout.MARKERS, MARKER_SCHEMA, {})
        common = {"stored": self._storage_type, "start_ns": str(self.clock.start_ns), "layout": layout.VERSION}
        schema = block_schema(SCHEMAS[self._storage_type][0])
        self._topics = [
            self._register(f"{layout.RAW}{info.name}", schema, info.to_metadata() | common | {"scale": repr(scale)})
            for info, scale in zip(self.channels, self._scale[:, 0].tolist(), strict=True)
        ]
        self._truth = self._display = None
        if self._scene.recording.truth:
            from daq.core.recording.truth import Truth

            self._truth = Truth(self._scene, self.clock, self._group_samples, self._register)
        if self._scene.recording.display:
            from daq.core.recording.display import Display

            self._display = Display(self._scene, self.channels, self._scale, self.clock, self._truth, self._register)
        self._write_markers(1)
        if self._display is not None:
            self._write_chunk([self._display.introduction()])
        self._describe()
        self._disk.commit()

    def _describe(self) -> None:
        """Write the metadata records and the scene."""
        scene, start = self._scene, str(self.clock.start_ns)
        converter = {f"converter.{key}": json.dumps(value) for key, value in scene.converter.model_dump().items()}
        sizes = {"block_samples": str(self._block_samples), "flush_samples": str(self._group_samples)}
        sizes |= {"stored": self._storage_type}
        records = {"daq": converter | sizes | {"rate_hz": repr(self.clock.rate), "start_ns": start}}
        for info in self.channels:
            data_sheet = {"name": info.name, "at": info.at, "quantity": info.quantity, "unit": info.unit}
            data_sheet |= {"direction": "up", "sensitivity_V_per_unit": repr(info.sensitivity)}
            records[f"sensor {info.name}"] = {f"sensor.{key}": text for key, text in info.sensor.items()} | data_sheet
        if self._display is not None:
            records["display"] = self._display.description()
        run = SceneOutline.of(scene).to_metadata() | {"seed": str(scene.seed), "layout": layout.VERSION}
        source_field = {"source": self._source} if self._source else {}
        kind_field = {"kind": str(self._test_kind)} if self._test_kind is not None else {}
        records["run"] = run | {"shotrig": _version("shotrig")} | source_field | kind_field
        for name, fields in records.items():
            self._file.add_metadata(name, with_checksum(fields))
        text = scene.to_si_yaml().encode()
        self._file.add_attachment(int(start), int(start), layout.SCENE_FILE, "application/yaml", text)

    def _register(self, topic: str, schema: Schema, metadata: Mapping[str, str]) -> int:
        """Add a topic to the file; return the number of its channel."""
        number = self._schema_numbers.get(schema.name)
        if number is None:
            number = self._file.add_schema(schema.name, schema.encoding, schema.data)
            self._schema_numbers[schema.name] = number
        return self._file.add_channel(topic, schema.message_encoding, number, metadata)

    def _write_end(self, status: str, reason: str) -> None:
        """Write the last samples, markers and metadata; remove the file if a failed test has no samples."""
        disk_error = None
        if not self._disk_is_full:
            try:
                for stream in self._streams:
                    stream.complete_group()
                self._write_groups(math.inf)
                self._samples_written = self._raw_groups.position
                if self._truth is not None:
                    self._write_chunk(self._truth.events_before(math.inf))
                if self._display is not None:
                    self._write_chunk(self._display.finish())
            except DiskError as error:
                if self._disk.failed:
                    raise
                # The reserved space (`RESERVE`) suffices to end the file.
                disk_error, status, reason = error, "failed", str(error)
                self._disk.keep_old()
        self._write_markers(math.inf)
        outcome = {"status": status, "reason": reason, "samples": str(self._samples_written)}
        self._file.add_metadata("outcome", with_checksum(outcome | {"markers": str(self._marker_count)}))
        self._file.finish()
        if self._samples_written == 0 and status != "complete":
            self._commit()
            self._disk.discard()
        else:
            with self._disk_errors_with_remedy():
                self._disk.finish()
        if disk_error is not None:
            raise disk_error

    # -- the groups of samples ---------------------------------------------------------------------------

    def _write_groups(self, stop: float) -> None:
        """Write the complete groups whose number is below `stop`, in order."""
        for number in sorted({number for stream in self._streams for number in stream.complete}):
            if number < stop:
                with delayed_interrupt():
                    self._write_group(number)

    def _write_group(self, number: int) -> None:
        """Write and commit a group: its markers, samples and true motion, and the display data that it completes."""
        raw = self._raw_groups.complete.pop(number, None)
        # The reserved space (`RESERVE`) suffices to end the file.
        if self.free < sum(stream.group_bytes for stream in self._streams):
            self._disk_is_full = True
            raise DiskError(
                f"{self._disk.current_path}: the disk is full; the file contains {self._content_text}."
                f"{self._unchanged_text} Free disk space or use another disk."
            )
        group_end = (number + 1) * self._group_samples
        self._write_markers(group_end)
        if raw is not None:
            # Each channel has its own chunk, so a reader of one channel need not decode the other channels.
            self._chunk_count += self._file.add_chunk_per_channel(
                self._blocks(raw, self._topics), self._samples_compressor
            )
        if self._truth is not None:
            streams = [[] if group is None else self._blocks(group, ()) for group in self._truth.take(number)]
            for chunk in self._truth.chunks:
                rows = (messages_of_row(streams[stream], row, topic) for stream, row, topic in chunk)
                self._chunk_count += self._file.add_chunk(chain.from_iterable(rows), lz4())
            self._write_chunk(self._truth.events_before(group_end))
        if self._display is not None:
            self._write_chunk(self._display.add(raw, group_end))
        self._commit()
        if raw is not None:
            self._samples_written = raw.spans[-1][1]

    @property
    def _streams(self) -> list[Grouping]:
        """The series of samples that are grouped: channels, and the true motion if it is recorded."""
        return [self._raw_groups, *(() if self._truth is None else self._truth.streams)]

    @property
    def _content_text(self) -> str:
        return f"the first {self._samples_written / self.clock.rate:.2f} s"

    @property
    def _unchanged_text(self) -> str:
        """Sentence about the file that this file would have replaced; empty if there is no such file."""
        return f" {self.path} is unchanged." if self._disk.replaces else ""

    def _commit(self) -> None:
        with self._disk_errors_with_remedy():
            self._disk.commit()

    @contextmanager
    def _disk_errors_with_remedy(self) -> Iterator[None]:
        """Add the content of the file, and the remedy, to the message of a `DiskError`."""
        try:
            yield
        except LostPathError:
            raise
        except DiskError as error:
            path = self._disk.current_path
            raise DiskError(
                f"{error}; the file contains {self._content_text}, without an end.{self._unchanged_text} Free disk "
                f"space, then run `daq recover {path} -o FIXED.mcap`."
            ) from error

    def _blocks(self, group: Group, topics: Sequence[int]) -> list[Messages]:
        """Encode the blocks of a group; each row of the group is a topic."""
        encoded = []
        for first, samples in group.blocks(self._block_samples):
            _, blocks, size = samples.shape
            starts = range(first, first + size * blocks, size)
            times = np.array([self.clock.time_ns(sample) for sample in (*starts, starts.stop)], np.uint64)
            sequence = np.array([start // self._block_samples % 2**32 for start in starts])
            encoded.append(Messages(topics, times[1:], times[:-1], encode(self.clock, first, samples), sequence))
        return encoded

    def _write_markers(self, stop: float) -> None:
        """Write the markers that end before a sample."""
        due = [marker for marker in self._pending_markers if marker.end < stop]
        if not due:
            return
        self._pending_markers = [marker for marker in self._pending_markers if marker.end >= stop]
        messages = []
        for marker in sorted(due, key=lambda marker: marker.first_sample):
            times = self.clock.time_ns(marker.end), self.clock.time_ns(marker.first_sample)
            messages.append(Message(self._marker_topic, *times, marker.to_json(), self._marker_count))
            self._marker_count += 1
        self._write_chunk(messages)

    def _write_chunk(self, messages: Iterable[Message | Messages]) -> None:
        """Write messages as a separate chunk so that readers of other topics need not decode it."""
        self._chunk_count += self._file.add_chunk(messages, self._zstd)


def messages_of_row(blocks: Iterable[Messages], row: int, topic: int) -> Iterator[Messages]:
    """Yield the messages of one row of a group for a topic; `blocks` are from `Recorder._blocks`."""
    return (message._replace(channels=[topic], data=message.data[row : row + 1]) for message in blocks)
