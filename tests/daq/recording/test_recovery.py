import os
import random
import shutil
import signal as signals
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from typer.testing import CliRunner

import daq
from daq.cli import app
from daq.recording.recorder import Recorder
from rig.errors import RecordingError, RunError, ShotrigError
from tests.daq.recording.recordings import DAMPERS, GROUP, RATE, channels, file_size_limit, motion, scene, signal, write

SAMPLES = 4 * GROUP + 300
TRUE = signal(SAMPLES) * np.array([[1 / 500.0], [1 / 0.01]])


@pytest.fixture(scope="module")
def intact_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    return write(path, signal(SAMPLES), scene(recording={"display": True}))


def chunks_of(path):
    """(begin, end, {topic}) of each chunk with samples in it, from the reference reader."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    return [
        (
            c.chunk_start_offset,
            c.chunk_start_offset + c.chunk_length,
            {summary.channels[n].topic for n in c.message_index_offsets},
        )
        for c in summary.chunk_indexes
    ]


def check_readable(path, true=TRUE):
    """Samples of both channels; NaN is lost, and everything else must be the truth in its place."""
    with daq.open(path) as recording:
        recording.check()
        samples = np.full(true.shape, np.nan)
        for row, name in enumerate(recording.channels):
            samples[row, : recording.samples] = recording.read(name)
        listed = np.zeros(true.shape, bool)
        for gap in recording.gaps:
            for row, name in enumerate(recording.channels):
                listed[row, gap.first_sample : gap.last_sample + 1] |= name in gap.channels
        is_readable = ~np.isnan(samples)
        assert np.array_equal(samples[is_readable], true[is_readable])
        # Only data that is missing before the end is listed.
        assert np.array_equal(listed[:, : recording.samples], ~is_readable[:, : recording.samples])
    return is_readable


def expected_of(chunks, broken):
    """Which samples must be there when some chunks are broken."""
    is_readable = np.zeros(TRUE.shape, bool)
    n_groups = {"/raw/body1": 0, "/raw/body2": 0}
    for begin, end, topics in chunks:
        for row, topic in enumerate(n_groups):
            if topic in topics:
                first = n_groups[topic] * GROUP
                is_readable[row, first : first + GROUP] = not broken(begin, end)
                n_groups[topic] += 1
    return is_readable


def test_truncated_file_keeps_every_whole_chunk(intact_file, tmp_path):
    data, chunks, rng = intact_file.read_bytes(), chunks_of(intact_file), random.Random(5)
    torn, fixed = tmp_path / os.fsdecode(b"torn\xff.mcap"), tmp_path / "fixed.mcap"
    first = min(begin for begin, _, topics in chunks if "/raw/body1" in topics)
    # After the last record before the summary, a file contains no data.
    ends = data.rindex(b"crc32") + len("crc32") + 4 + 8
    refused = 0
    for _ in range(100):
        cut = rng.randrange(len(data))
        torn.write_bytes(data[:cut])
        expected = expected_of(chunks, lambda begin, end, cut=cut: end > cut)
        if not expected.any():
            with pytest.raises(RecordingError, match="nothing can be recovered"):
                daq.recover(torn, fixed)
            assert not fixed.exists()
            refused += 1
            continue
        salvage = daq.recover(torn, fixed, overwrite=True)
        assert np.array_equal(check_readable(fixed), expected)
        assert salvage.whole == (cut > ends)
        assert sum(salvage.kept.values()) == expected.sum()
        fixed.unlink()
    assert refused < 100 * (first + 20_000) / len(data)


@pytest.mark.thorough
def test_bit_flips_lose_a_chunk_at_most(intact_file, tmp_path):
    data, chunks, rng = intact_file.read_bytes(), chunks_of(intact_file), random.Random(6)
    flipped, fixed = tmp_path / "flipped.mcap", tmp_path / "fixed.mcap"
    for _ in range(100):
        place = rng.randrange(len(data))
        damaged = bytearray(data)
        damaged[place] ^= 1 << rng.randrange(8)
        flipped.write_bytes(damaged)
        salvage = daq.recover(flipped, fixed, overwrite=True)
        is_readable = check_readable(fixed)
        hit = expected_of(chunks, lambda begin, end, place=place: begin <= place < end)
        # Undamaged data is recovered; a chunk with a damaged head may be recovered too.
        assert is_readable[hit].all()
        lost = sum(stop - first for spans in salvage.lost.values() for first, stop in spans)
        assert lost == (~is_readable).sum()
        if lost:
            assert any("checksum" in note or "unpack" in note or "record" in note for note in salvage.notes)


@pytest.mark.parametrize("length", [1, 40, 5000, 60_000])
def test_overwritten_stretches_lose_only_themselves(intact_file, tmp_path, length):
    data, chunks, rng = intact_file.read_bytes(), chunks_of(intact_file), random.Random(length)
    for filler in (b"\0" * length, b"\xff" * length, rng.randbytes(length), data[:length]):
        place = rng.randrange(len(data) - length)
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(data[:place] + filler + data[place + length :])
        daq.recover(damaged, tmp_path / "fixed.mcap", overwrite=True)
        untouched = expected_of(chunks, lambda begin, end, at=place: begin < at + length and at < end)
        assert check_readable(tmp_path / "fixed.mcap")[untouched].all()


def test_samples_behind_a_cut_keep_their_places(intact_file, tmp_path):
    data, chunks = intact_file.read_bytes(), chunks_of(intact_file)
    raw = [chunk for chunk in chunks if "/raw/body1" in chunk[2]]
    begin, end = raw[1][0] + 100, raw[2][0] + 100
    (tmp_path / "cut.mcap").write_bytes(data[:begin] + data[end:])
    daq.recover(tmp_path / "cut.mcap", tmp_path / "fixed.mcap")
    is_readable = check_readable(tmp_path / "fixed.mcap")
    assert not is_readable[0, GROUP : 2 * GROUP].any()
    assert is_readable[0, 3 * GROUP :].all()


@pytest.mark.parametrize("place", range(9))
def test_chunk_with_damaged_length_is_recovered(intact_file, tmp_path, place):
    chunks = [chunk for chunk in chunks_of(intact_file) if "/raw/body2" in chunk[2]]
    damaged = bytearray(intact_file.read_bytes())
    damaged[chunks[2][0] + place] ^= 0x41
    (tmp_path / "a.mcap").write_bytes(damaged)
    salvage = daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")
    assert check_readable(tmp_path / "fixed.mcap").all()
    assert salvage.lost == {}


def test_file_with_damaged_end_is_complete(intact_file, tmp_path):
    (tmp_path / "a.mcap").write_bytes(intact_file.read_bytes()[:-3])
    salvage = daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")
    assert salvage.whole
    assert list(salvage.report())[-1] == "nothing was lost"
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
    salvage = daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")
    assert salvage.lost == {}
    assert salvage.missing["/markers"] == 1
    assert salvage.missing["/tf"] > 0
    assert "lost: 1 message of /markers" in list(salvage.report())


def test_lost_truth_is_listed_by_topic(tmp_path):
    path = write(tmp_path / "a.mcap", signal(3 * GROUP), scene(recording={"truth": True}, **DAMPERS))
    begin, end, _ = [chunk for chunk in chunks_of(path) if "/truth/damper_1/gap" in chunk[2]][1]
    data = bytearray(path.read_bytes())
    data[(begin + end) // 2] ^= 1
    path.write_bytes(data)
    salvage = daq.recover(path, tmp_path / "fixed.mcap")
    span = (GROUP, 2 * GROUP)
    assert salvage.lost == {"/truth/damper_1/gap": [span], "/truth/damper_1/contact": [span]}
    with daq.open(tmp_path / "fixed.mcap") as recording:
        gap = recording.truth("gap")[0]
        assert np.isnan(gap[slice(*span)]).all()
        assert np.array_equal(gap[2 * GROUP :], motion(0, 3 * GROUP, 1).gap[0, 2 * GROUP :])
        assert recording.gaps[0].channels == ("/truth/damper_1/gap", "/truth/damper_1/contact")


def test_lost_truth_of_dampers_reads_as_nan(tmp_path):
    path = write(tmp_path / "a.mcap", signal(3 * GROUP), scene(recording={"truth": True}, **DAMPERS))
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


def test_unacquired_samples_are_not_called_lost(tmp_path):
    with Recorder(tmp_path / "a.mcap", scene(), channels(), RATE) as recorder:
        recorder.write(signal(2000))
        recorder.gap(GROUP)
        recorder.write(signal(2000))
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[:-3])
    assert daq.recover(tmp_path / "b.mcap", tmp_path / "fixed.mcap").lost == {}
    with daq.open(tmp_path / "fixed.mcap") as recording:
        assert [(gap.first_sample, gap.reason) for gap in recording.gaps] == [(2000, "never acquired")]


# -- killed recorders ------------------------------------------------------------------------------------

WRITER = """
import os, sys
from pathlib import Path
from tests.daq.recording.recordings import GROUP, RATE, channels, scene, signal
from daq.recording.recorder import Recorder
samples = signal(400 * GROUP)
with Recorder(sys.argv[1], scene(), channels(), RATE) as recorder:
    for place in range(0, samples.shape[1], 100):
        recorder.write(samples[:, place : place + 100])
        # Long lines fill the pipe, so that the writer cannot run away to its end before it is killed.
        os.write(1, f"{recorder.position:100}\\n".encode())
"""


def test_killed_recorder_keeps_all_flushed_samples(tmp_path):
    rng, true = random.Random(3), signal(400 * GROUP) * np.array([[1 / 500.0], [1 / 0.01]])
    paths = [tmp_path / f"{number}.mcap" for number in range(3)]
    running = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, cwd=Path(__file__).parents[3]
        )
        for path in paths
    ]
    for path, process in zip(paths, running, strict=True):
        assert process.stdout is not None
        for _ in range(rng.randrange(30, 600)):
            line = process.stdout.readline()
        process.kill()
        rest = process.communicate()[0].splitlines()
        assert process.returncode == -signals.SIGKILL
        written = int([line, *rest][-1] if len(rest) < 2 else rest[-2])
        fixed = path.with_suffix(".fixed")
        salvage = daq.recover(path, fixed)
        is_readable = check_readable(fixed, true)
        assert is_readable[:, : written // GROUP * GROUP].all()
        assert any("has no end" in note for note in salvage.notes)


# -- refusals --------------------------------------------------------------------------------------------


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


def test_recovery_needs_room_before_it_begins(intact_file, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=intact_file.stat().st_size - 1))
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
    data[400] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(ShotrigError, match="nothing can be recovered"):
        daq.recover(tmp_path / "a.mcap", tmp_path / "fixed.mcap")


# -- command line ----------------------------------------------------------------------------------------


def test_recover_command_lists_losses_like_info(intact_file, tmp_path):
    data, run = intact_file.read_bytes(), CliRunner().invoke
    (tmp_path / "torn.mcap").write_bytes(data[: len(data) // 2])
    result = run(app, ["recover", str(tmp_path / "torn.mcap"), "-o", str(tmp_path / "fixed.mcap")])
    assert result.exit_code == 0
    assert "were not flushed" in result.output
    info = run(app, ["info", "--check", str(tmp_path / "fixed.mcap")])
    assert info.exit_code == 0
    assert "recovered from torn.mcap" in info.output
    assert "all checksums match" in info.output
    assert "body 2, acceleration" in info.output
    refused = run(app, ["info", str(tmp_path / "torn.mcap")])
    assert isinstance(refused.exception, RecordingError)
