"""The files that `Recorder` writes, even if writing or acquisition fails."""

import json
import os
import signal
from contextlib import ExitStack

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

import daq
import rig
from daq.core.recording.committed_file import RESERVE, CommittedFile
from daq.core.recording.recorder import Recorder
from daq.core.recording.recovery import recover
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.ending_signals import delayed_interrupt
from rig.core.base.errors import RecordingError, RunError
from tests.daq.recording.recordings import (
    CONVERTER_24_BIT,
    DISPLAY_AND_TRUTH,
    FLUSH_LENGTH,
    ONE_DAMPER,
    RATE,
    VOLTS_PER_METER,
    file_size_limit,
    make_scene,
    messages_of,
    random_volts,
    true_motion,
    two_channels,
    write_recording,
)

DAMPER_SCENE = make_scene(recording=DISPLAY_AND_TRUTH, **ONE_DAMPER)


def summary_of(path):
    """Return the summary of an MCAP file, as the reference reader reads it."""
    with path.open("rb") as stream:
        return make_reader(stream).get_summary()


@pytest.fixture(scope="module")
def undivided_file(tmp_path_factory):
    """Return the bytes of a recording that was written in one piece."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    return write_recording(path, random_volts(4000), DAMPER_SCENE).read_bytes()


@settings(max_examples=12)
@given(piece_lengths=st.lists(st.integers(1, 3000), min_size=1, max_size=5))
def test_file_does_not_depend_on_piece_lengths(undivided_file, tmp_path_factory, piece_lengths):
    path = tmp_path_factory.mktemp("split") / "split.mcap"
    write_recording(path, random_volts(4000), DAMPER_SCENE, piece_lengths)
    assert path.read_bytes() == undivided_file


def test_markers_do_not_depend_on_piece_lengths(tmp_path):
    samples = random_volts(3 * FLUSH_LENGTH)
    for name, piece_length in (("a", 3 * FLUSH_LENGTH), ("b", 64)):
        with Recorder(tmp_path / name, make_scene(recording={"display": True}), two_channels(), RATE) as recorder:
            for interval in (slice(0, 1500), slice(1500, 3 * FLUSH_LENGTH)):
                part = samples[:, interval]
                for first in range(0, part.shape[1], piece_length):
                    recorder.write(part[:, first : first + piece_length])
                recorder.mark("measure", recorder.position - 900, recorder.position - 1)
                recorder.mark("settle", recorder.position - 1000, recorder.position - 901)
                recorder.gap(777)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_reference_reader_reads_blocks_and_topics(tmp_path):
    path = write_recording(tmp_path / "a.mcap", random_volts(1500))
    result = messages_of(path, "/raw/body1")
    # A block has 256 samples; 1500 samples are six blocks, the last incomplete.
    block_starts_ns = [round(256 * block * 1e9 / RATE) for block in range(6)]
    assert [message.publish_time for message in result] == block_starts_ns
    assert [message.log_time for message in result] == [*block_starts_ns[1:], round(1500 * 1e9 / RATE)]
    assert [message.sequence for message in result] == list(range(6))
    summary = summary_of(path)
    assert {channel.topic for channel in summary.channels.values()} == {"/markers", "/raw/body1", "/raw/body2"}
    assert summary.statistics.attachment_count == 1


def test_each_raw_topic_has_its_own_chunks(tmp_path):
    path = write_recording(tmp_path / "a.mcap", random_volts(4000), make_scene(recording=DISPLAY_AND_TRUTH))
    summary = summary_of(path)
    raw = {number for number, channel in summary.channels.items() if channel.topic.startswith("/raw/")}
    for chunk in summary.chunk_indexes:
        channel_ids = set(chunk.message_index_offsets)
        assert len(channel_ids) == 1 or not channel_ids & raw


def test_recording_without_options_has_no_optional_topics(tmp_path):
    path = write_recording(tmp_path / "a.mcap", random_volts(3000))
    topics = {channel.topic for channel in summary_of(path).channels.values()}
    assert not [topic for topic in topics if topic.startswith(("/display", "/tf", "/robot", "/truth"))]
    with daq.open(path) as recording:
        assert "display" not in recording.metadata


# -- failures --------------------------------------------------------------------------------------------


def test_existing_file_needs_overwrite(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(RecordingError, match=r"a\.mcap exists"):
        Recorder(path, make_scene(), two_channels(), RATE)
    assert path.read_bytes() == b"precious"
    with Recorder(path, make_scene(), two_channels(), RATE, overwrite=True) as recorder:
        recorder.write(random_volts(10))
    with daq.open(path) as recording:
        assert recording.samples == 10


def test_missing_folder_is_created_by_the_recorder(tmp_path):
    path = tmp_path / "missing" / "a.mcap"
    Recorder(path, make_scene(), two_channels(), RATE).close()
    assert path.is_file()


def test_file_as_folder_is_rejected(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="a file has this name"):
        Recorder(tmp_path / "file" / "a.mcap", make_scene(), two_channels(), RATE)


def test_write_protected_folder_is_rejected(tmp_path):
    # The scene is loaded before the change of user: the new user may have no right to read the repository.
    scene = make_scene()
    tmp_path.chmod(0o500)
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)  # Root may write to any folder; the user nobody (65534) may not.
    try:
        with pytest.raises(RecordingError, match=r"cannot create .*ermission denied"):
            Recorder(tmp_path / "a.mcap", scene, two_channels(), RATE)
    finally:
        if is_root:
            os.seteuid(0)
        tmp_path.chmod(0o700)


def test_failing_disk_leaves_flushed_samples(tmp_path):
    samples, path = random_volts(20 * FLUSH_LENGTH), tmp_path / "a.mcap"
    with pytest.raises(RunError, match="daq recover"), Recorder(path, make_scene(), two_channels(), RATE) as recorder:
        recorder.write(samples[:, : 7 * FLUSH_LENGTH])
        size_before_failure = path.stat().st_size
        with file_size_limit(size_before_failure + 1000):
            recorder.write(samples[:, 7 * FLUSH_LENGTH :])
    assert path.stat().st_size == size_before_failure
    with pytest.raises(RecordingError, match="daq recover"):
        daq.open(path)
    daq.recover(path, tmp_path / "fixed.mcap")
    with daq.open(tmp_path / "fixed.mcap") as recording:
        assert recording.samples == 7 * FLUSH_LENGTH
        assert recording.read("body1") == pytest.approx(samples[0, : 7 * FLUSH_LENGTH] / VOLTS_PER_METER, rel=1e-15)


def test_almost_full_disk_closes_the_recording(tmp_path, monkeypatch):
    samples, path = random_volts(5 * FLUSH_LENGTH), tmp_path / "a.mcap"
    # Three groups of half a second are on the disk.
    expected_error = pytest.raises(RunError, match=r"disk is full.*first 1\.50 s")
    with expected_error, Recorder(path, make_scene(recording={"display": True}), two_channels(), RATE) as recorder:
        recorder.write(samples[:, : 3 * FLUSH_LENGTH])
        monkeypatch.setattr(CommittedFile, "free", lambda _: RESERVE)
        recorder.write(samples[:, 3 * FLUSH_LENGTH :])
    with daq.open(path) as recording:
        assert recording.samples == 3 * FLUSH_LENGTH
        assert recording.status == "failed"
        assert "disk is full" in recording.metadata["outcome"]["reason"]
        recording.check()


def test_full_disk_is_reported_once(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    expected_error = pytest.raises(RunError, match=r"first 0\.50 s, without an end.*daq recover")
    with (
        ExitStack() as file_limit,
        expected_error as failure,
        Recorder(path, make_scene(), two_channels(), RATE) as recorder,
    ):
        recorder.write(random_volts(FLUSH_LENGTH))
        monkeypatch.setattr(CommittedFile, "free", lambda _: RESERVE)
        # The records that close the file do not fit either.
        file_limit.enter_context(file_size_limit(path.stat().st_size))
        recorder.write(random_volts(FLUSH_LENGTH))
    assert not hasattr(failure.value, "__notes__")


@pytest.mark.parametrize(
    ("error", "status"), [(KeyboardInterrupt("stopped by hand"), "interrupted"), (RuntimeError("failure"), "failed")]
)
def test_exception_closes_the_file_with_its_reason(tmp_path, error, status):
    with pytest.raises(type(error)), Recorder(tmp_path / "a.mcap", make_scene(), two_channels(), RATE) as recorder:
        recorder.write(random_volts(1000))
        raise error
    with daq.open(tmp_path / "a.mcap") as recording:
        assert recording.samples == 1000
        assert (recording.status, recording.metadata["outcome"]["reason"]) == (status, str(error))


def test_scene_that_fails_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr(rig.Scene, "to_si_yaml", lambda _: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        Recorder(tmp_path / "a.mcap", make_scene(), two_channels(), RATE)
    assert list(tmp_path.iterdir()) == []


def test_interrupt_waits_for_the_end_of_writing():
    is_end_reached = False
    with pytest.raises(KeyboardInterrupt), delayed_interrupt():
        signal.raise_signal(signal.SIGINT)
        is_end_reached = True
    assert is_end_reached
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_wrong_recorder_calls_are_rejected(tmp_path):
    recorder = Recorder(tmp_path / "a.mcap", make_scene(), two_channels(), RATE)
    with pytest.raises(ValueError, match=r"\(2, n\)"):
        recorder.write(np.zeros((3, 10)))
    with pytest.raises(ValueError, match="truth"):
        recorder.write_truth(true_motion(0, 10))
    with pytest.raises(ValueError, match="at least 1"):
        recorder.gap(0)
    recorder.close()
    recorder.close()
    with pytest.raises(RunError, match="has ended"):
        recorder.write(random_volts(10))


def test_samples_without_their_truth_are_rejected(tmp_path):
    truth_scene = make_scene(recording={"truth": True})
    with (
        pytest.raises(RunError, match="truth: the true motion of these samples is missing"),
        Recorder(tmp_path / "a.mcap", truth_scene, two_channels(), RATE) as recorder,
    ):
        recorder.write(random_volts(10))


@pytest.mark.parametrize("truth", [False, True])
def test_samples_are_flushed_each_half_second(tmp_path, truth, monkeypatch):
    path, scene, flushed = tmp_path / "a.mcap", make_scene(recording={"truth": truth}), []

    class ObservedFile(CommittedFile):
        """A file that notes how many samples the recorder has at each write to the disk."""

        def commit(self):
            super().commit()
            if recorders:
                flushed.append(recorders[0].position)

    monkeypatch.setattr("daq.core.recording.recorder.CommittedFile", ObservedFile)
    recorders = []  # empty while the recorder writes the beginning of the file
    recorders.append(Recorder(path, scene, two_channels(), RATE))
    samples, first = random_volts(6 * FLUSH_LENGTH), 0
    for size in (1000, 3 * FLUSH_LENGTH, 100):
        part = samples[:, first : first + size]
        if truth:
            recorders[0].write_truth(true_motion(first, size))
        recorders[0].write(part)
        first += size
    assert flushed == [FLUSH_LENGTH, 2 * FLUSH_LENGTH, 3 * FLUSH_LENGTH]
    # The file has no end yet, as after a kill of the process: recovery returns the flushed samples.
    recovered = recover(path, tmp_path / "fixed.mcap").kept
    assert set(recovered.values()) == {3 * FLUSH_LENGTH}
    recorders[0].close()


def test_truth_out_of_order_is_rejected(tmp_path):
    with Recorder(tmp_path / "a.mcap", make_scene(recording={"truth": True}), two_channels(), RATE) as recorder:
        recorder.write_truth(true_motion(0, 100))
        with pytest.raises(ValueError, match="got sample 50 first; expected 100"):
            recorder.write_truth(true_motion(50, 100))


def test_volts_in_recording_of_counts_are_rejected(tmp_path):
    scene = make_scene(recording={"samples": "counts"}, **CONVERTER_24_BIT)
    with pytest.raises(RunError, match="bits"):
        write_recording(tmp_path / "a.mcap", random_volts(10), scene)


def test_metadata_describes_converter_and_sensors(tmp_path):
    info = [ChannelInfo("a", "body 1", "force", 2.0, RATE, volts_per_count=0.5, sensor={"model": "X"})]
    with Recorder(tmp_path / "a.mcap", make_scene(**CONVERTER_24_BIT), info, RATE) as recorder:
        recorder.write(np.array([[1, 2, -3]], np.int32))
    with daq.open(tmp_path / "a.mcap") as recording:
        assert recording.read("a").tolist() == [0.25, 0.5, -0.75]
        assert recording.metadata["sensor a"]["sensor.model"] == "X"
        assert json.loads(recording.metadata["daq"]["converter.bits"]) == 24
        assert recording.channels == {"a": info[0]}
