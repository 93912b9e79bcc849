"""Writing a recording: an MCAP file that is readable up to its last flush, also after a crash."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import metadata
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from daq.mcap_file.summary import checked
from daq.mcap_file.writer import ChunkedFile, Message, Messages
from daq.recording import layout
from daq.recording.committed_file import RESERVE, Disk, DiskError
from daq.recording.layout import Timebase
from daq.recording.markers import MARKER_SCHEMA, Marker
from daq.recording.protobuf import Schema
from daq.recording.recorded_test import SceneOutline
from daq.recording.sample_block import SCHEMAS, block_schema, encode, stored_as
from daq.recording.sample_groups import Group, Grouping
from rig.arrays import Array
from rig.ending_signals import delayed_interrupt
from rig.errors import RunError

if TYPE_CHECKING:
    from daq.recording.recorded_test import TestKind
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.scene import Scene
    from rig.simulation.motion import Motion

# No compression shrinks float64 samples by more than a tenth, and lz4 unpacks them eight times as fast as zstd. Counts
# shrink by a fifth with zstd.
COMPRESSION = {"float64": "lz4", "float32": "zstd", "counts": "zstd"}
# The index at the end of the file grows with every chunk.
RESERVE_PER_CHUNK = 256
# Reading the version takes longer than writing ten groups of samples.
_version = cache(metadata.version)


class Recorder:
    """Writes samples, markers and truth into a new recording.

    Samples are collected into blocks on a fixed grid, and into groups of about half a second that are committed to the
    disk together; the bytes of the file do not depend on how `write` calls are split. A process that is killed loses
    less than one group. Leaving the context by an exception closes the file and records the reason in it.

    Parameters
    ----------
    path : str or Path
        File to make, in an existing folder.
    scene : Scene
        Stored in the file; its `recording` determines how samples are stored and what else is recorded.
    channels : sequence of ChannelInfo
        One for each row of samples.
    rate : float
        Samples per second, Hz.
    start_ns : int
        Time of sample 0, nanoseconds since an epoch of the user's choice; 0 keeps recordings reproducible.
    overwrite : bool
        Whether an existing file may be replaced.
    source : str
        Names of the files that the samples were imported from; empty for those of the virtual rig.
    test_kind : TestKind, optional
        Kind of the recorded test; omitted, readers deduce it from the markers.

    Raises
    ------
    RecordingError
        If the file exists, or cannot be made.
    DiskError
        If the disk is full or fails.
    """

    def __init__(
        self,
        path: str | Path,
        scene: Scene,
        channels: Sequence[ChannelInfo],
        rate: float,
        start_ns: int = 0,
        overwrite: bool = False,
        source: str = "",
        test_kind: TestKind | None = None,
    ) -> None:
        self.path = Path(path)
        self.channels = tuple(channels)
        self.clock = Timebase(rate, start_ns)
        self.closed = False
        self._scene, self._source, self._test_kind = scene, source, test_kind
        self._block, self._group = layout.block_length(rate), layout.flush_length(rate)
        self._stored = stored_as(scene, self.channels)
        # Size of a stored number in the unit that a channel reads.
        counts = self._stored == "counts"
        scales = [info.unit_per_count if counts else 1.0 / info.sensitivity for info in self.channels]
        self._scale = np.array(scales)[:, None]
        kind = SCHEMAS[self._stored][2]
        self._raw = Grouping(len(self.channels), self._group, kind)
        # The same samples, in longer groups, for the display.
        max_groups = layout.SHOWN_CHANNELS // len(self.channels)
        self._groups_shown = min(layout.SHOWN_GROUPS, max(1, max_groups))
        self._shown = Grouping(len(self.channels), self._groups_shown * self._group, kind)
        self._marks = [Marker("start", 0)]
        self._marked = self._chunks = self._written = 0
        self._full = False
        self._schemas: dict[str, int] = {}
        self._disk = Disk(self.path, overwrite)
        with self._disk.removed_on_failure():
            self._begin()

    @property
    def position(self) -> int:
        """Number of the next sample to be written."""
        return self._raw.position

    @property
    def size(self) -> int:
        """Length of the file so far, bytes."""
        return self._disk.tell()

    @property
    def free(self) -> int:
        """Free bytes of its disk, less the reserve for the end of the file."""
        return max(0, self._disk.free() - RESERVE - RESERVE_PER_CHUNK * self._chunks)

    @property
    def accepts_samples(self) -> bool:
        """Whether more can be recorded: the file is open and its disk is not full."""
        return not (self.closed or self._full or self._disk.failed)

    def write(self, samples: Array | NDArray[np.int32]) -> None:
        """Write the next samples of all channels.

        A group is committed with its last sample. Where the truth is recorded, it must be written first.

        Parameters
        ----------
        samples : ndarray, (channels, any number)
            Converter counts (integers) or volts.

        Raises
        ------
        RunError
            If the truth of the samples was not written, or they are volts where counts are to be stored.
        DiskError
            If the disk is full or fails; the file then holds all samples up to the previous flush.
        """
        self._need_open()
        if samples.ndim != 2 or samples.shape[0] != len(self.channels):
            raise ValueError(f"samples: got shape {samples.shape}; expected ({len(self.channels)}, n).")
        self._need_truth(samples.shape[1])
        counts = np.issubdtype(samples.dtype, np.integer)
        if self._stored == "counts" and not counts:
            raise RunError("recording.samples: counts, but the samples are volts. Give the converter bits and a range.")
        if self._stored != "counts" and counts:
            samples = samples * np.array([[info.volts_per_count or 1.0] for info in self.channels])
        written = 0
        while written < samples.shape[1]:
            group_end = written + self._group - self._raw.position % self._group
            part, written = samples[:, written:group_end], group_end
            self._raw.add(part)
            if self._display is not None:
                self._shown.add(part)
            self._emit(self._raw.position // self._group)

    def gap(self, lost_samples: int) -> None:
        """Pass over samples that were not acquired; they read as NaN and have a marker `gap`."""
        self._need_open()
        if lost_samples < 1:
            raise ValueError(f"lost_samples: got {lost_samples}; expected at least 1.")
        self._need_truth(lost_samples)
        first = self._raw.position
        self._raw.skip(lost_samples)
        if self._display is not None:
            self._shown.skip(lost_samples)
        self.mark("gap", first, first + lost_samples - 1)
        self._emit(self._raw.position // self._group)

    def mark(self, kind: str, first_sample: int, last_sample: int | None = None, **fields: Any) -> None:
        """Mark an event at a sample, or from a sample to another, both included.

        The bytes of the file do not depend on how `write` calls are split if marks are made at the same `position`.
        """
        self._need_open()
        marker = Marker(kind, int(first_sample), None if last_sample is None else int(last_sample), fields)
        marker.to_json()
        self._marks.append(marker)

    def write_truth(self, motion: Motion) -> None:
        """Take the next samples of the true motion, for a scene that records it."""
        self._need_open()
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
            Why, in words.

        Raises
        ------
        DiskError
            If the disk is full or fails; `daq recover` then completes the file.
        """
        if self.closed:
            return
        self.closed = True
        try:
            if not self._disk.failed:
                with delayed_interrupt():
                    self._end(status, reason)
        finally:
            self._disk.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, *__: object) -> None:
        if error is None:
            self.close()
            return
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        try:
            self.close(status, str(error) or type(error).__name__)
        except RunError as another:
            if isinstance(error, DiskError):
                # The second error includes the first, with the remedy for a file without an end.
                raise another from error
            error.add_note(str(another))

    def _need_open(self) -> None:
        if not self.accepts_samples:
            raise RunError(f"{self.path}: the recording has ended. Make a new one for more samples.")

    def _need_truth(self, samples: int) -> None:
        """Raise `RunError` unless the truth of the next samples was written: they are committed together."""
        if self._truth is not None and self._truth.position < self._raw.position + samples:
            raise RunError("recording.truth: the true motion of these samples is missing. Write it before them.")

    # -- the beginning and the end of the file -----------------------------------------------------------

    def _begin(self) -> None:
        """Write all descriptions before any sample, so that later damage cannot separate samples from them."""
        self._file = ChunkedFile(self._disk, f"shotrig {_version('shotrig')}", COMPRESSION[self._stored])
        self._markers = self._register(layout.MARKERS, MARKER_SCHEMA, {})
        common = {"stored": self._stored, "start_ns": str(self.clock.start_ns), "layout": layout.VERSION}
        schema = block_schema(SCHEMAS[self._stored][0])
        self._topics = [
            self._register(f"{layout.RAW}{info.name}", schema, info.to_metadata() | common | {"scale": repr(scale)})
            for info, scale in zip(self.channels, self._scale[:, 0].tolist(), strict=True)
        ]
        self._truth = self._display = None
        if self._scene.recording.truth:
            from daq.recording.truth import Truth

            self._truth = Truth(self._scene, self.clock, self._group, self._register)
        if self._scene.recording.display:
            from daq.recording.display import Display

            self._display = Display(self._scene, self.channels, self.clock, self._truth, self._register)
        self._write_markers(1)
        if self._display is not None:
            self._send([self._display.introduction()])
        self._describe()
        self._disk.commit()

    def _describe(self) -> None:
        """Write the metadata records and the scene."""
        scene, start = self._scene, str(self.clock.start_ns)
        converter = {f"converter.{key}": json.dumps(value) for key, value in scene.converter.model_dump().items()}
        sizes = {"block_samples": str(self._block), "flush_samples": str(self._group), "stored": self._stored}
        records = {"daq": converter | sizes | {"rate_hz": repr(self.clock.rate), "start_ns": start}}
        for info in self.channels:
            sheet = {"name": info.name, "at": info.at, "quantity": info.quantity, "unit": info.unit}
            sheet |= {"direction": "up", "sensitivity_V_per_unit": repr(info.sensitivity)}
            records[f"sensor {info.name}"] = {f"sensor.{key}": text for key, text in info.sensor.items()} | sheet
        if self._display is not None:
            records["display"] = self._display.description()
        run = SceneOutline.of(scene).to_metadata() | {"seed": str(scene.seed), "layout": layout.VERSION}
        source = {"source": self._source} if self._source else {}
        kind = {"kind": str(self._test_kind)} if self._test_kind is not None else {}
        records["run"] = run | {"shotrig": _version("shotrig")} | source | kind
        for name, fields in records.items():
            self._file.add_metadata(name, checked(fields))
        text = scene.to_si_yaml().encode()
        self._file.add_attachment(int(start), int(start), layout.SCENE_FILE, "application/yaml", text)

    def _register(self, topic: str, schema: Schema, metadata: Mapping[str, str]) -> int:
        """Announce a topic; return the number of its channel in the file."""
        number = self._schemas.get(schema.name)
        if number is None:
            number = self._file.add_schema(schema.name, schema.encoding, schema.data)
            self._schemas[schema.name] = number
        return self._file.add_channel(topic, schema.message_encoding, number, metadata)

    def _end(self, status: str, reason: str) -> None:
        disk_error = None
        if not self._full:
            try:
                for stream in self._streams:
                    stream.close_group()
                self._emit(math.inf)
                self._written = self._raw.position
                if self._truth is not None:
                    self._send(self._truth.events_before(math.inf))
                if self._display is not None:
                    self._shown.close_group()
                    self._show(math.inf)
                    self._send(self._display.finish())
            except DiskError as error:
                if self._disk.failed:
                    raise
                # The reserve suffices to end the file.
                disk_error, status, reason = error, "failed", str(error)
        self._write_markers(math.inf)
        outcome = {"status": status, "reason": reason, "samples": str(self._written)}
        self._file.add_metadata("outcome", checked(outcome | {"markers": str(self._marked)}))
        self._file.finish()
        if self._written == 0 and status != "complete":
            self._commit()
            self._disk.discard()
        else:
            with self._explained_disk_errors():
                self._disk.finish()
        if disk_error is not None:
            raise disk_error

    # -- the groups of samples ---------------------------------------------------------------------------

    def _emit(self, stop: float) -> None:
        """Write the groups before a number, in order."""
        streams = self._streams
        if not any(stream.complete for stream in streams):
            return
        for number in sorted({number for stream in streams for number in stream.complete}):
            if number < stop:
                with delayed_interrupt():
                    self._write_group(number)

    def _write_group(self, number: int) -> None:
        raw = self._raw.complete.pop(number, None)
        # The reserve suffices to end the file.
        if self.free < sum(stream.group_bytes for stream in self._streams):
            self._full = True
            raise DiskError(
                f"{self._disk.at}: the disk is full; the file contains {self._content}. Free disk space or use "
                "another disk."
            )
        if self._display is not None:
            self._show(number // self._groups_shown)
        self._write_markers((number + 1) * self._group)
        if raw is not None:
            # A chunk for each channel, so that readers of one need not decode the others.
            self._chunks += self._file.add_chunk_per_channel(self._topics, self._blocks(raw))
        if self._truth is not None:
            streams = [[] if group is None else self._blocks(group) for group in self._truth.take(number)]
            for chunk in self._truth.chunks:
                self._send(each for stream, row, topic in chunk for each in of_row(streams[stream], row, topic))
            self._send(self._truth.events_before((number + 1) * self._group))
        self._commit()
        if raw is not None:
            self._written = raw.spans[-1][1]

    @property
    def _streams(self) -> list[Grouping]:
        return [self._raw, *(() if self._truth is None else self._truth.streams)]

    @property
    def _content(self) -> str:
        return f"the first {self._written / self.clock.rate:.2f} s"

    def _commit(self) -> None:
        with self._explained_disk_errors():
            self._disk.commit()

    @contextmanager
    def _explained_disk_errors(self) -> Iterator[None]:
        """Add the content of the file and the remedy to an error of the disk."""
        try:
            yield
        except DiskError as error:
            at = self._disk.at
            raise DiskError(
                f"{error}; the file contains {self._content}, without an end. Free disk space, then run "
                f"`daq recover {at} -o FIXED.mcap`."
            ) from error

    def _blocks(self, group: Group) -> list[Messages]:
        """Encode the blocks of a group, all rows together, without their topics."""
        encoded = []
        for first, samples in group.blocks(self._block):
            _, blocks, size = samples.shape
            starts = np.arange(blocks) * size + first
            times = self.clock.times_ns([*starts.tolist(), first + blocks * size])
            sequence = starts // self._block % 2**32
            encoded.append(Messages(0, times[1:], times[:-1], encode(self.clock, first, samples), sequence))
        return encoded

    def _show(self, stop: float) -> None:
        """Write the display's groups before a number."""
        assert self._display is not None
        for number in sorted(number for number in self._shown.complete if number < stop):
            group = self._shown.complete.pop(number)
            in_units = [
                Group(first, samples * self._scale, [(first, first + samples.shape[1])])
                for first, samples in group.acquired()
            ]
            waveforms = (each for part in in_units for each in self._display.waveforms(part.first, part.samples))
            levels = self._display.levels(block for part in in_units for block in part.blocks(self._block))
            self._send(chain(waveforms, [levels]))

    def _write_markers(self, stop: float) -> None:
        """Write the markers that end before a sample."""
        due = [mark for mark in self._marks if mark.end < stop]
        if not due:
            return
        self._marks = [mark for mark in self._marks if mark.end >= stop]
        messages = []
        for marker in sorted(due, key=lambda mark: mark.first_sample):
            times = self.clock.time_ns(marker.end), self.clock.time_ns(marker.first_sample)
            messages.append(Message(self._markers, *times, marker.to_json(), self._marked))
            self._marked += 1
        self._send(messages)

    def _send(self, messages: Iterable[Message | Messages]) -> None:
        """Write messages as a separate chunk, so that readers of other topics need not decode them."""
        self._chunks += self._file.add_chunk(messages)


def of_row(blocks: Iterable[Messages], row: int, topic: int) -> Iterator[Messages]:
    """Return the messages of one row of a group, with its topic."""
    return (each._replace(channel=topic, data=each.data[row]) for each in blocks)
