"""Metadata of a file is validated when it is read: a malicious file causes an error message at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import daq
from daq.mcap_file.chunk import Damage, messages_in, unpack_chunk
from daq.mcap_file.reader import Container
from daq.mcap_file.writer import ChunkedFile, Message
from daq.recording.layout import Timebase
from daq.recording.markers import Marker, event_from_json
from daq.recording.sample_block import decode, encode
from daq.signal_chain.channel import ChannelInfo
from daq.viewing.description import describe
from rig.errors import RecordingError, add_path
from rig.escaping import is_single_line
from tests.daq.recording.recordings import GROUP, signal, write

ODD = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.just(10**300) | st.text() | st.just("x" * 60_000),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
SOUND = ChannelInfo("body1", "body 1", "acceleration", 0.01, 5120.0, poles=(-1 + 2j,), delay=1e-3).to_metadata()


@given(st.sampled_from(sorted(SOUND)), ODD)
def test_odd_channel_metadata_is_sound_or_rejected(key: str, odd: Any) -> None:
    try:
        info = ChannelInfo.from_metadata(SOUND | {key: json.dumps(odd)})
    except RecordingError as error:
        assert len(str(error)) < 400
        return
    answer = info.response(np.array([0.0, 1.0, 1e3]))
    assert answer.shape == (3,) and info.unit_per_count != 0.0 and is_single_line(info.name)


@given(st.sampled_from(["kind", "first_sample", "last_sample", "frequency", "settled", "channels", "lines"]), ODD)
def test_odd_marker_is_sound_or_rejected(key: str, odd: Any) -> None:
    sound = {"kind": "measure", "first_sample": 1, "last_sample": 2, "frequency": 20.0, "settled": True}
    try:
        marker = Marker.from_json(memoryview(json.dumps(sound | {key: odd}).encode()))
    except RecordingError as error:
        assert len(str(error)) < 400
        return
    assert 0 <= marker.first_sample <= marker.end < 2**54
    assert float(marker.fields["frequency"]) > 0.0 and isinstance(marker.fields["settled"], bool)
    with pytest.raises(RecordingError, match="lacks the field duration"):
        marker.fields["duration"]


@given(st.sampled_from(["time", "damper", "kind", "speed"]), ODD)
def test_odd_change_of_contact_is_sound_or_rejected(key: str, odd: Any) -> None:
    event = {"time": 0.1, "damper": 1, "kind": "floor", "speed": 0.2} | {key: odd}
    try:
        time, damper, kind, speed = event_from_json(memoryview(json.dumps(event).encode()))
    except RecordingError:
        return
    assert np.isfinite([time, speed]).all() and damper >= 1 and kind in ("separation", "floor", "ceiling")


def rewritten(path: Path, checksums: bool = True, shift: int = 0) -> Path:
    """Copy a recording; without checksums of its chunks, or with its last half moved by `shift` samples."""
    target = path.with_name("rewritten.mcap")
    with Container(path) as container, target.open("wb") as file:
        copy, summary = ChunkedFile(file, "test", "zstd"), container.summary
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
            copy.add_chunk(messages)
        copy.finish()
    if not checksums:
        content = bytearray(target.read_bytes())
        with Container(target) as container:
            for offset in container.summary.offsets:
                # Opcode, length, two times and the size stand before it.
                content[int(offset) + 33 : int(offset) + 37] = bytes(4)
        target.write_bytes(content)
    return target


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("sound") / "a.mcap", signal(4 * GROUP))


def test_our_layout_requires_checksums(sound: Path) -> None:
    with daq.open(rewritten(sound)) as recording:
        assert np.isfinite(recording.read("body1")).all()
    with pytest.raises(RecordingError, match="no checksum"), daq.open(rewritten(sound, checksums=False)) as recording:
        recording.read("body1")


@pytest.mark.parametrize("shift", [2**27, 2**40])
def test_void_is_reported_at_once(sound: Path, shift: int) -> None:
    with daq.open(rewritten(sound, shift=shift)) as recording:
        assert np.isfinite(recording.read("body1", 0, GROUP)).all()
        for act in (lambda: recording.read("body1"), lambda: list(recording.blocks())):
            with pytest.raises(RecordingError, match="of them are in the file"):
                act()
        assert any("lost" in line and "of them are in the file" in line for line in describe(recording))


@pytest.mark.parametrize("shift", [1, 2**27, 2**40])
def test_unmarked_missing_samples_are_reported(sound: Path, shift: int) -> None:
    with daq.open(rewritten(sound, shift=shift)) as recording:
        first, stop = 3 * GROUP, 3 * GROUP + shift
        with pytest.raises(
            RecordingError, match=f"samples {first} to {stop - 1} of body1 are missing without a marker"
        ):
            recording.check()


def test_chunk_that_packs_too_well_is_rejected() -> None:
    import struct

    records = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0) * 2000
    with pytest.raises(Damage, match="more than"):
        messages_in(memoryview(records), stored=100)
    with pytest.raises(Damage, match="does not belong in a chunk"):
        messages_in(memoryview(struct.pack("<BQ", 0xEE, 0)), stored=100)
    huge = struct.pack("<QQQII", 0, 0, 1 << 25, 0, 4) + b"zstd" + struct.pack("<Q", 8) + bytes(8)
    with pytest.raises(Damage, match="claims to unpack"):
        unpack_chunk(memoryview(huge))


@pytest.mark.parametrize("said", ["a message is no marker", "r.mcap is damaged"])
def test_nested_error_names_the_file_once(said: str) -> None:
    path = Path("r.mcap")
    with pytest.raises(RecordingError) as reported, add_path(path), add_path(path):
        raise RecordingError(said)
    assert str(reported.value).count("r.mcap") == 1 and str(reported.value).endswith(said)
