"""Recordings are read exactly; files of other programs, damaged and malicious files are read or rejected."""

import random
import struct
import tracemalloc
import zlib

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

import daq
from daq.core.mcap_file.chunk import MAGIC
from daq.core.mcap_file.protobuf import message_class
from daq.core.recording.markers import Gap
from daq.core.recording.recorder import Recorder
from daq.core.recording.sample_block import block_schema
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RecordingError, ShotrigError
from tests.daq.mcap_file.mcap_records import DATA_END, attachment, beginning, chunk, packed_chunk, record, text
from tests.daq.recording.recordings import (
    CONVERTER_24_BIT,
    DISPLAY_AND_TRUTH,
    FLUSH_LENGTH,
    ONE_DAMPER,
    RATE,
    VOLTS_PER_ACCELERATION,
    VOLTS_PER_METER,
    make_scene,
    random_volts,
    true_motion,
    two_channels,
    write_recording,
)

# The recorder writes blocks of samples to the disk in groups of FLUSH_LENGTH samples; the last group is incomplete.
SAMPLES = 3 * FLUSH_LENGTH + 321
UNITS_PER_VOLT = {"body1": 1 / VOLTS_PER_METER, "body2": 1 / VOLTS_PER_ACCELERATION}
SCENE = make_scene(recording=DISPLAY_AND_TRUTH, **ONE_DAMPER)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "a.mcap"
    return write_recording(path, random_volts(SAMPLES), SCENE)


@pytest.fixture(scope="module")
def small_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("small") / "a.mcap"
    return write_recording(path, random_volts(2 * FLUSH_LENGTH), make_scene())


# -- samples ---------------------------------------------------------------------------------------------


@settings(max_examples=30)
@given(data=st.data())
def test_range_is_part_of_all_samples(recorded, data):
    start = data.draw(st.integers(0, SAMPLES))
    stop = data.draw(st.integers(start, SAMPLES))
    with daq.open(recorded) as recording:
        assert np.array_equal(
            recording.read("body2", start, stop), random_volts(SAMPLES)[1, start:stop] * UNITS_PER_VOLT["body2"]
        )


def test_opened_recording_has_all_descriptions(recorded):
    with daq.open(str(recorded)) as recording:
        assert (recording.rate, recording.samples, recording.start_ns) == (RATE, SAMPLES, 0)
        assert list(recording.channels.values()) == two_channels()
        assert recording.scene == SCENE
        assert [(m.kind, m.first_sample, m.last_sample, m.fields) for m in recording.markers] == [
            ("measure", 100, 199, {"frequency": 13.5})
        ]
        assert recording.metadata["run"]["seed"] == "1"
        assert (recording.status, recording.gaps, recording.overloads) == ("complete", [], [])
        recording.check()


@pytest.mark.parametrize("stored", ["float64", "float32", "counts"])
def test_each_sample_type_keeps_its_precision(tmp_path, stored):
    # The converter has 24 bits and a range of -5 to 5 V.
    counts = np.rint(random_volts(700) * 2**23 / 5.0).astype(np.int32)
    scene = make_scene(recording={"samples": stored}, **CONVERTER_24_BIT)
    with daq.open(write_recording(tmp_path / "a.mcap", counts, scene)) as recording:
        displacement = recording.read("body1")
        assert recording.stored == stored
    expected = counts[0] * (10.0 / 2**24) * UNITS_PER_VOLT["body1"]
    relative_precision = 2**-24 if stored == "float32" else 1e-15
    assert displacement == pytest.approx(expected, rel=relative_precision)


def test_truth_rows_are_points_and_dampers(recorded):
    expected = true_motion(0, SAMPLES, 1)
    with daq.open(recorded) as recording:
        assert recording.truth_points == ("body 1", "body 2", "body 3", "table")
        for quantity in ("displacement", "velocity", "acceleration", "gap", "contact"):
            values = recording.truth(quantity, 1000, 2500)
            assert np.array_equal(values, getattr(expected, quantity)[:, 1000:2500])
        assert np.array_equal(recording.events, expected.events)
        with pytest.raises(RecordingError, match=r"no true temperature\. Choose one of displacement"):
            recording.truth("temperature")


def test_joined_blocks_are_all_samples(recorded):
    with daq.open(recorded) as recording:
        for block_length in (100, 1000, 10**6):
            blocks = list(recording.blocks(["body2", "body1"], block_length))
            assert [first for first, _ in blocks] == list(range(0, SAMPLES, block_length))
            joined = np.concatenate([samples for _, samples in blocks], axis=1)
            assert np.array_equal(joined[1], recording.read("body1"))
            assert np.array_equal(joined[0], recording.read("body2"))


def test_unacquired_samples_read_as_nan(tmp_path):
    samples = random_volts(5000)
    with Recorder(tmp_path / "a.mcap", make_scene(), two_channels(), RATE) as recorder:
        recorder.write(samples[:, :1234])
        recorder.gap(2000)
        recorder.write(samples[:, 3234:])
    with daq.open(tmp_path / "a.mcap") as recording:
        displacement = recording.read("body1")
        assert recording.gaps == [Gap(1234, 3233, ("body1", "body2"), "never acquired")]
        assert np.isnan(recording.read("body2", 2000, 2100)).all()
    assert np.isnan(displacement[1234:3234]).all()
    is_present = ~np.isnan(displacement)
    assert is_present.sum() == 3000
    assert np.array_equal(displacement[is_present], samples[0, is_present] * UNITS_PER_VOLT["body1"])


@pytest.mark.parametrize(("start", "stop"), [(-1, 5), (0, SAMPLES + 1), (10, 9)])
def test_missing_samples_error_gives_the_range(recorded, start, stop):
    with daq.open(recorded) as recording, pytest.raises(RecordingError, match=f"a range from 0 to {SAMPLES - 1}"):
        recording.read("body1", start, stop)


def test_unknown_channel_error_lists_channels(recorded):
    with daq.open(recorded) as recording, pytest.raises(RecordingError, match="Choose one of body1, body2"):
        recording.read("body7")


def test_start_time_and_fractional_rate_are_exact(tmp_path):
    rate, start_ns = 51200.0 / 7, 1_763_000_000_123_456_789
    info = [ChannelInfo("a", "table", "velocity", 1.0, rate)]
    with Recorder(tmp_path / "a.mcap", make_scene(), info, rate, start_ns=start_ns) as recorder:
        recorder.write(np.arange(50_000.0)[None])
    with daq.open(tmp_path / "a.mcap") as recording:
        assert (recording.rate, recording.start_ns) == (rate, start_ns)
        assert np.array_equal(recording.read("a", 49_000, 49_010), np.arange(49_000.0, 49_010.0))


def test_recording_stopped_before_samples_is_empty(tmp_path):
    with Recorder(tmp_path / "a.mcap", make_scene(), two_channels(), RATE):
        pass
    with daq.open(tmp_path / "a.mcap") as recording:
        assert (recording.samples, recording.rate, recording.read("body1").size) == (0, RATE, 0)


def test_channel_reads_only_its_chunks(recorded, monkeypatch):
    with daq.open(recorded) as recording:
        container, read_chunks = recording._container, []
        read_records = container.records
        monkeypatch.setattr(container, "records", lambda chunk: read_chunks.append(chunk) or read_records(chunk))
        recording.read("body1", FLUSH_LENGTH + 10, FLUSH_LENGTH + 20)
        recording.read("body1", FLUSH_LENGTH + 20, 2 * FLUSH_LENGTH)
        assert len(read_chunks) == 1


# -- files of other programs -----------------------------------------------------------------------------


def write_foreign_file(path, topics=("/raw/a", "/raw/b"), metadata=None, compression=CompressionType.LZ4, **options):
    """Write blocks of 100 samples at 1000 Hz with the reference library and protobuf; return the path.

    Samples 1500 to 1999 are missing. In contrast to our files, a chunk contains several channels.
    """
    schema = block_schema("shotrig.BlockFloat32")
    message_type = message_class(schema.data, schema.name)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=3000, compression=compression, **options)
        writer.start(profile="", library="another program")
        schema_id = writer.register_schema(schema.name, "protobuf", schema.data)
        channel_ids = [
            writer.register_channel(topic, "protobuf", schema_id, {"unit": "m/s^2"} if metadata is None else metadata)
            for topic in topics
        ]
        for block in [*range(15), *range(20, 30)]:
            for row, channel_id in enumerate(channel_ids):
                samples = np.arange(block * 100, block * 100 + 100) + 0.25 * row
                t0_ns = 5_000_000 + block * 10**8
                message = message_type(t0_ns=t0_ns, first_sample=block * 100, sample_rate_hz=1000.0, samples=samples)
                writer.add_message(channel_id, t0_ns + 10**8, message.SerializeToString(), t0_ns)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_file_of_another_program_is_read(tmp_path, compression):
    with daq.open(write_foreign_file(tmp_path / "f.mcap", compression=compression)) as recording:
        assert (recording.rate, recording.start_ns, recording.samples) == (1000.0, 5_000_000, 3000)
        assert recording.channels["b"].quantity == "acceleration"
        expected = np.arange(3000) + 0.25
        expected[1500:2000] = np.nan
        assert np.array_equal(recording.read("b"), expected, equal_nan=True)
        assert np.array_equal(recording.read("b", 950, 1050), expected[950:1050])
        assert recording.gaps == [Gap(1500, 1999, (name,), "missing") for name in ("a", "b")]
        assert (recording.markers, recording.status, recording.metadata) == ([], "unknown", {})
        with pytest.raises(RecordingError, match="scene"):
            _ = recording.scene


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"topics": ("/elsewhere/a",)}, "no samples on topics /raw/"),
        ({"metadata": {"unit": "furlong"}}, "state no quantity"),
        ({"metadata": {"unit": "m", "scale": "big"}}, "scale = 'big'; expected a number"),
        ({"metadata": {"unit": "m", "gain": "[1]", "poles": "7"}}, "poles = 7; expected"),
        ({"metadata": {"unit": "m", "rate": "999", "start_ns": "0"}}, "expected 999 Hz"),
        ({"metadata": {"unit": "m", "rate": "x", "start_ns": "0"}}, "invalid sample clock"),
        ({"use_chunking": False}, "no chunk index"),
        ({"topics": ("/raw/a", "/raw/a")}, "two channels"),
    ],
)
def test_deviation_from_the_layout_is_reported(tmp_path, changes, message):
    path = write_foreign_file(tmp_path / "f.mcap", **changes)
    with pytest.raises(RecordingError, match=message):
        daq.open(path).read("a")


# -- damage ----------------------------------------------------------------------------------------------


def test_damaged_metadata_record_is_not_used(small_file, tmp_path):
    data = small_file.read_bytes()
    # The first digit of the rate follows the key and the four bytes of the value's length.
    position = data.index(b"\x07\0\0\0rate_hz") + 15
    path = tmp_path / "a.mcap"
    path.write_bytes(data[:position] + b"9" + data[position + 1 :])
    with daq.open(path) as recording, pytest.raises(RecordingError, match="metadata 'daq'"):
        _ = recording.metadata


@pytest.mark.parametrize("cut", [1, 8, 30, 5000, 30_000])
def test_error_of_file_without_end_names_remedy(small_file, tmp_path, cut):
    path = tmp_path / "torn.mcap"
    path.write_bytes(small_file.read_bytes()[:-cut])
    with pytest.raises(RecordingError, match=r"torn\.mcap: the file was not closed properly.*daq recover"):
        daq.open(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"hello", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "not closed properly"),
        (b"\x89MCAP0\r\n" * 9, "not closed properly"),
        (bytes(random.Random(1).randbytes(100_000)), "not an MCAP file"),
    ],
)
def test_file_of_another_kind_is_rejected(tmp_path, content, message):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        daq.open(path)


def test_scene_as_recording_names_record_command(tmp_path):
    path = tmp_path / "two.yaml"
    path.write_text("name: two\n")
    with pytest.raises(RecordingError, match=r"A scene must be recorded first: `daq record .*two\.yaml`"):
        daq.open(path)


def test_missing_file_or_folder_is_rejected(tmp_path):
    with pytest.raises(RecordingError, match="No such file"):
        daq.open(tmp_path / "none.mcap")
    with pytest.raises(RecordingError, match="not a file"):
        daq.open(tmp_path)


# -- malicious files: the checksums are correct, but the content is not ---------------------------------------

BEGINNING = beginning(b"evil")


def write_malicious_file(path, data, chunk_indexes=b"", attachment_index=b""):
    """Write these data and index records as a file whose summary checksum is correct; return the path."""
    block = block_schema("shotrig.BlockFloat64")
    schema_fields = struct.pack("<H", 1) + text(block.name.encode()) + text(b"protobuf") + text(block.data)
    metadata = text(b"unit") + text(b"m") + text(b"rate") + text(b"100.0") + text(b"start_ns") + text(b"0")
    channel_fields = struct.pack("<HH", 1, 1) + text(b"/raw/a") + text(b"protobuf") + text(metadata)
    schema, channel = record(Opcode.SCHEMA, schema_fields), record(Opcode.CHANNEL, channel_fields)
    data_section = BEGINNING + data + DATA_END
    summary = schema + channel + chunk_indexes + attachment_index
    footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, len(data_section), 0)
    checksum = struct.pack("<I", zlib.crc32(footer, zlib.crc32(summary)))
    path.write_bytes(data_section + summary + footer + checksum + MAGIC)
    return path


def write_messages(path, messages, end_ns):
    """Write a file with one chunk of messages on the topic /raw/a, the last logged at `end_ns`; return the path."""
    data = record(Opcode.CHUNK, chunk(b"", messages))
    return write_malicious_file(path, data, chunk_index(len(BEGINNING), len(data), len(messages), end_ns))


def chunk_index(chunk_position, chunk_length, unpacked_size, end_ns=10**9, message_offsets_size=10):
    """Return the index record of a chunk with messages of one channel; all sizes are in bytes."""
    head = struct.pack("<QQQQI", 0, end_ns, chunk_position, chunk_length, message_offsets_size)
    message_offsets, message_index_size = struct.pack("<HQ", 1, 0), struct.pack("<Q", 0)
    sizes = struct.pack("<QQ", 0, unpacked_size)
    return record(Opcode.CHUNK_INDEX, head + message_offsets + message_index_size + text(b"zstd") + sizes)


# A zip bomb is a small packed chunk that exhausts the memory when it is unpacked.
BOMB_SIZE = 1 << 30  # Unpacked, bytes.


@pytest.fixture(scope="module")
def packed_bombs():
    """Return a gigabyte of zeros as zstd and lz4 data that do not give their unpacked size."""
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    mebibyte, n_mebibytes = bytes(1 << 20), BOMB_SIZE >> 20
    zstd_data = b"".join(compressor.compress(mebibyte) for _ in range(n_mebibytes)) + compressor.flush()
    packer = lz4.frame.LZ4FrameCompressor()
    lz4_data = packer.begin() + b"".join(packer.compress(mebibyte) for _ in range(n_mebibytes)) + packer.flush()
    return {b"zstd": zstd_data, b"lz4": lz4_data}


@pytest.fixture
def limited_memory():
    """Fail the test if it allocates more than 200 MB."""
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6


@pytest.mark.parametrize("claimed", [1000, BOMB_SIZE, 2**63])
@pytest.mark.parametrize("compression", [b"zstd", b"lz4"])
def test_zip_bomb_is_rejected_in_little_memory(tmp_path, packed_bombs, compression, claimed, limited_memory):
    data = record(Opcode.CHUNK, packed_chunk(compression, packed_bombs[compression], claimed, checksum=0))
    path = write_malicious_file(tmp_path / "bomb.mcap", data, chunk_index(len(BEGINNING), len(data), claimed))
    with pytest.raises(RecordingError, match=r"bomb\.mcap: the file is damaged at byte \d+: the chunk .*decompress"):
        daq.open(path)


@pytest.mark.parametrize(
    "index",
    [
        chunk_index(len(BEGINNING), 2**63, 100),
        chunk_index(2**64 - 1, 2**64 - 1, 100),
        chunk_index(len(BEGINNING), 100, 100, message_offsets_size=2**31),
        chunk_index(len(BEGINNING), 100, 100, message_offsets_size=7),
        record(Opcode.CHUNK_INDEX, b""),
        record(Opcode.CHUNK_INDEX, b"x" * 70),
        struct.pack("<BQ", Opcode.CHUNK_INDEX, 2**62),
        struct.pack("<BQ", Opcode.MESSAGE, 2**64 - 1),
        record(Opcode.CHANNEL, struct.pack("<HH", 2, 1) + struct.pack("<I", 2**32 - 1)),
        record(Opcode.SCHEMA, struct.pack("<H", 0) + text(b"") * 3),
        record(Opcode.STATISTICS, b""),
        chunk_index(len(BEGINNING), 9, 100),
        chunk_index(0, 50, 100),
    ],
)
def test_excessive_lengths_are_rejected(tmp_path, index, limited_memory):
    path = write_malicious_file(tmp_path / "absurd.mcap", record(Opcode.CHUNK, chunk(b"", b"")), index)
    with pytest.raises(RecordingError, match=r"absurd\.mcap: the file is damaged"):
        daq.open(path)


def block_message(first, samples, log_time_ns=None):
    """Return the message of a block at 100 Hz and its log time: by default the end of the block, in ns."""
    schema = block_schema("shotrig.BlockFloat64")
    message_type = message_class(schema.data, schema.name)
    t0_ns = first * 10**7 % 2**63
    data = message_type(t0_ns=t0_ns, first_sample=first, sample_rate_hz=100.0, samples=samples).SerializeToString()
    end_ns = (first + len(samples)) * 10**7 % 2**63 if log_time_ns is None else log_time_ns
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, end_ns, t0_ns) + data), end_ns


def test_distant_block_does_not_exhaust_memory(tmp_path, limited_memory):
    message, end_ns = block_message(2**33, [1.0, 2.0])
    path = write_messages(tmp_path / "far.mcap", message, end_ns)
    with daq.open(path) as recording:
        assert recording.samples == 2**33 + 2
        assert recording.read("a", 2**33 - 1, 2**33 + 2)[1:].tolist() == [1.0, 2.0]
        n_samples = len(message) // 4  # Upper bound: the smallest sample type has four bytes.
        with pytest.raises(RecordingError, match=rf"samples 0 to {2**33 + 1}: at most {n_samples} of them"):
            recording.read("a")


@pytest.mark.parametrize("large_range", [1 << 22, 0])
def test_large_range_needs_a_sixteenth_of_samples(tmp_path, monkeypatch, large_range):
    """A range longer than `_LARGE_RANGE` is read only if the file may contain a sixteenth of its samples."""
    message, end_ns = block_message(10**9, [1.0, 2.0])
    path = write_messages(tmp_path / "far.mcap", message, end_ns)
    monkeypatch.setattr("daq.core.recording.channel_series._LARGE_RANGE", large_range)
    n_samples = len(message) // 4  # Upper bound: the smallest sample type has four bytes.
    longest_readable = large_range or n_samples * 16
    with daq.open(path) as recording:
        assert np.isnan(recording.read("a", 0, longest_readable)).all()
        with pytest.raises(RecordingError, match="of them are in the file"):
            recording.read("a", 0, longest_readable + 1)


@pytest.mark.parametrize("late_ns", [-5_100_000, -4_900_000, 4_900_000, 5_100_000])
def test_block_logged_half_a_sample_late_is_rejected(tmp_path, late_ns):
    # At 100 Hz, half a sample interval is 5 000 000 ns. Samples 5 and 6 end at 70 000 000 ns.
    message, end_ns = block_message(5, [1.0, 2.0], log_time_ns=70_000_000 + late_ns)
    path = write_messages(tmp_path / "late.mcap", message, end_ns)
    if abs(late_ns) < 5_000_000:
        assert daq.open(path).read("a", 5, 7).tolist() == [1.0, 2.0]
        return
    with pytest.raises(
        RecordingError,
        match=rf"/raw/a: the block that begins at sample 5 states the times 50000000 ns to {end_ns} ns; "
        "its sample numbers and the rate give 50000000 ns to 70000000 ns",
    ):
        daq.open(path).read("a", 5, 7)


@pytest.mark.parametrize("second_start", [0, 1])
def test_overlapping_blocks_are_rejected(tmp_path, second_start):
    first, _ = block_message(1, [1.0, 2.0])
    second, end_ns = block_message(second_start, [3.0, 4.0])
    path = write_messages(tmp_path / "o.mcap", first + second, end_ns)
    with pytest.raises(
        RecordingError,
        match=f"blocks overlap: a block begins at sample {second_start}, but the previous block ends at sample 3",
    ):
        daq.open(path).read("a", 0, 2)


@pytest.mark.parametrize(
    "messages",
    [
        record(Opcode.MESSAGE, b"short"),
        struct.pack("<BQ", Opcode.MESSAGE, 2**63),
        b"\x05\x00",
        record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, 0, 0) + b"x"),
    ],
)
def test_malformed_message_with_correct_checksum_is_rejected(tmp_path, messages):
    path = write_messages(tmp_path / "n.mcap", messages, 10**9)
    with pytest.raises(RecordingError, match=r"n\.mcap"):
        daq.open(path)


def test_attachment_named_like_a_path_touches_no_file(tmp_path):
    outside_file = tmp_path / "outside_file"
    name = f"../{tmp_path.name}/outside_file".encode()
    stored_attachment = record(Opcode.ATTACHMENT, attachment(name, b"bad"))
    position_and_sizes = struct.pack("<QQQQQ", len(BEGINNING), len(stored_attachment), 1, 2, len(b"bad"))
    attachment_index = record(Opcode.ATTACHMENT_INDEX, position_and_sizes + text(name) + text(b"text/plain"))
    message, end_ns = block_message(0, [1.0])
    data = record(Opcode.CHUNK, chunk(b"", message))
    index = chunk_index(len(BEGINNING) + len(stored_attachment), len(data), len(message), end_ns)
    path = write_malicious_file(tmp_path / "a.mcap", stored_attachment + data, index, attachment_index)
    with daq.open(path) as recording:
        assert recording.read("a").tolist() == [1.0]
        with pytest.raises(RecordingError, match="the times that the chunk states"):
            recording.check()
        with pytest.raises(RecordingError, match="scene"):
            _ = recording.scene
    daq.recover(path, tmp_path / "fixed.mcap")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.mcap", "fixed.mcap"]
    assert not outside_file.exists()


@given(data=st.binary(max_size=300))
def test_random_summary_is_rejected_or_empty(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("fuzz") / "a.mcap"
    write_malicious_file(path, data, data)
    try:
        assert daq.open(path).read("a").size == 0
    except ShotrigError as error:
        assert str(path) in str(error)
