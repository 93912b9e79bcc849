"""Encoding of a recording: times, sample blocks, display messages, markers and events."""

import json
import struct

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode

from daq.core.mcap_file.protobuf import message_class, varint
from daq.core.recording.display import FLOAT_SCHEMA, encode_floats, encode_text
from daq.core.recording.layout import Timebase, block_length, flush_length
from daq.core.recording.markers import MARKER_SCHEMA, Marker, event_from_json, event_schema, event_to_json
from daq.core.recording.robot_description import TRANSFORMS_SCHEMA
from daq.core.recording.sample_block import (
    _HEADER,
    SAMPLE_TYPE,
    SCHEMAS,
    _size_prefix,
    block_schema,
    decode,
    decode_contiguous,
    encode,
)
from rig.core.base.errors import RecordingError


@pytest.mark.parametrize("rate", [1.0, 256.0, 5120.0, 51200.0 / 7, 51200.0, 1e6])
def test_blocks_have_about_a_tenth_of_a_second(rate):
    block, flush = block_length(rate), flush_length(rate)
    # The nearest power of two differs by a factor of up to 2^0.5.
    assert block == 256 or 0.07 < block / rate < 0.15
    assert flush % block == 0
    assert flush == block or 0.4 < flush / rate < 0.6


@given(sample=st.integers(0, 2**50), rate=st.sampled_from([5120.0, 51200.0 / 31, 51200.0, 44100.0]))
def test_sample_number_follows_from_its_time(sample, rate):
    clock = Timebase(rate, start_ns=1_700_000_000_000_000_000)
    time = clock.time_ns(sample)
    if time < 2**64:
        assert clock.times_ns([sample, 0]).tolist() == [time, clock.start_ns]
    # Half a nanosecond of rounding, and the rounding of the products in double precision.
    assert abs((time - clock.start_ns) * rate - sample * 1e9) <= 0.51 * rate + sample * 1e9 * 1e-15
    if time < 2**64 and sample < 2**42:
        assert clock.samples_at(np.array([time], np.uint64))[0] == sample


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_rate_is_rejected(rate):
    with pytest.raises(RecordingError, match="positive"):
        Timebase(rate)


# Around the sizes from which the encoded size has another byte: 2^7, 2^14 and 2^21.
@given(count=st.one_of(st.integers(0, 300), st.integers(2**14 - 9, 2**14 + 9), st.integers(2**21 - 9, 2**21 + 9)))
def test_size_prefix_follows_from_message_length(count):
    size = varint(count)
    assert _size_prefix(_HEADER.size + len(size) + count) == size


@pytest.mark.parametrize("schema", SAMPLE_TYPE)
@given(first=st.integers(0, 2**63 - 1), count=st.integers(0, 3000))
def test_blocks_agree_with_protobuf(schema, first, count):
    samples = (np.arange(count) * 7 - 3).astype(SAMPLE_TYPE[schema])
    clock = Timebase(5120.0)
    message = message_class(block_schema(schema).data, schema)()
    if clock.time_ns(first) < 2**63:
        data = encode(clock, first, samples[None, None]).tobytes()
        message.ParseFromString(data)
        assert (message.t0_ns, message.first_sample) == (clock.time_ns(first), first)
        assert message.sample_rate_hz == 5120.0
        assert np.array_equal(message.samples, samples)
        block = decode(memoryview(data), schema)
        assert block.samples.size == 0 or np.shares_memory(block.samples, np.frombuffer(data, np.uint8))
        assert (block.t0_ns, block.first_sample, block.rate) == (clock.time_ns(first), first, 5120.0)
        assert np.array_equal(block.samples, samples)


@pytest.mark.parametrize("schema", SAMPLE_TYPE)
def test_block_with_omitted_zero_fields_is_decoded(schema):
    message = message_class(block_schema(schema).data, schema)(sample_rate_hz=100.0, samples=[1, 2, 3])
    block = decode(memoryview(message.SerializeToString()), schema)
    assert (block.t0_ns, block.first_sample, block.rate, block.stop) == (0, 0, 100.0, 3)
    assert block.samples.tolist() == [1, 2, 3]


def message_records(clock, first, channel=2):
    """Return the records of a chunk with a block of three samples at each of the sample indices `first`."""
    records = b""
    for number in first:
        block = encode(clock, number, np.arange(3.0)[None, None] + number).tobytes()
        head = struct.pack("<HIQQ", channel, 0, clock.time_ns(number + 3), clock.time_ns(number))
        records += struct.pack("<BQ", Opcode.MESSAGE, len(head) + len(block)) + head + block
    return records


def test_only_contiguous_blocks_are_decoded_together():
    schema, clock, late_clock = "shotrig.BlockFloat64", Timebase(5120.0, 10), Timebase(5120.0, 10**9)
    records = message_records(clock, [6, 9, 12])
    block = decode_contiguous(memoryview(records), 2, schema, clock)
    assert block[:3] == (clock.time_ns(6), 6, 5120.0) and block.samples.tolist() == [*range(6, 15)]
    assert not np.shares_memory(block.samples, np.frombuffer(records, np.uint8))
    others = [
        message_records(clock, [6, 10]),
        message_records(clock, [6]) + message_records(clock, [9], channel=3),
        message_records(clock, [6]) + message_records(Timebase(5121.0, 10), [9]),
        message_records(clock, [6]) + message_records(late_clock, [9]),
        records[:-8],
        records[:8],
        b"",
    ]
    for other in others:
        assert decode_contiguous(memoryview(other), 2, schema, clock) is None
    # Opcode, length and channel of the record; tags, sample index, rate and size of the block.
    for position in [*range(11), 31, *range(40, 60)]:
        damaged = bytearray(records)
        damaged[position] ^= 0xFF
        assert decode_contiguous(memoryview(damaged), 2, schema, clock) is None


@given(data=st.binary(max_size=80))
def test_random_bytes_decode_or_are_rejected(data):
    try:
        decode(memoryview(data), "shotrig.BlockFloat64")
    except RecordingError as error:
        assert "shotrig.BlockFloat64" in str(error)


@pytest.mark.parametrize("tag", [0, 9, 18, 27])
def test_wrong_tag_decodes_as_protobuf_does(tag):
    schema = "shotrig.BlockFloat64"
    data = bytearray(encode(Timebase(5120.0), 512, np.arange(1.0, 5.0)[None, None]).tobytes())
    for byte in range(256):
        data[tag] = byte
        message = message_class(block_schema(schema).data, schema)()
        try:
            message.ParseFromString(bytes(data))
        except DecodeError:
            with pytest.raises(RecordingError, match=schema):
                decode(memoryview(data), schema)
        else:
            block = decode(memoryview(data), schema)
            fields = (message.t0_ns, message.first_sample, message.sample_rate_hz)
            assert (block.t0_ns, block.first_sample, block.rate) == fields
            assert block.samples.tolist() == list(message.samples)


def test_block_cut_within_a_sample_is_rejected():
    data = encode(Timebase(5120.0), 0, np.arange(4.0)[None, None]).tobytes()
    # The size of the samples follows the header. A sample has eight bytes.
    cut = data[: _HEADER.size] + bytes([7]) + data[_HEADER.size + 1 :][:7]
    with pytest.raises(RecordingError, match="7 bytes are not a whole number of samples"):
        decode(memoryview(cut), "shotrig.BlockFloat64")


@pytest.mark.parametrize("schema", [*(block_schema(name) for name, _, _ in SCHEMAS.values()), TRANSFORMS_SCHEMA])
def test_protobuf_schema_describes_its_message(schema):
    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data).file
    names = {file.name for file in files}
    assert all(set(file.dependency) <= names for file in files)
    assert schema.name in {f"{file.package}.{message.name}" for file in files for message in file.message_type}
    # One plotting program takes a field of this name for its time axis, and reads it as a double.
    assert all(f.name != "timestamp" for file in files for m in file.message_type if "Block" in m.name for f in m.field)


def test_number_is_encoded_as_ros_expects():
    data = encode_floats(np.array([[0.0, 1.0], [-2.5, 3.0]]))[1, 0].tobytes()
    assert data[:4] == b"\x00\x01\x00\x00"
    assert struct.unpack_from("<III", data, 4) == (0, 0, 1)
    # Eight-byte numbers are aligned relative to the end of the four-byte header.
    assert struct.unpack_from("<d", data, 4 + 16) == (-2.5,)
    assert FLOAT_SCHEMA.data.count(b"MSG: ") == 2


def test_cdr_text_length_counts_the_closing_zero():
    assert encode_text("ü")[4:] == struct.pack("<I", 3) + "ü".encode() + b"\0"


def test_marker_with_numpy_fields_survives_json():
    marker = Marker("measure", 5, 9, {"force": np.float64(2.6), "levels": np.array([1.0, 2.0])})
    decoded = Marker.from_json(memoryview(marker.to_json()))
    assert (decoded.kind, decoded.first_sample, decoded.last_sample, decoded.end) == ("measure", 5, 9, 9)
    assert decoded.fields == {"force": 2.6, "levels": [1.0, 2.0]}


def test_unsupported_marker_field_is_rejected():
    with pytest.raises(ValueError, match="JSON"):
        Marker("hit", 0, fields={"peak": float("nan")}).to_json()
    with pytest.raises(TypeError, match="marker"):
        Marker("hit", 0, fields={"peak": object()}).to_json()


@pytest.mark.parametrize(
    "data",
    [b"", b"[]", b"{}", b"nonsense", b'{"kind":"a","first_sample":-1}', b'{"kind":"a","first_sample":true}',
     b'{"kind":"a","first_sample":5,"last_sample":4}', b"[" * 100_000, b'{"kind":1,"first_sample":0}'],
)  # fmt: skip
def test_malformed_marker_is_rejected(data):
    with pytest.raises(RecordingError, match="/markers"):
        Marker.from_json(memoryview(data))


def test_event_survives_json_exactly():
    time = 0.1 + 0.2
    assert event_from_json(memoryview(event_to_json(time, 2, "floor", 1e-17))) == (time, 2, "floor", 1e-17, 0)
    assert event_from_json(memoryview(event_to_json(time, 0, "touch", 0.5, 3))) == (time, 0, "touch", 0.5, 3)
    with pytest.raises(RecordingError, match="/truth/events"):
        event_from_json(memoryview(b'{"time":"x"}'))


def test_json_schemas_require_message_fields():
    assert json.loads(MARKER_SCHEMA.data)["required"] == ["kind", "first_sample", "last_sample"]
    assert json.loads(event_schema(has_friction=False).data)["required"] == ["time", "damper", "kind", "speed"]
    with_joints = json.loads(event_schema(has_friction=False, has_joints=True).data)
    assert with_joints["required"] == ["time", "kind", "speed"] and "joint" in with_joints["properties"]
