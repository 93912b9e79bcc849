import json
import os
import resource
import shutil
import signal
from contextlib import ExitStack

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

import daq
from daq.recording.committed_file import Disk
from daq.recording.recorder import Recorder
from daq.recording.recovery import recover
from daq.signal_chain.channel import ChannelInfo
from rig.ending_signals import delayed_interrupt
from rig.errors import RecordingError, RunError
from tests.daq.recording.recordings import (
    ALL,
    BITS,
    DAMPERS,
    GROUP,
    RATE,
    channels,
    file_size_limit,
    messages,
    motion,
    scene,
    write,
)
from tests.daq.recording.recordings import signal as noise


def summary_of(path):
    with path.open("rb") as stream:
        return make_reader(stream).get_summary()


@pytest.fixture(scope="module")
def unsplit_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    return write(path, noise(4000), scene(recording=ALL, **DAMPERS)).read_bytes()


@settings(max_examples=12)
@given(pieces=st.lists(st.integers(1, 3000), min_size=1, max_size=5))
def test_bytes_do_not_depend_on_the_split(unsplit_file, tmp_path_factory, pieces):
    path = tmp_path_factory.mktemp("split") / "split.mcap"
    write(path, noise(4000), scene(recording=ALL, **DAMPERS), pieces=pieces)
    assert path.read_bytes() == unsplit_file


def test_marks_and_gaps_do_not_depend_on_split(tmp_path):
    samples = noise(3 * GROUP)
    for name, step in (("a", 3 * GROUP), ("b", 64)):
        with Recorder(tmp_path / name, scene(recording={"display": True}), channels(), RATE) as recorder:
            for window in (slice(0, 1500), slice(1500, 3 * GROUP)):
                part = samples[:, window]
                for place in range(0, part.shape[1], step):
                    recorder.write(part[:, place : place + step])
                recorder.mark("measure", recorder.position - 900, recorder.position - 1)
                recorder.mark("settle", recorder.position - 1000, recorder.position - 901)
                recorder.gap(777)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_reference_reader_finds_the_layout(tmp_path):
    path = write(tmp_path / "a.mcap", noise(1500))
    result = messages(path, "/raw/body1")
    step = [round(256 * n * 1e9 / RATE) for n in range(6)]
    assert [message.publish_time for message in result] == step
    assert [message.log_time for message in result] == [*step[1:], round(1500 * 1e9 / RATE)]
    assert [message.sequence for message in result] == list(range(6))
    summary = summary_of(path)
    assert {channel.topic for channel in summary.channels.values()} == {"/markers", "/raw/body1", "/raw/body2"}
    assert summary.statistics.attachment_count == 1


def test_no_chunk_holds_two_raw_topics(tmp_path):
    path = write(tmp_path / "a.mcap", noise(4000), scene(recording=ALL))
    summary = summary_of(path)
    raw = {number for number, channel in summary.channels.items() if channel.topic.startswith("/raw/")}
    for chunk in summary.chunk_indexes:
        channel_ids = set(chunk.message_index_offsets)
        assert len(channel_ids) == 1 or not channel_ids & raw


def test_recording_without_display_has_no_display_topics(tmp_path):
    path = write(tmp_path / "a.mcap", noise(3000))
    topics = {channel.topic for channel in summary_of(path).channels.values()}
    assert not [topic for topic in topics if topic.startswith(("/display", "/tf", "/robot", "/truth"))]
    with daq.open(path) as recording:
        assert "display" not in recording.metadata


# -- what can go wrong -----------------------------------------------------------------------------------


def test_existing_file_needs_overwrite(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(RecordingError, match=r"a\.mcap exists"):
        Recorder(path, scene(), channels(), RATE)
    assert path.read_bytes() == b"precious"
    with Recorder(path, scene(), channels(), RATE, overwrite=True) as recorder:
        recorder.write(noise(10))
    with daq.open(path) as recording:
        assert recording.samples == 10


def test_missing_folder_is_named_by_the_recorder(tmp_path):
    with pytest.raises(RecordingError, match=r"folder .*missing does not exist"):
        Recorder(tmp_path / "missing" / "a.mcap", scene(), channels(), RATE)


def test_file_as_folder_is_rejected(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match=r"cannot create .*folder"):
        Recorder(tmp_path / "file" / "a.mcap", scene(), channels(), RATE)


def test_write_protected_folder_is_rejected(tmp_path):
    # Made before, as nobody may read a checkout that lies in a private folder.
    bench = scene(), channels()
    tmp_path.chmod(0o500)
    mighty = os.geteuid() == 0
    if mighty:
        os.seteuid(65534)
    try:
        with pytest.raises(RecordingError, match=r"cannot create .*ermission denied"):
            Recorder(tmp_path / "a.mcap", *bench, RATE)
    finally:
        if mighty:
            os.seteuid(0)
        tmp_path.chmod(0o700)


def test_failing_disk_leaves_flushed_samples(tmp_path):
    samples, path = noise(20 * GROUP), tmp_path / "a.mcap"
    with pytest.raises(RunError, match="daq recover"), Recorder(path, scene(), channels(), RATE) as recorder:
        for group in range(20):
            if group == 7:
                limit = path.stat().st_size + 1000
            with file_size_limit(limit if group >= 7 else resource.RLIM_INFINITY):
                recorder.write(samples[:, group * GROUP : (group + 1) * GROUP])
    assert path.stat().st_size == limit - 1000
    with pytest.raises(RecordingError, match="daq recover"):
        daq.open(path)
    daq.recover(path, tmp_path / "fixed.mcap")
    with daq.open(tmp_path / "fixed.mcap") as recording:
        assert recording.samples == 7 * GROUP
        assert recording.read("body1") == pytest.approx(samples[0, : 7 * GROUP] / 500.0, rel=1e-15)


def test_full_disk_ends_the_recording_in_time(tmp_path, monkeypatch):
    samples, path = noise(5 * GROUP), tmp_path / "a.mcap"
    usage = shutil.disk_usage(tmp_path)
    message = pytest.raises(RunError, match=r"disk is full.*first 1\.50 s")
    with message, Recorder(path, scene(recording={"display": True}), channels(), RATE) as recorder:
        recorder.write(samples[:, : 3 * GROUP])
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1 << 20))
        recorder.write(samples[:, 3 * GROUP :])
    with daq.open(path) as recording:
        assert recording.samples == 3 * GROUP
        assert recording.status == "failed"
        assert "disk is full" in recording.metadata["outcome"]["reason"]
        recording.check()


def test_full_disk_is_reported_once(tmp_path, monkeypatch):
    path, usage = tmp_path / "a.mcap", shutil.disk_usage(tmp_path)
    message = pytest.raises(RunError, match=r"first 0\.50 s, without an end.*daq recover")
    with ExitStack() as limited, message as failure, Recorder(path, scene(), channels(), RATE) as recorder:
        recorder.write(noise(GROUP))
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1 << 20))
        # Not even the end of the file fits.
        limited.enter_context(file_size_limit(path.stat().st_size))
        recorder.write(noise(GROUP))
    assert not hasattr(failure.value, "__notes__")


@pytest.mark.parametrize(
    ("error", "status"), [(KeyboardInterrupt("stopped by hand"), "interrupted"), (RuntimeError("odd"), "failed")]
)
def test_exception_closes_the_file_with_its_reason(tmp_path, error, status):
    with pytest.raises(type(error)), Recorder(tmp_path / "a.mcap", scene(), channels(), RATE) as recorder:
        recorder.write(noise(1000))
        raise error
    with daq.open(tmp_path / "a.mcap") as recording:
        assert recording.samples == 1000
        assert (recording.status, recording.metadata["outcome"]["reason"]) == (status, str(error))


def test_unwritable_scene_leaves_no_file(tmp_path):
    class Unwritable:
        recording = scene().recording
        converter = scene().converter

        def __getattr__(self, name):
            raise RuntimeError(name)

    with pytest.raises(RuntimeError):
        Recorder(tmp_path / "a.mcap", Unwritable(), channels(), RATE)
    assert list(tmp_path.iterdir()) == []


def test_interrupt_waits_for_the_end_of_a_group():
    reached = []
    with pytest.raises(KeyboardInterrupt), delayed_interrupt():
        signal.raise_signal(signal.SIGINT)
        reached.append("end")
    assert reached == ["end"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_wrong_recorder_calls_are_rejected(tmp_path):
    recorder = Recorder(tmp_path / "a.mcap", scene(), channels(), RATE)
    with pytest.raises(ValueError, match=r"\(2, n\)"):
        recorder.write(np.zeros((3, 10)))
    with pytest.raises(ValueError, match="truth"):
        recorder.write_truth(motion(0, 10))
    with pytest.raises(ValueError, match="at least 1"):
        recorder.gap(0)
    recorder.close()
    recorder.close()
    with pytest.raises(RunError, match="has ended"):
        recorder.write(noise(10))


def test_samples_without_their_truth_are_refused(tmp_path):
    truth_scene = scene(recording={"truth": True})
    with (
        pytest.raises(RunError, match="truth: the true motion of these samples is missing"),
        Recorder(tmp_path / "a.mcap", truth_scene, channels(), RATE) as recorder,
    ):
        recorder.write(noise(10))


@pytest.mark.parametrize("truth", [False, True])
def test_each_group_is_on_disk_once_complete(tmp_path, truth, monkeypatch):
    path, truth_scene, flushed = tmp_path / "a.mcap", scene(recording={"truth": truth}), []

    class WatchedDisk(Disk):
        def commit(self):
            super().commit()
            if recorders:
                flushed.append(recorders[0].position)

    monkeypatch.setattr("daq.recording.recorder.Disk", WatchedDisk)
    recorders = []
    recorders.append(Recorder(path, truth_scene, channels(), RATE))
    samples, first = noise(6 * GROUP), 0
    for size in (1000, 3 * GROUP, 100):
        part = samples[:, first : first + size]
        if truth:
            recorders[0].write_truth(motion(first, size))
        recorders[0].write(part)
        first += size
    assert flushed == [GROUP, 2 * GROUP, 3 * GROUP]
    # A killed process closes nothing: recover what is on the disk now.
    recovered = recover(path, tmp_path / "fixed.mcap").kept
    assert set(recovered.values()) == {3 * GROUP}
    recorders[0].close()


def test_truth_out_of_order_is_rejected(tmp_path):
    with Recorder(tmp_path / "a.mcap", scene(recording={"truth": True}), channels(), RATE) as recorder:
        recorder.write_truth(motion(0, 100))
        with pytest.raises(ValueError, match="got sample 50 first; expected 100"):
            recorder.write_truth(motion(50, 100))


def test_volts_for_counts_name_the_remedy(tmp_path):
    with pytest.raises(RunError, match="bits"):
        write(tmp_path / "a.mcap", noise(10), scene(recording={"samples": "counts"}, **BITS))


def test_converter_and_sensors_are_described(tmp_path):
    info = [ChannelInfo("a", "body 1", "force", 2.0, RATE, volts_per_count=0.5, sensor={"model": "X"})]
    with Recorder(tmp_path / "a.mcap", scene(**BITS), info, RATE) as recorder:
        recorder.write(np.array([[1, 2, -3]], np.int32))
    with daq.open(tmp_path / "a.mcap") as recording:
        assert recording.read("a").tolist() == [0.25, 0.5, -0.75]
        assert recording.metadata["sensor a"]["sensor.model"] == "X"
        assert json.loads(recording.metadata["daq"]["converter.bits"]) == 24
        assert recording.channels == {"a": info[0]}
