"""Metadata, markers and events are validated when a file is read: invalid values are reported immediately."""

import itertools
import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import daq
from daq.core.mcap_file.compression import zstd
from daq.core.mcap_file.reader import Container
from daq.core.mcap_file.writer import ChunkedFile, Message
from daq.core.recording import recorder
from daq.core.recording.layout import Timebase
from daq.core.recording.markers import CONTACT_CHANGES, Marker, event_from_json
from daq.core.recording.sample_block import block_schema, decode, encode
from daq.core.signal_chain.channel import ChannelInfo
from daq.extras.viewer.description import describe
from rig.core.base.errors import RecordingError, RunWarning, add_path
from rig.core.base.escaping import is_single_line
from tests.daq.recording.recordings import (
    CONVERTER_24_BIT,
    FLUSH_LENGTH,
    RATE,
    make_scene,
    random_volts,
    two_channels,
    write_recording,
)

ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.just(10**300) | st.text() | st.just("x" * 60_000),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
CHANNEL = ChannelInfo("body1", "body 1", "acceleration", 0.01, 5120.0, poles=(-1 + 2j,), delay=1e-3)
VALID_METADATA = CHANNEL.to_metadata()


@given(st.sampled_from(sorted(VALID_METADATA)), ANY_JSON)
def test_any_channel_metadata_is_valid_or_rejected(key: str, value: Any) -> None:
    try:
        info = ChannelInfo.from_metadata(VALID_METADATA | {key: json.dumps(value)})
    except RecordingError as error:
        # Only the beginning of a long value is quoted.
        assert len(str(error)) < 400
        return
    response = info.response(np.array([0.0, 1.0, 1e3]))
    assert response.shape == (3,) and info.unit_per_count != 0.0 and is_single_line(info.name)


@given(st.sampled_from(["kind", "first_sample", "last_sample", "frequency", "settled", "channels", "lines"]), ANY_JSON)
def test_any_marker_is_valid_or_rejected(key: str, value: Any) -> None:
    valid = {"kind": "measure", "first_sample": 1, "last_sample": 2, "frequency": 20.0, "settled": True}
    try:
        marker = Marker.from_json(memoryview(json.dumps(valid | {key: value}).encode()))
    except RecordingError as error:
        assert len(str(error)) < 400
        return
    assert 0 <= marker.first_sample <= marker.end < 2**54
    assert float(marker.fields["frequency"]) > 0.0 and isinstance(marker.fields["settled"], bool)
    with pytest.raises(RecordingError, match="lacks the field duration"):
        marker.fields["duration"]


@pytest.mark.parametrize("element", ["damper", "joint"])
@given(st.sampled_from(["time", "damper", "joint", "kind", "speed"]), ANY_JSON)
def test_any_contact_event_is_valid_or_rejected(element: str, key: str, value: Any) -> None:
    event = {"time": 0.1, element: 1, "kind": "floor", "speed": 0.2} | {key: value}
    try:
        time, damper, kind, speed, joint = event_from_json(memoryview(json.dumps(event).encode()))
    except RecordingError:
        return
    assert np.isfinite([time, speed]).all() and damper + joint >= 1 and kind in CONTACT_CHANGES


def rewrite(path: Path, checksums: bool = True, shift: int = 0) -> Path:
    """Copy a recording without the checksums of its chunks, or with its last two chunks `shift` samples later."""
    target = path.with_name("rewrite.mcap")
    with Container(path) as container, target.open("wb") as file:
        copy, summary = ChunkedFile(file, "test"), container.summary
        schemas = {
            number: copy.add_schema(schema.name, schema.encoding, schema.data)
            for number, schema in summary.schemas.items()
        }
        for channel in summary.channels.values():
            copy.add_channel(channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata)
        for chunk in range(len(summary.offsets)):
            messages = []
            for message in container.messages(chunk):
                channel, data = summary.channels[message.channel], bytes(message.data)
                times = message.log_time, message.publish_time
                if shift and channel.topic.startswith("/raw/") and chunk >= len(summary.offsets) - 2:
                    block = decode(message.data, summary.schemas[channel.schema_id].name)
                    clock, first = Timebase(block.rate), block.first_sample + shift
                    data = encode(clock, first, block.samples[None, None]).tobytes()
                    times = clock.time_ns(first + block.samples.size), clock.time_ns(first)
                messages.append(Message(message.channel, *times, data, message.sequence))
            copy.add_chunk(messages, zstd())
        copy.finish()
    if not checksums:
        content = bytearray(target.read_bytes())
        with Container(target) as container:
            for offset in container.summary.offsets:
                # The checksum follows opcode, length, two times and the unpacked size.
                content[int(offset) + 33 : int(offset) + 37] = bytes(4)
        target.write_bytes(content)
    return target


@pytest.fixture(scope="module")
def intact_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("intact_file") / "a.mcap", random_volts(4 * FLUSH_LENGTH))


def test_shotrig_layout_requires_checksums(intact_file: Path) -> None:
    with daq.open(rewrite(intact_file)) as recording:
        assert np.isfinite(recording.read("body1")).all()
    path = rewrite(intact_file, checksums=False)
    with pytest.raises(RecordingError, match="no checksum"), daq.open(path) as recording:
        recording.read("body1")


@pytest.mark.parametrize("shift", [2**27, 2**40])
def test_huge_gap_is_reported_at_once(intact_file: Path, shift: int) -> None:
    with daq.open(rewrite(intact_file, shift=shift)) as recording:
        assert np.isfinite(recording.read("body1", 0, FLUSH_LENGTH)).all()
        for read in (lambda: recording.read("body1"), lambda: list(recording.blocks())):
            with pytest.raises(RecordingError, match="of them are in the file"):
                read()
        assert any("lost" in line and "of them are in the file" in line for line in describe(recording))


@pytest.mark.parametrize("shift", [1, 2**27, 2**40])
def test_unmarked_missing_samples_are_reported(intact_file: Path, shift: int) -> None:
    with daq.open(rewrite(intact_file, shift=shift)) as recording:
        first, stop = 3 * FLUSH_LENGTH, 3 * FLUSH_LENGTH + shift
        with pytest.raises(
            RecordingError, match=f"samples {first} to {stop - 1} of body1 are missing without a marker"
        ):
            recording.check()


@pytest.mark.parametrize("reason", ["a message is not a marker", "r.mcap is damaged"])
def test_nested_error_names_the_file_once(reason: str) -> None:
    path = Path("r.mcap")
    with pytest.raises(RecordingError) as reported, add_path(path), add_path(path):
        raise RecordingError(reason)
    assert str(reported.value).count("r.mcap") == 1 and str(reported.value).endswith(reason)


SIGNALING_NAN = np.array([0x7F800001], "<u4").view("<f4")[0]


@pytest.mark.parametrize(
    ("stored", "value"),
    [*itertools.product(["float64", "float32"], [np.nan, np.inf, -np.inf, 1e31]), ("float32", SIGNALING_NAN)],
)
def test_number_that_is_no_voltage_is_lost(tmp_path: Path, stored: str, value: float) -> None:
    volts = random_volts(3 * FLUSH_LENGTH).astype(stored)
    volts[1, 2000:2010] = value
    path = write_recording(tmp_path / "a.mcap", volts, make_scene(recording={"samples": stored}))
    with daq.open(path) as recording:
        assert np.flatnonzero(np.isnan(recording.read("body2"))).tolist() == [*range(2000, 2010)]
        with pytest.warns(RunWarning, match="10 samples are not valid readings, the first is sample 2000 of body2"):
            (gap,) = recording.gaps
        assert (gap.first_sample, gap.last_sample, gap.channels) == (2000, 2009, ("body2",))
        with pytest.raises(RecordingError, match="samples 2000 to 2009 of body2"):
            recording.check()


@pytest.mark.parametrize(("volts", "is_measured"), [(1e4, False), (4e3, True)])
def test_voltage_far_above_the_range_is_lost(tmp_path: Path, volts: float, is_measured: bool) -> None:
    samples, channels = random_volts(3 * FLUSH_LENGTH), [replace(info, range=5.0) for info in two_channels()]
    samples[1, 2000] = -volts
    with recorder.Recorder(tmp_path / "a.mcap", make_scene(), channels, RATE) as new:
        new.write(samples)
    with daq.open(tmp_path / "a.mcap") as recording:
        assert np.isfinite(recording.read("body2")[2000]) == is_measured
        with nullcontext() if is_measured else pytest.raises(RecordingError, match="samples 2000 to 2000 of body2"):
            recording.check()


def test_relabelled_sample_type_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "block_schema", lambda _: block_schema("shotrig.BlockFloat32"))
    counts = np.arange(2 * FLUSH_LENGTH, dtype=np.int32).reshape(2, -1)
    path = write_recording(tmp_path / "a.mcap", counts, make_scene(**CONVERTER_24_BIT))
    with pytest.raises(RecordingError, match="samples of type 'counts', the schema 'float32'"):
        daq.open(path)


def test_recovery_of_shifted_samples_is_complete(intact_file: Path, tmp_path: Path) -> None:
    daq.recover(rewrite(intact_file, shift=2**40), tmp_path / "fixed.mcap")
    with daq.open(tmp_path / "fixed.mcap") as recording:
        recording.check()


def test_body_that_the_scene_lacks_is_reported(tmp_path: Path) -> None:
    scene = make_scene(structure={"masses": ["1 kg"], "springs": ["10 kN/m"]}, shaker=None, test=None, channels=None)
    path = write_recording(tmp_path / "a.mcap", random_volts(FLUSH_LENGTH), scene)
    with daq.open(path) as recording, pytest.raises(RecordingError, match=r"channel body2 is at body 2, .* is body 1"):
        _ = recording.scene
