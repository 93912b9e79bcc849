"""`daq recover` saves all intact samples of a damaged file, and lists all others as lost.

A chunk is the part of an MCAP file that is packed and has a checksum. Samples of one chunk are saved or lost together.
"""

import os
import random
import signal
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from typer.testing import CliRunner

import daq
from daq.commands.cli import app
from daq.core.recording.committed_file import CommittedFile
from daq.core.recording.recorder import Recorder
from daq.core.recording.recovery import _subtract
from daq.core.recording.sample_block import encode
from rig.core.base.errors import RecordingError, RunError, ShotrigError
from tests.daq.recording.recordings import (
    FLUSH_LENGTH,
    ONE_DAMPER,
    RATE,
    VOLTS_PER_ACCELERATION,
    VOLTS_PER_METER,
    file_size_limit,
    make_scene,
    random_volts,
    true_motion,
    two_channels,
    write_recording,
)

SAMPLES = 4 * FLUSH_LENGTH + 300
UNITS_PER_VOLT = np.array([[1 / VOLTS_PER_METER], [1 / VOLTS_PER_ACCELERATION]])
TRUE = random_volts(SAMPLES) * UNITS_PER_VOLT  # Samples of both channels in physical units.
TRUTH_SCENE = make_scene(recording={"truth": True}, **ONE_DAMPER)


@pytest.fixture(scope="module")
def intact_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    return write_recording(path, random_volts(SAMPLES), make_scene(recording={"display": True}))


def chunks_of(path):
    """Return (begin, end, topics) of each chunk, positions in bytes, as the reference reader finds them."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    return [
        (
            chunk.chunk_start_offset,
            chunk.chunk_start_offset + chunk.chunk_length,
            {summary.channels[channel_id].topic for channel_id in chunk.message_index_offsets},
        )
        for chunk in summary.chunk_indexes
    ]


def check_readable(path, true=TRUE):
    """Check that each sample is true or listed as lost; return which samples are readable, shape (2, samples)."""
    with daq.open(path) as recording:
        recording.check()
        samples = np.full(true.shape, np.nan)
        for row, name in enumerate(recording.channels):
            samples[row, : recording.samples] = recording.read(name)
        is_listed_as_lost = np.zeros(true.shape, bool)
        for gap in recording.gaps:
            for row, name in enumerate(recording.channels):
                is_listed_as_lost[row, gap.first_sample : gap.last_sample + 1] |= name in gap.channels
        is_readable = ~np.isnan(samples)
        assert np.array_equal(samples[is_readable], true[is_readable])
        # Samples after the end of the recovered file are not listed.
        assert np.array_equal(is_listed_as_lost[:, : recording.samples], ~is_readable[:, : recording.samples])
    return is_readable


def samples_in_intact_chunks(chunks, is_damaged):
    """Return which samples, shape (2, samples), are in chunks without damage.

    `is_damaged`: function of begin and end of a chunk, in bytes.
    """
    is_readable = np.zeros(TRUE.shape, bool)
    first_samples = {"/raw/body1": 0, "/raw/body2": 0}
    for begin, end, topics in chunks:
        for row, topic in enumerate(first_samples):
            if topic in topics:
                first = first_samples[topic]
                is_readable[row, first : first + FLUSH_LENGTH] = not is_damaged(begin, end)
                first_samples[topic] += FLUSH_LENGTH
    return is_readable


def test_truncated_file_keeps_every_complete_chunk(intact_file, tmp_path):
    data, chunks, rng = intact_file.read_bytes(), chunks_of(intact_file), random.Random(5)
    truncated, fixed = tmp_path / os.fsdecode(b"truncated\xff.mcap"), tmp_path / "fixed.mcap"
    first_chunk = min(begin for begin, _, topics in chunks if "/raw/body1" in topics)
    # The last metadata record ends with its checksum: the length of the value, and eight digits.
    end_of_data = data.rindex(b"crc32") + len("crc32") + 4 + 8
    n_rejected = 0
    for _ in range(40):
        cut = rng.randrange(len(data))
        truncated.write_bytes(data[:cut])
        expected = samples_in_intact_chunks(chunks, lambda begin, end, cut=cut: end > cut)
        if not expected.any():
            with pytest.raises(RecordingError, match="nothing can be recovered"):
                daq.recover(truncated, fixed)
            assert not fixed.exists()
            n_rejected += 1
            continue
        recovery = daq.recover(truncated, fixed, overwrite=True)
        assert np.array_equal(check_readable(fixed), expected)
        assert recovery.whole == (cut > end_of_data)
        assert sum(recovery.kept.values()) == expected.sum()
        fixed.unlink()
    # Nothing is recovered only from a cut before the end of the first chunk with samples, which has less than 20 kB.
    assert n_rejected < 40 * (first_chunk + 20_000) / len(data)


@pytest.mark.parametrize("length", [1, 40, 5000, 60_000])
def test_overwritten_bytes_affect_only_their_chunks(intact_file, tmp_path, length):
    data, chunks, rng = intact_file.read_bytes(), chunks_of(intact_file), random.Random(length)
    for filler in (b"\0" * length, b"\xff" * length, rng.randbytes(length), data[:length]):
        position = rng.randrange(len(data) - length)
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(data[:position] + filler + data[position + length :])
        recovery = daq.recover(damaged, tmp_path / "fixed.mcap", overwrite=True)
        intact = samples_in_intact_chunks(chunks, lambda begin, end, at=position: begin < at + length and at < end)
        is_readable = check_readable(tmp_path / "fixed.mcap")
        assert is_readable[intact].all()
        lost = sum(stop - first for spans in recovery.lost.values() for first, stop in spans)
        assert lost == (~is_readable).sum() and (not lost or recovery.notes)


def test_repeated_chunk_is_omitted(intact_file, tmp_path):
    data, chunks = intact_file.read_bytes(), chunks_of(intact_file)
    (begin, _, _), (end, _, _) = [chunk for chunk in chunks if "/raw/body1" in chunk[2]][:2]
    (tmp_path / "a.mcap").write_bytes(data[:end] + data[begin:])
    recovery = daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")
    assert check_readable(tmp_path / "fixed.mcap").all()
    assert any("later samples precede" in note for note in recovery.notes)


def test_samples_after_removed_bytes_keep_their_numbers(intact_file, tmp_path):
    data, chunks = intact_file.read_bytes(), chunks_of(intact_file)
    raw_chunks = [chunk for chunk in chunks if "/raw/body1" in chunk[2]]
    begin, end = raw_chunks[1][0] + 100, raw_chunks[2][0] + 100
    (tmp_path / "cut.mcap").write_bytes(data[:begin] + data[end:])
    daq.recover(tmp_path / "cut.mcap", tmp_path / "fixed.mcap")
    is_readable = check_readable(tmp_path / "fixed.mcap")
    assert not is_readable[0, FLUSH_LENGTH : 2 * FLUSH_LENGTH].any()
    assert is_readable[0, 3 * FLUSH_LENGTH :].all()


@pytest.mark.parametrize("byte", range(9))
def test_chunk_with_damaged_length_is_recovered(intact_file, tmp_path, byte):
    chunks = [chunk for chunk in chunks_of(intact_file) if "/raw/body2" in chunk[2]]
    damaged = bytearray(intact_file.read_bytes())
    damaged[chunks[2][0] + byte] ^= 0x41
    (tmp_path / "a.mcap").write_bytes(damaged)
    recovery = daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")
    assert check_readable(tmp_path / "fixed.mcap").all()
    assert recovery.lost == {}


def test_file_with_damaged_end_is_complete(intact_file, tmp_path):
    (tmp_path / "a.mcap").write_bytes(intact_file.read_bytes()[:-3])
    recovery = daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")
    assert recovery.whole
    assert list(recovery.report())[-1] == "nothing was lost"
    with daq.open(tmp_path / "fixed.mcap") as recording:
        assert recording.status == "complete"
        assert [marker.kind for marker in recording.markers] == ["measure"]
    assert check_readable(tmp_path / "fixed.mcap").all()


def test_lost_markers_and_display_are_counted(intact_file, tmp_path):
    data = bytearray(intact_file.read_bytes())
    for topic in ("/markers", "/tf"):
        begin, end, _ = [chunk for chunk in chunks_of(intact_file) if topic in chunk[2]][-1]
        data[(begin + end) // 2] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    recovery = daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")
    assert recovery.lost == {}
    assert recovery.missing["/markers"] == 1
    assert recovery.missing["/tf"] > 0
    assert "lost: 1 message of /markers" in list(recovery.report())


def test_lost_truth_is_listed_by_topic(tmp_path):
    path = write_recording(tmp_path / "a.mcap", random_volts(3 * FLUSH_LENGTH), TRUTH_SCENE)
    begin, end, _ = [chunk for chunk in chunks_of(path) if "/truth/damper_1/gap" in chunk[2]][1]
    data = bytearray(path.read_bytes())
    data[(begin + end) // 2] ^= 1
    path.write_bytes(data)
    recovery = daq.recover(path, tmp_path / "fixed.mcap")
    span = (FLUSH_LENGTH, 2 * FLUSH_LENGTH)
    assert recovery.lost == {"/truth/damper_1/gap": [span], "/truth/damper_1/contact": [span]}
    with daq.open(tmp_path / "fixed.mcap") as recording:
        gap = recording.truth("gap")[0]
        assert np.isnan(gap[slice(*span)]).all()
        assert np.array_equal(gap[2 * FLUSH_LENGTH :], true_motion(0, 3 * FLUSH_LENGTH, 1).gap[0, 2 * FLUSH_LENGTH :])
        assert recording.gaps[0].channels == ("/truth/damper_1/gap", "/truth/damper_1/contact")


def test_lost_truth_of_dampers_reads_as_nan(tmp_path):
    path = write_recording(tmp_path / "a.mcap", random_volts(3 * FLUSH_LENGTH), TRUTH_SCENE)
    data = bytearray(path.read_bytes())
    for begin, end, topics in chunks_of(path):
        if "/truth/damper_1/gap" in topics:
            data[(begin + end) // 2] ^= 1
    path.write_bytes(data)
    daq.recover(path, tmp_path / "fixed.mcap")
    with daq.open(tmp_path / "fixed.mcap") as recording:
        recording.check()
        assert np.isnan(recording.truth("gap")[0]).all()
        assert np.isfinite(recording.read("body1")).all()


def test_unacquired_samples_are_not_reported_as_lost(tmp_path):
    with Recorder(tmp_path / "a.mcap", make_scene(), two_channels(), RATE) as recorder:
        recorder.write(random_volts(2000))
        recorder.gap(FLUSH_LENGTH)
        recorder.write(random_volts(2000))
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[:-3])
    assert daq.recover(tmp_path / "b.mcap", tmp_path / "fixed.mcap").lost == {}
    with daq.open(tmp_path / "fixed.mcap") as recording:
        assert [(gap.first_sample, gap.reason) for gap in recording.gaps] == [(2000, "never acquired")]


# -- killed recorders ------------------------------------------------------------------------------------

WRITER = """
import os, sys
from pathlib import Path
from tests.daq.recording.recordings import FLUSH_LENGTH, RATE, two_channels, make_scene, random_volts
from daq.core.recording.recorder import Recorder
samples = random_volts(400 * FLUSH_LENGTH)
with Recorder(sys.argv[1], make_scene(), two_channels(), RATE) as recorder:
    for first in range(0, samples.shape[1], 100):
        recorder.write(samples[:, first : first + 100])
        # Long lines fill the pipe: the writer waits for the test, and cannot finish before it is killed.
        os.write(1, f"{recorder.position:100}\\n".encode())
"""


def test_killed_recorder_keeps_all_flushed_samples(tmp_path):
    rng, true = random.Random(3), random_volts(400 * FLUSH_LENGTH) * UNITS_PER_VOLT
    paths = [tmp_path / f"{number}.mcap" for number in range(2)]
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, cwd=Path(__file__).parents[3]
        )
        for path in paths
    ]
    for path, process in zip(paths, processes, strict=True):
        assert process.stdout is not None
        for _ in range(rng.randrange(30, 600)):
            line = process.stdout.readline()
        process.kill()
        last_lines = [line, *process.communicate()[0].splitlines()]
        assert process.returncode == -signal.SIGKILL
        # The very last line may be incomplete; the previous line has the number of samples written so far.
        n_written = int(last_lines[-1] if len(last_lines) < 3 else last_lines[-2])
        fixed = path.with_suffix(".fixed")
        recovery = daq.recover(path, fixed)
        is_readable = check_readable(fixed, true)
        assert is_readable[:, : n_written // FLUSH_LENGTH * FLUSH_LENGTH].all()
        assert any("has no end" in note for note in recovery.notes)


# -- recovery that is impossible -------------------------------------------------------------------------


def test_wrong_recovery_targets_change_nothing(intact_file, tmp_path):
    path, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    path.write_bytes(intact_file.read_bytes())
    other.write_bytes(b"precious")
    with pytest.raises(RecordingError, match="into itself"):
        daq.recover(path, path, overwrite=True)
    with pytest.raises(RecordingError, match="exists"):
        daq.recover(path, other)
    assert path.read_bytes() == intact_file.read_bytes()
    assert other.read_bytes() == b"precious"
    with pytest.raises(RecordingError, match="No such file"):
        daq.recover(tmp_path / "none.mcap", tmp_path / "c.mcap")
    with pytest.raises(RecordingError, match="not a file"):
        daq.recover(tmp_path, tmp_path / "c.mcap")


def test_recovery_without_disk_space_is_rejected(intact_file, tmp_path, monkeypatch):
    monkeypatch.setattr(CommittedFile, "free", lambda _: intact_file.stat().st_size - 1)
    with pytest.raises(RunError, match=r"its disk has 0\.\d MB left.*another disk with -o"):
        daq.recover(intact_file, tmp_path / "fixed.mcap")
    assert not list(tmp_path.iterdir())


def test_recovery_onto_a_full_disk_leaves_nothing(intact_file, tmp_path):
    with pytest.raises(RunError, match=r"is not changed.*another disk with -o") as failure, file_size_limit(20_000):
        daq.recover(intact_file, tmp_path / "fixed.mcap")
    assert "daq recover" not in str(failure.value) and not list(tmp_path.iterdir())


def test_random_bytes_are_not_recovered(tmp_path):
    rng = random.Random(2)
    for size in (0, 1, 9, 1000, 200_000):
        for head in (b"", b"\x89MCAP0\r\n"):
            (tmp_path / "a.mcap").write_bytes(head + rng.randbytes(size))
            with pytest.raises(RecordingError, match="nothing can be recovered"):
                daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")
    assert not (tmp_path / "fixed.mcap").exists()


def test_recovery_uses_nothing_without_checksum(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream, enable_crcs=False)
        writer.start()
        number = writer.register_channel("/raw/a", "protobuf", writer.register_schema("x", "protobuf", b""))
        writer.add_message(number, 0, b"data", 0)
        writer.finish()
    with pytest.raises(RecordingError, match="no checksum"):
        daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")


def test_nothing_recoverable_is_reported(intact_file, tmp_path):
    data = bytearray(intact_file.read_bytes()[:-3])
    # This byte is in the first chunk, which describes the channels.
    data[400] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(ShotrigError, match="nothing can be recovered"):
        daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")


# -- command line ----------------------------------------------------------------------------------------


def test_recover_command_lists_losses_like_info(intact_file, tmp_path):
    data, run = intact_file.read_bytes(), CliRunner().invoke
    (tmp_path / "truncated.mcap").write_bytes(data[: len(data) // 2])
    result = run(app, ["recover", str(tmp_path / "truncated.mcap"), "-o", str(tmp_path / "fixed.mcap")])
    assert result.exit_code == 0
    assert "the file has no end: any samples after" in result.output
    info = run(app, ["info", "--check", str(tmp_path / "fixed.mcap")])
    assert info.exit_code == 0
    assert "recovered from truncated.mcap" in info.output
    assert "all checksums match" in info.output
    assert "body 2, acceleration" in info.output
    rejected = run(app, ["info", str(tmp_path / "truncated.mcap")])
    assert isinstance(rejected.exception, RecordingError)


@pytest.fixture
def write_damaged_blocks(tmp_path, monkeypatch):
    """Return a function that writes a recording whose blocks from sample 1280 to 2559 have other header bytes."""

    def write(position, content):
        def encode_damaged(clock, first_sample, samples):
            data = encode(clock, first_sample, samples)
            if first_sample == FLUSH_LENGTH:
                data[..., position : position + len(content)] = np.frombuffer(content, np.uint8)
            return data

        monkeypatch.setattr("daq.core.recording.recorder.encode", encode_damaged)
        return write_recording(tmp_path / "a.mcap", random_volts(SAMPLES))

    return write


# Position of the time and of the first sample in a block, bytes.
T0, FIRST_SAMPLE = 1, 10


@pytest.mark.parametrize(
    ("position", "value"),
    [(FIRST_SAMPLE, FLUSH_LENGTH + 2**40), (FIRST_SAMPLE, 2**64 - 1), (T0, 2**63 - 1), (T0, 0), (T0, 2**63)],
)
def test_block_with_contradicting_times_is_omitted(tmp_path, write_damaged_blocks, position, value):
    path = write_damaged_blocks(position, struct.pack("<Q", value))
    recovery = daq.recover(path, tmp_path / "fixed.mcap")
    is_readable = check_readable(tmp_path / "fixed.mcap")
    assert not is_readable[:, FLUSH_LENGTH : 2 * FLUSH_LENGTH].any()
    assert is_readable.sum() == 2 * (SAMPLES - FLUSH_LENGTH)
    assert recovery.lost.keys() == {"/raw/body1", "/raw/body2"}


def test_implausible_count_of_samples_is_ignored(tmp_path, monkeypatch):
    monkeypatch.setattr(Recorder, "_samples_written", property(lambda _: 10**16, lambda *_: None), raising=False)
    path = write_recording(tmp_path / "a.mcap", random_volts(SAMPLES))
    path.write_bytes(path.read_bytes()[:-3])
    daq.recover(path, tmp_path / "fixed.mcap")
    assert check_readable(tmp_path / "fixed.mcap").all()


def test_loss_of_another_channel_is_marked(intact_file, tmp_path):
    damaged, previous = tmp_path / "damaged.mcap", intact_file
    for topic in ("/raw/body1", "/raw/body2"):
        data = bytearray(previous.read_bytes())
        _, end, _ = [chunk for chunk in chunks_of(previous) if topic in chunk[2]][1]
        data[end - 5] ^= 1
        damaged.write_bytes(data)
        previous = tmp_path / f"{topic[-1]}.mcap"
        daq.recover(damaged, previous)
    assert check_readable(previous).sum() == 2 * (SAMPLES - FLUSH_LENGTH)


def test_gaps_are_subtracted_in_linear_work():
    class CountedRanges(list):
        n_accesses = 0

        def __getitem__(self, index):
            CountedRanges.n_accesses += 1
            return super().__getitem__(index)

    for count in (500, 1000):
        ranges = [(10 * k, 10 * k + 5) for k in range(count)]
        gaps = CountedRanges((10 * k + 1, 10 * k + 2) for k in range(count))
        assert len(list(_subtract(ranges, gaps))) == 2 * count
    assert CountedRanges.n_accesses < 4 * (500 + 1000)
