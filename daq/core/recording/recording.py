"""Reader of a recording: its channels in physical units, its markers, and its scene."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from daq.core.mcap_file.reader import Container
from daq.core.recording import layout
from daq.core.recording.channel_series import BlockCache, Series
from daq.core.recording.markers import (
    EVENT_TYPE,
    EVENT_TYPE_WITH_JOINT,
    Gap,
    Marker,
    event_from_json,
    gaps_of,
    unmarked_ranges,
)
from daq.core.recording.recorded_test import RecordedTest, SceneOutline, TestKind, kind_from_markers
from daq.core.recording.sample_block import SAMPLE_TYPE
from daq.core.signal_chain.channel import UNITS, ChannelInfo
from daq.core.signal_chain.field_checks import NAME, check
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, RunWarning, ShotrigError, add_path, suggestion
from rig.core.base.escaping import escape_html
from rig.core.base.figure_types import Axes
from rig.core.base.input_files import as_path
from rig.core.results import Result, complete_style

if TYPE_CHECKING:
    from rig.core.scene.excitation import Test
    from rig.core.scene.scene import Scene


def open(path: str | Path) -> Recording:
    """Open a recording for reading.

    Parameters
    ----------
    path : str or Path
        An MCAP file with the layout of `daq/core/recording/LAYOUT.md`.

    Returns
    -------
    Recording
        A context manager; samples are read on demand.

    Raises
    ------
    RecordingError
        If the file cannot be read, is not a recording, or is damaged; the message gives the remedy.
    """
    return Recording(path)


class Recording(Result):
    """An open recording.

    Parameters
    ----------
    path : str or Path
        The file.

    Attributes
    ----------
    path : Path
        The file.
    channels : dict of str to ChannelInfo
        In the order of their numbers in the file; recordings of shotrig have the order of the scene.
    rate : float
        Samples per second [Hz].
    start_ns : int
        Time of sample 0, nanoseconds since the recording's epoch.
    samples : int
        Number of samples of the longest channel.
    truth_points : tuple of str
        Points whose true (simulated) motion was recorded: ``body 1``, ..., ``table``; empty without it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = as_path(path)
        self._container = Container(self.path)
        try:
            self._open_topics()
            clock = next(iter(self._series.values())).clock
            self.rate, self.start_ns = clock.rate, clock.start_ns
            self.channels = {name: self._channel_info(name, series) for name, series in self._series.items()}
            if self._has_our_layout:
                self._container.need_checksums()
            self.samples = max(series.stop for series in self._series.values())
        except BaseException:
            self._container.close()
            raise

    def _open_topics(self) -> None:
        """Find the topics of channels and of true motion in the index of the file."""
        summary = self._container.summary
        self._series: dict[str, Series] = {}
        self._truth: dict[str, dict[str, Series]] = {}
        self._topics: dict[str, Channel] = {}
        block_cache = BlockCache()
        for channel in sorted(summary.channels.values(), key=lambda channel: channel.id):
            schema = summary.schemas.get(channel.schema_id)
            if channel.topic in self._topics:
                raise RecordingError(
                    f"{self.path}: two channels have the topic {channel.topic}. Write the file again with "
                    "another topic for each channel."
                )
            self._topics[channel.topic] = channel
            if schema is None or schema.name not in SAMPLE_TYPE or schema.encoding != "protobuf":
                continue
            series = Series(self._container, channel, block_cache)
            if channel.topic.startswith(layout.RAW):
                self._series[channel.topic.removeprefix(layout.RAW)] = series
            elif channel.topic.startswith(layout.TRUTH) and {"point", "quantity"} <= channel.metadata.keys():
                point, quantity = channel.metadata["point"], channel.metadata["quantity"]
                try:
                    check({"point": point, "quantity": quantity}, {"point": NAME, "quantity": NAME})
                except RecordingError as error:
                    raise RecordingError(f"{self.path}: {channel.topic!r:.80}: {error}") from error
                self._truth.setdefault(quantity, {})[point] = series
        if not self._series:
            raise RecordingError(
                f"{self.path}: no samples on topics {layout.RAW}*. Import files of other programs with `daq import`."
            )
        if not summary.chunks_of_channel and summary.statistics is not None and summary.statistics.message_count:
            raise RecordingError(
                f"{self.path}: the file has no chunk index. Enable the chunk index (summary section) in the program "
                "that wrote the file, and write the file again."
            )
        self.truth_points = tuple(self._truth.get("displacement", ()))

    def _channel_info(self, name: str, series: Series) -> ChannelInfo:
        """Return the channel that the metadata of a topic describe, with defaults for missing metadata."""
        place = f"{self.path}: {series.topic!s:.80}"
        metadata = {"name": name, "at": "", "sensitivity": "1.0"} | series.metadata
        metadata["rate"] = repr(series.clock.rate)
        if "quantity" not in metadata:
            metadata["quantity"] = next((key for key, unit in UNITS.items() if unit == metadata.get("unit")), "")
        if metadata["quantity"] not in UNITS:
            stated = f"the quantity {metadata['quantity']!r:.80}" if metadata["quantity"] else "no quantity"
            raise RecordingError(f"{place}: the metadata state {stated}; expected one of {', '.join(UNITS)}.")
        if series.clock != next(iter(self._series.values())).clock:
            raise RecordingError(
                f"{place}: its sample rate or start time differs from that of the first channel. Write channels with "
                "different sample clocks to separate files."
            )
        try:
            defaults = ChannelInfo(name, "", "force", 1.0, 1.0).to_metadata()
            return ChannelInfo.from_metadata(defaults | metadata)
        except RecordingError as error:
            raise RecordingError(f"{place}: {error}") from error

    # -- in a notebook -----------------------------------------------------------------------------------

    def summary(self) -> str:
        """Name the file, its duration, its channels and how the test ended."""
        try:
            status = self.status
        except RecordingError:
            # A debugger or notebook shows this text, so no error may be raised here.
            status = "closed, or its metadata are damaged"
        names = ", ".join(self.channels)
        return f"{self.path}: {self.samples / self.rate:.4g} s of {names} at {self.rate:g} Hz, {status}"

    def _repr_html_(self) -> str:
        channels = [f"  {name}: {info.quantity} of {info.at}, {info.unit}" for name, info in self.channels.items()]
        return f"<pre>{escape_html(chr(10).join([self.summary(), *channels]))}</pre>"

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return time in s, and all samples of each channel in its unit; lost samples are NaN."""
        values = {f"{name}_{info.unit}": self.read(name) for name, info in self.channels.items()}
        longest = max(column.size for column in values.values())
        for name, column in values.items():
            values[name] = np.pad(column, (0, longest - column.size), constant_values=np.nan)
        return {"time_s": np.arange(longest) / self.rate, **values}

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw all channels over time."""
        time, *columns = self.columns().items()
        for name, column in columns:
            ax.plot(time[1], column, **complete_style(style, label=name.replace("_", " / "), lw=0.7))
        ax.set(xlabel="time / s")

    # -- samples -----------------------------------------------------------------------------------------

    def read(self, channel: str, start: int = 0, stop: int | None = None) -> Array:
        """Read a channel.

        Parameters
        ----------
        channel : str
            Name of the channel.
        start, stop : int
            Indices of the first sample, and of the sample after the last; by default all samples.

        Returns
        -------
        ndarray, (stop - start,)
            In the channel's unit [m, m/s, m/s² or N]; NaN where samples were lost, see `gaps`.

        Raises
        ------
        RecordingError
            If there is no such channel or sample, or the file is damaged there.
        """
        if channel not in self._series:
            hint = suggestion(str(channel), self._series)
            advice = f"{hint and hint + ' '}Choose one of {', '.join(self._series)}."
            raise RecordingError(f"{self.path}: no channel {channel!r}. {advice}")
        start, stop = self._range(start, stop)
        return self._series[channel].read(start, stop)

    def blocks(self, channels: Sequence[str] | None = None, size: int = 1 << 16) -> Iterator[tuple[int, Array]]:
        """Read channels block by block, in bounded memory.

        Parameters
        ----------
        channels : sequence of str, optional
            Names of channels; by default all.
        size : int
            Number of samples of a block; the last block may be shorter.

        Yields
        ------
        first : int
            Index of the first sample of the block.
        samples : ndarray, (channels, size)
            In the channels' units; NaN where samples were lost.
        """
        names = list(self.channels) if channels is None else list(channels)
        self.reject_mostly_lost(0, self.samples)
        for first in range(0, self.samples, size):
            stop = min(first + size, self.samples)
            samples = np.empty((len(names), stop - first))
            for row, name in enumerate(names):
                samples[row] = self.read(name, first, stop)
            yield first, samples

    def truth(self, quantity: str, start: int = 0, stop: int | None = None) -> Array:
        """Read the true (simulated) motion, which the scene setting `recording: {truth: true}` records.

        Parameters
        ----------
        quantity : {'displacement', 'velocity', 'acceleration', 'gap', 'contact'}
            Quantity of the points; gap and contact are quantities of the dampers. The gap is the height above the
            floor. Contact is 0 in flight, 1 on the floor, 2 at the ceiling.
        start, stop : int
            Indices of the first sample, and of the sample after the last; by default all samples.

        Returns
        -------
        ndarray, (points or dampers, stop - start)
            Values in SI, in the order of `truth_points` or of the scene's dampers; NaN where samples were lost.
        """
        if quantity not in self._truth:
            remedy = "Record the scene with recording: {truth: true}."
            if self._truth:
                remedy = f"Choose one of {', '.join(self._truth)}."
            raise RecordingError(f"{self.path}: no true {quantity}. {remedy}")
        start, stop = self._range(start, stop)
        return np.array([series.read(start, stop) for series in self._truth[quantity].values()])

    def reject_mostly_lost(self, start: int, stop: int) -> None:
        """Raise `RecordingError` if almost all samples [start, stop) of a long range of a channel are missing."""
        for series in self._series.values():
            series.reject_mostly_lost(start, stop)

    @property
    def has_truth(self) -> bool:
        """Whether the true motion of all points and dampers of the scene was recorded."""
        from daq.core.recording.truth import dampers_of, points_of

        if not self.truth_points:
            return False
        dampers = dampers_of(self.scene)
        damper_series = tuple(self._truth.get("gap", ())), tuple(self._truth.get("contact", ()))
        return self.truth_points == points_of(self.scene) and damper_series == (dampers, dampers)

    def _range(self, start: int, stop: int | None) -> tuple[int, int]:
        stop = self.samples if stop is None else stop
        if not 0 <= start <= stop <= self.samples:
            raise RecordingError(
                f"{self.path}: got samples {start} to {stop - 1}; expected a range from 0 to {self.samples - 1}."
            )
        return int(start), int(stop)

    @property
    def _has_our_layout(self) -> bool:
        """Whether the file states the layout of this package, in which every record has a checksum."""
        return any("layout" in series.metadata for series in self._series.values())

    # -- markers and events ------------------------------------------------------------------------------

    @cached_property
    def markers(self) -> list[Marker]:
        """Ranges of samples with a kind, such as an impact or a measurement, in the order of their first samples."""
        with add_path(self.path):
            markers = [Marker.from_json(data) for data in self._messages(layout.MARKERS)]
        return sorted((marker for marker in markers if marker.kind != "start"), key=lambda marker: marker.first_sample)

    @cached_property
    def gaps(self) -> list[Gap]:
        """Missing samples, in the order of their first samples."""
        if layout.MARKERS not in self._topics:
            missing_ranges = [(*gap, name) for name, series in self._series.items() for gap in series.missing_ranges()]
            return [Gap(first, stop - 1, (name,), "missing") for first, stop, name in sorted(missing_ranges)]
        invalid = [
            Gap(first, stop - 1, (name,), "not valid readings")
            for name, series in self._series.items()
            for first, stop in unmarked_ranges(series.invalid_ranges(), self._marked_gaps(name))
        ]
        if invalid:
            count = sum(gap.last_sample - gap.first_sample + 1 for gap in invalid)
            warnings.warn(
                f"{self.path}: {count} samples are not valid readings, the first is sample {invalid[0].first_sample} "
                f"of {invalid[0].channels[0]}. They are treated as lost.",
                RunWarning,
                stacklevel=2,
            )
        return sorted([*self._all_marked_gaps, *invalid], key=lambda gap: gap.first_sample)

    @cached_property
    def _all_marked_gaps(self) -> list[Gap]:
        with add_path(self.path):
            return gaps_of(self.markers, list(self.channels))

    def _marked_gaps(self, channel: str) -> list[Gap]:
        return [gap for gap in self._all_marked_gaps if channel in gap.channels]

    @property
    def overloads(self) -> list[Marker]:
        """Markers of the segments in which a channel exceeded its range."""
        return [marker for marker in self.markers if marker.kind == "overload"]

    @cached_property
    def events(self) -> NDArray[Any]:
        """True contact events of the dampers and joints, one per row.

        Fields: `time` [s], `damper` (number, from 1), `kind` (such as `floor` or `separation`), and `speed`, the
        closing speed before an impact [m/s]. If joints have events, there is a field `joint`: the number of the joint,
        from 1. In each row either `joint` or `damper` is 0.
        """
        with add_path(self.path):
            events = [event_from_json(data) for data in self._messages(layout.EVENTS)]
        if any(joint for *_, joint in events):
            return np.array(events, dtype=EVENT_TYPE_WITH_JOINT)
        return np.array([event[:-1] for event in events], dtype=EVENT_TYPE)

    def _messages(self, topic: str) -> Iterator[memoryview]:
        """Yield the content of each message of a topic; nothing if there is no such topic."""
        if topic in self._topics:
            number = self._topics[topic].id
            for chunk in self._container.summary.chunks_of_channel.get(number, ()):
                for message in self._container.messages(int(chunk)):
                    if message.channel == number:
                        yield message.data

    # -- descriptions ------------------------------------------------------------------------------------

    @cached_property
    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records: `run`, `daq`, `sensor NAME`, `display`, `outcome`, ..."""
        return {
            name: {key: text for key, text in fields.items() if key != "crc32"}
            for name, fields in self._container.metadata().items()
        }

    @property
    def status(self) -> str:
        """How the test ended: `complete`, `interrupted`, `failed`, `recovered`, or `unknown`."""
        return self.metadata.get("outcome", {}).get("status", "unknown")

    @cached_property
    def test(self) -> RecordedTest:
        """The recorded test: its kind and its settings."""
        return RecordedTest(self.test_kind, self._settings)

    @cached_property
    def test_kind(self) -> TestKind:
        """Kind of the recorded test; the scene is loaded only if the recording does not give the kind."""
        stated = self.metadata.get("run", {}).get("kind", "")
        return TestKind(stated) if stated in set(TestKind) else kind_from_markers(self.markers, self._settings)

    @property
    def _settings(self) -> Test | None:
        """Settings of the test; None if the recording contains no scene, as from another program."""
        try:
            return self.scene.test
        except ShotrigError:
            return None

    @cached_property
    def outline(self) -> SceneOutline:
        """Summary of the recorded scene from the metadata; the scene is loaded only if the summary is missing."""
        return SceneOutline.from_metadata(self.metadata.get("run", {})) or SceneOutline.of(self.scene)

    @property
    def duration(self) -> float:
        """Duration of the recording [s]."""
        return self.samples / self.rate

    @property
    def source(self) -> str:
        """Files that the samples were imported from; empty for the virtual rig."""
        return self.metadata.get("run", {}).get("source", "")

    @property
    def stored(self) -> str:
        """Type of the samples in the file: `float64`, `float32` or `counts`."""
        return next(iter(self._series.values())).stored

    @cached_property
    def scene(self) -> Scene:
        """The scene that was recorded."""
        from rig.core.scene.loading import loads_si

        text = self._container.attachment(layout.SCENE_FILE)
        if text is None:
            raise RecordingError(
                f"{self.path}: no scene ({layout.SCENE_FILE}) in the file. Record or import it again with a scene."
            )
        try:
            scene = loads_si(text.decode(), f"{self.path}: {layout.SCENE_FILE}")
        except UnicodeDecodeError as error:
            raise RecordingError(f"{self.path}: {layout.SCENE_FILE} is not text ({error}). Record it again.") from error
        for name, info in self.channels.items():
            if info.body > scene.structure.bodies:
                raise RecordingError(
                    f"{self.path}: channel {name} is at body {info.body}, but the last body of {layout.SCENE_FILE} is "
                    f"body {scene.structure.bodies}. Record or import it again with its own scene."
                )
        return scene

    def check(self) -> None:
        """Read the whole file; check every record, and that all missing samples are marked.

        Raises
        ------
        RecordingError
            At the first damage. In a file of this package, also at the first missing samples without a marker.
        """
        from daq.core.mcap_file.file_check import check_file

        check_file(self._container)
        _ = self.metadata, self.markers, self.events
        for series in (each for by_point in self._truth.values() for each in by_point.values()):
            # The blocks are checked while they are read.
            for _ in series.blocks(0, series.stop):
                pass
        for name in self._series:
            for first, stop in unmarked_ranges(self._series[name].missing_ranges(), self._marked_gaps(name)):
                if self._has_our_layout:
                    raise RecordingError(
                        f"{self.path}: samples {first} to {stop - 1} of {name} are missing without a marker, or are "
                        "not valid readings: they were removed or overwritten, or later samples were moved. Use the "
                        "other samples only."
                    )

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
