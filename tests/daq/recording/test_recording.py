import random
import struct
import tracemalloc
import zlib

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

import daq
from daq.recording.markers import Gap
from daq.recording.protobuf import message_class
from daq.recording.recorder import Recorder
from daq.recording.sample_block import block_schema
from daq.signal_chain.channel import ChannelInfo
from rig.errors import RecordingError, ShotrigError
from tests.daq.recording.recordings import BITS, DAMPERS, GROUP, RATE, channels, motion, scene, signal, write

SAMPLES = 3 * GROUP + 321


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "a.mcap"
    return write(path, signal(SAMPLES), scene(recording={"display": True, "truth": True}, **DAMPERS))


@pytest.fixture(scope="module")
def small_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("small") / "a.mcap"
    return write(path, signal(2 * GROUP), scene())


# -- samples ---------------------------------------------------------------------------------------------


@given(data=st.data())
def test_range_is_that_part_of_the_whole(recorded, data):
    start = data.draw(st.integers(0, SAMPLES))
    stop = data.draw(st.integers(start, SAMPLES))
    with daq.open(recorded) as recording:
        assert np.array_equal(recording.read("body2", start, stop), signal(SAMPLES)[1, start:stop] * (1 / 0.01))


def test_opened_recording_has_all_descriptions(recorded):
    with daq.open(str(recorded)) as recording:
        assert (recording.rate, recording.samples, recording.start_ns) == (RATE, SAMPLES, 0)
        assert list(recording.channels.values()) == channels()
        assert recording.scene == scene(recording={"display": True, "truth": True}, **DAMPERS)
        assert [(m.kind, m.first_sample, m.last_sample, m.fields) for m in recording.markers] == [
            ("measure", 100, 199, {"frequency": 13.5})
        ]
        assert recording.metadata["run"]["seed"] == "1"
        assert (recording.status, recording.gaps, recording.overloads) == ("complete", [], [])
        recording.check()


@pytest.mark.parametrize("stored", ["float64", "float32", "counts"])
def test_each_sample_type_keeps_its_precision(tmp_path, stored):
    volts = signal(700)
    counts = np.rint(volts * 2**23 / 5.0).astype(np.int32)
    stored_scene = scene(recording={"samples": stored}, **BITS)
    with daq.open(write(tmp_path / "a.mcap", counts, stored_scene)) as recording:
        got = recording.read("body1")
        assert recording.stored == stored
    exact = counts[0] * (10.0 / 2**24) / 500.0
    assert got == pytest.approx(exact, rel=1e-15 if stored != "float32" else 2**-24)


def test_truth_rows_are_points_and_dampers(recorded):
    expected = motion(0, SAMPLES, 1)
    with daq.open(recorded) as recording:
        assert recording.truth_points == ("body 1", "body 2", "body 3", "table")
        for quantity in ("displacement", "velocity", "acceleration", "gap", "contact"):
            got = recording.truth(quantity, 1000, 2500)
            assert np.array_equal(got, getattr(expected, quantity)[:, 1000:2500])
        assert np.array_equal(recording.events, expected.events)
        with pytest.raises(RecordingError, match=r"no true temperature\. Choose one of displacement"):
            recording.truth("temperature")


def test_pieces_of_any_size_make_the_whole(recorded):
    with daq.open(recorded) as recording:
        for size in (100, 1000, 10**6):
            pieces = list(recording.blocks(["body2", "body1"], size))
            assert [first for first, _ in pieces] == list(range(0, SAMPLES, size))
            joined = np.concatenate([samples for _, samples in pieces], axis=1)
            assert np.array_equal(joined[1], recording.read("body1"))
            assert np.array_equal(joined[0], recording.read("body2"))


def test_unacquired_samples_read_as_nan(tmp_path):
    samples = signal(5000)
    with Recorder(tmp_path / "a.mcap", scene(), channels(), RATE) as recorder:
        recorder.write(samples[:, :1234])
        recorder.gap(2000)
        recorder.write(samples[:, 3234:])
    with daq.open(tmp_path / "a.mcap") as recording:
        got = recording.read("body1")
        assert recording.gaps == [Gap(1234, 3233, ("body1", "body2"), "never acquired")]
        assert np.isnan(recording.read("body2", 2000, 2100)).all()
    assert np.isnan(got[1234:3234]).all()
    is_present = ~np.isnan(got)
    assert is_present.sum() == 3000
    assert np.array_equal(got[is_present], samples[0, is_present] * (1 / 500.0))


@pytest.mark.parametrize(("start", "stop"), [(-1, 5), (0, SAMPLES + 1), (10, 9)])
def test_missing_samples_error_states_the_range(recorded, start, stop):
    with daq.open(recorded) as recording, pytest.raises(RecordingError, match=f"a range from 0 to {SAMPLES - 1}"):
        recording.read("body1", start, stop)


def test_unknown_channel_error_lists_channels(recorded):
    with daq.open(recorded) as recording, pytest.raises(RecordingError, match="Choose one of body1, body2"):
        recording.read("body7")


def test_start_time_and_odd_rate_are_exact(tmp_path):
    rate, start = 51200.0 / 7, 1_763_000_000_123_456_789
    info = [ChannelInfo("a", "table", "velocity", 1.0, rate)]
    with Recorder(tmp_path / "a.mcap", scene(), info, rate, start_ns=start) as recorder:
        recorder.write(np.arange(50_000.0)[None])
    with daq.open(tmp_path / "a.mcap") as recording:
        assert (recording.rate, recording.start_ns) == (rate, start)
        assert np.array_equal(recording.read("a", 49_000, 49_010), np.arange(49_000.0, 49_010.0))


def test_recording_stopped_before_samples_is_empty(tmp_path):
    with Recorder(tmp_path / "a.mcap", scene(), channels(), RATE):
        pass
    with daq.open(tmp_path / "a.mcap") as recording:
        assert (recording.samples, recording.rate, recording.read("body1").size) == (0, RATE, 0)


def test_channel_reads_only_its_chunks(recorded, monkeypatch):
    with daq.open(recorded) as recording:
        container = recording._container
        read = []
        messages = container.messages
        monkeypatch.setattr(container, "messages", lambda number: read.append(number) or messages(number))
        recording.read("body1", GROUP + 10, GROUP + 20)
        recording.read("body1", GROUP + 20, 2 * GROUP)
        assert len(read) == 1


# -- files of other origin -------------------------------------------------------------------------------


def foreign(path, topics=("/raw/a", "/raw/b"), metadata=None, compression=CompressionType.LZ4, **options):
    """Written with the reference library and protobuf alone: blocks of 100, several channels in a chunk."""
    described = block_schema("shotrig.BlockFloat32")
    message_type = message_class(described.data, described.name)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=3000, compression=compression, **options)
        writer.start(profile="", library="another program")
        schema = writer.register_schema(described.name, "protobuf", described.data)
        ids = [
            writer.register_channel(topic, "protobuf", schema, {"unit": "m/s^2"} if metadata is None else metadata)
            for topic in topics
        ]
        for block in [*range(15), *range(20, 30)]:
            for row, number in enumerate(ids):
                samples = np.arange(block * 100, block * 100 + 100) + 0.25 * row
                t0 = 5_000_000 + block * 10**8
                message = message_type(t0_ns=t0, first_sample=block * 100, sample_rate_hz=1000.0, samples=samples)
                writer.add_message(number, t0 + 10**8, message.SerializeToString(), t0)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_plain_file_of_the_layout_reads_like_ours(tmp_path, compression):
    with daq.open(foreign(tmp_path / "f.mcap", compression=compression)) as recording:
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
        ({"use_chunking": False}, "no index"),
        ({"topics": ("/raw/a", "/raw/a")}, "two channels"),
    ],
)
def test_deviation_from_the_layout_is_located(tmp_path, changes, message):
    path = foreign(tmp_path / "f.mcap", **changes)
    with pytest.raises(RecordingError, match=message):
        daq.open(path).read("a")


# -- damage ----------------------------------------------------------------------------------------------


def test_bit_flips_are_never_read_as_samples(small_file, tmp_path):
    content, true = small_file.read_bytes(), signal(2 * GROUP)
    scales = {"body1": 1 / 500.0, "body2": 1 / 0.01}
    rng, path, refused = random.Random(7), tmp_path / "flipped.mcap", 0
    for _ in range(100):
        data = bytearray(content)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        try:
            with daq.open(path) as recording:
                assert recording.scene == scene()
                assert recording.metadata["run"]["seed"] == "1"
                assert [marker.first_sample for marker in recording.markers] == [100]
                for row, (name, scale) in enumerate(scales.items()):
                    assert recording.channels[name] == channels()[row]
                    assert np.array_equal(recording.read(name), true[row] * scale)
        except RecordingError as error:
            refused += 1
            assert str(path) in str(error)
    assert refused > 90


def test_damaged_metadata_record_is_not_used(small_file, tmp_path):
    data = small_file.read_bytes()
    place = data.index(b"\x07\0\0\0rate_hz") + 15
    path = tmp_path / "a.mcap"
    path.write_bytes(data[:place] + b"9" + data[place + 1 :])
    with daq.open(path) as recording, pytest.raises(RecordingError, match="metadata 'daq'"):
        _ = recording.metadata


@pytest.mark.parametrize("cut", [1, 8, 30, 5000, 30_000])
def test_file_without_end_names_the_remedy(small_file, tmp_path, cut):
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
def test_file_that_is_no_recording_is_rejected(tmp_path, content, message):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        daq.open(path)


def test_missing_file_or_folder_is_rejected(tmp_path):
    with pytest.raises(RecordingError, match="No such file"):
        daq.open(tmp_path / "none.mcap")
    with pytest.raises(RecordingError, match="not a file"):
        daq.open(tmp_path)


# -- hostile files ---------------------------------------------------------------------------------------

MAGIC = b"\x89MCAP0\r\n"


def record(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value):
    return struct.pack("<I", len(value)) + value


def hostile(path, data, chunk_indexes=b"", extra=b""):
    """A file whose end is right in every checksum, whatever is in it."""
    described = block_schema("shotrig.BlockFloat64")
    schema = record(3, struct.pack("<H", 1) + text(described.name.encode()) + text(b"protobuf") + text(described.data))
    metadata = text(b"unit") + text(b"m") + text(b"rate") + text(b"100.0") + text(b"start_ns") + text(b"0")
    channel = record(4, struct.pack("<HH", 1, 1) + text(b"/raw/a") + text(b"protobuf") + text(metadata))
    body = MAGIC + record(1, text(b"") + text(b"evil")) + data + record(15, struct.pack("<I", 0))
    end = schema + channel + chunk_indexes + extra
    footer = struct.pack("<BQQQ", 2, 20, len(body), 0)
    path.write_bytes(body + end + footer + struct.pack("<I", zlib.crc32(footer, zlib.crc32(end))) + MAGIC)
    return path


def chunk(compression, packed, size, crc=0):
    head = struct.pack("<QQQI", 0, 10**9, size, crc)
    return record(6, head + text(compression) + struct.pack("<Q", len(packed)) + packed)


def holding(path, inside, end):
    """A file with one chunk of these messages, in the topic /raw/a up to a time."""
    data = chunk(b"", inside, len(inside), zlib.crc32(inside))
    return hostile(path, data, chunk_index(DATA_BEGINS, len(data), len(inside), end))


def chunk_index(offset, length, size, end=10**9, offsets=10):
    message_offsets = struct.pack("<HQ", 1, 0)
    head = struct.pack("<QQQQI", 0, end, offset, length, offsets)
    return record(8, head + message_offsets + struct.pack("<Q", 0) + text(b"zstd") + struct.pack("<QQ", 0, size))


DATA_BEGINS = len(MAGIC) + 9 + 4 + 4 + 4
BOMB = 1 << 30


def bombs():
    """A gigabyte of zeros, packed so that nothing or a lie is said of its size."""
    unsized = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    zeros = bytes(1 << 20)
    zstd = b"".join(unsized.compress(zeros) for _ in range(BOMB >> 20)) + unsized.flush()
    packer = lz4.frame.LZ4FrameCompressor()
    lz = packer.begin() + b"".join(packer.compress(zeros) for _ in range(BOMB >> 20)) + packer.flush()
    return {"zstd": zstd, "lz4": lz}


@pytest.fixture(scope="module")
def packed_bombs():
    return bombs()


@pytest.fixture
def little_memory():
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6


@pytest.mark.parametrize("claimed", [1000, BOMB, 2**63])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_zip_bomb_is_rejected_in_little_memory(tmp_path, packed_bombs, compression, claimed, little_memory):
    data = chunk(compression.encode(), packed_bombs[compression], claimed)
    path = hostile(tmp_path / "bomb.mcap", data, chunk_index(DATA_BEGINS, len(data), claimed))
    with pytest.raises(RecordingError, match=r"bomb\.mcap: the file is damaged: the chunk .*(unpack|claims)"):
        daq.open(path)


@pytest.mark.parametrize(
    "index",
    [
        chunk_index(DATA_BEGINS, 2**63, 100),
        chunk_index(2**64 - 1, 2**64 - 1, 100),
        chunk_index(DATA_BEGINS, 100, 100, offsets=2**31),
        chunk_index(DATA_BEGINS, 100, 100, offsets=7),
        record(8, b""),
        record(8, b"x" * 70),
        struct.pack("<BQ", 8, 2**62),
        struct.pack("<BQ", 5, 2**64 - 1),
        record(4, struct.pack("<HH", 2, 1) + struct.pack("<I", 2**32 - 1)),
        record(3, struct.pack("<H", 0) + text(b"") * 3),
        record(11, b""),
        chunk_index(DATA_BEGINS, 9, 100),
        chunk_index(0, 50, 100),
    ],
)
def test_absurd_lengths_are_rejected(tmp_path, index, little_memory):
    path = hostile(tmp_path / "absurd.mcap", chunk(b"", b"", 0), index)
    with pytest.raises(RecordingError, match=r"absurd\.mcap: the file is damaged"):
        daq.open(path)


def block_message(first, samples, rate=100.0, log_time=None):
    described = block_schema("shotrig.BlockFloat64")
    message_type = message_class(described.data, described.name)
    t0 = int(first * 1e9 / rate) % 2**63
    data = message_type(t0_ns=t0, first_sample=first, sample_rate_hz=rate, samples=samples).SerializeToString()
    end = int((first + len(samples)) * 1e9 / rate) % 2**63 if log_time is None else log_time
    return record(5, struct.pack("<HIQQ", 1, 0, end, t0) + data), end


def test_distant_block_does_not_exhaust_memory(tmp_path, little_memory):
    message, end = block_message(2**33, [1.0, 2.0])
    path = holding(tmp_path / "far.mcap", message, end)
    with daq.open(path) as recording:
        assert recording.samples == 2**33 + 2
        assert recording.read("a", 2**33 - 1, 2**33 + 2)[1:].tolist() == [1.0, 2.0]
        n_samples = len(message) // 4
        with pytest.raises(RecordingError, match=rf"samples 0 to {2**33 + 1}: at most {n_samples} of them"):
            recording.read("a")


@pytest.mark.parametrize("large", [1 << 22, 0])
def test_large_range_needs_a_sixteenth_of_samples(tmp_path, monkeypatch, large):
    message, end = block_message(10**9, [1.0, 2.0])
    path = holding(tmp_path / "far.mcap", message, end)
    monkeypatch.setattr("daq.recording.channel_series.LARGE_RANGE", large) if not large else None
    most = large or len(message) // 4 * 16
    with daq.open(path) as recording:
        assert np.isnan(recording.read("a", 0, most)).all()
        with pytest.raises(RecordingError, match="of them are in the file"):
            recording.read("a", 0, most + 1)


@pytest.mark.parametrize("late_ns", [-5_100_000, -4_900_000, 4_900_000, 5_100_000])
def test_block_logged_half_a_sample_late_is_rejected(tmp_path, late_ns):
    message, end = block_message(5, [1.0, 2.0], log_time=70_000_000 + late_ns)
    path = holding(tmp_path / "late.mcap", message, end)
    if abs(late_ns) < 5_000_000:
        assert daq.open(path).read("a", 5, 7).tolist() == [1.0, 2.0]
        return
    with pytest.raises(
        RecordingError,
        match=f"/raw/a: the block at sample 5 states 100 Hz, a start at 50000000 ns and a log time of {end} ns; "
        "expected 100 Hz, 50000000 ns and 70000000 ns",
    ):
        daq.open(path).read("a", 5, 7)


@pytest.mark.parametrize("second", [0, 1])
def test_overlapping_blocks_are_rejected(tmp_path, second):
    first, _ = block_message(1, [1.0, 2.0])
    other, end = block_message(second, [3.0, 4.0])
    path = holding(tmp_path / "o.mcap", first + other, end)
    with pytest.raises(RecordingError, match=f"a block begins at sample {second}; expected 3 or later"):
        daq.open(path).read("a", 0, 2)


@pytest.mark.parametrize(
    "inside",
    [
        record(5, b"short"),
        struct.pack("<BQ", 5, 2**63),
        b"\x05\x00",
        record(5, struct.pack("<HIQQ", 1, 0, 0, 0) + b"x"),
    ],
)
def test_nonsense_with_right_checksum_is_rejected(tmp_path, inside):
    path = holding(tmp_path / "n.mcap", inside, 10**9)
    with pytest.raises(RecordingError, match=r"n\.mcap"):
        daq.open(path)


def test_attachment_named_like_a_path_touches_no_file(tmp_path):
    victim = tmp_path / "victim"
    name = f"../{tmp_path.name}/victim".encode()
    content = struct.pack("<QQ", 0, 0) + text(name) + text(b"text/plain") + struct.pack("<Q", 3) + b"bad"
    attachment = record(9, content + struct.pack("<I", zlib.crc32(content)))
    index = record(10, struct.pack("<QQQQQ", DATA_BEGINS, len(attachment), 0, 0, 3) + text(name) + text(b"text/plain"))
    message, end = block_message(0, [1.0])
    data = chunk(b"", message, len(message), zlib.crc32(message))
    where = chunk_index(DATA_BEGINS + len(attachment), len(data), len(message), end)
    path = hostile(tmp_path / "a.mcap", attachment + data, where, index)
    with daq.open(path) as recording:
        assert recording.read("a").tolist() == [1.0]
        with pytest.raises(RecordingError, match="the times of a chunk"):
            recording.check()
        with pytest.raises(RecordingError, match="scene"):
            _ = recording.scene
    daq.recover(path, tmp_path / "fixed.mcap")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.mcap", "fixed.mcap"]
    assert not victim.exists()


@given(data=st.binary(max_size=300))
def test_random_summary_is_rejected_or_empty(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("fuzz") / "a.mcap"
    hostile(path, data, data)
    try:
        assert daq.open(path).read("a").size == 0
    except ShotrigError as error:
        assert str(path) in str(error)
