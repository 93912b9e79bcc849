"""A replay for the rerun viewer contains the data of the recording: .rrd files, read by rerun's own reader."""

import sys
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

import daq
import rig
from daq.core.recording.displacement import HIGH_PASS_HZ
from daq.core.recording.markers import Marker
from daq.core.recording.recorded_test import TestKind
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.chain import Chain
from daq.extras.viewer import spectrum_picture
from daq.extras.viewer.marker_log import overloads, phases
from daq.extras.viewer.outputs import save
from daq.extras.viewer.recorded_motion import RecordedMotion
from daq.extras.viewer.replay import Replay
from daq.extras.viewer.viewer_stream import CONTACT_COLORS, channel_entity
from rig.core.base.errors import RunError, SceneError
from rig.core.base.output_files import allow_overwriting

FREQUENCY = 49.7  # Hz


@pytest.fixture(scope="module")
def recording_path(tmp_path_factory):
    """Record one second of a moving damper, with the truth."""
    scene = rig.load("fig9").replace(
        test={"kind": "sine", "frequency": f"{FREQUENCY} Hz", "drive": "3 V", "duration": "1 s"},
        recording={"truth": True, "display": False},
    )
    return daq.record(scene, tmp_path_factory.mktemp("replay") / "fig9.mcap")


@pytest.fixture
def recording(recording_path):
    with daq.open(recording_path) as opened:
        yield opened


class RrdFile:
    """The contents of an .rrd file."""

    def __init__(self, path):
        self.columns, self.static = {}, {}
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            for field in batch.schema:
                if (field.metadata or {}).get(b"rerun:kind") != b"data":
                    continue
                key = chunk.entity_path, field.name.split(":")[-1]
                values = batch.column(field.name)
                if chunk.is_static:
                    self.static[key] = values
                else:
                    self.columns.setdefault(key, []).append((batch.column("time"), values))

    def series(self, entity, component, width=1):
        """Return times in s and values of a component, in the order of time; `width` is the length of a vector."""
        chunks = [(times, values) for times, values in self.columns[entity, component] if values.null_count == 0]
        time = np.concatenate([times.cast(pa.int64()).to_numpy() for times, _ in chunks]) * 1e-9
        arrays = [values.flatten() for _, values in chunks]
        if pa.types.is_nested(arrays[0].type):
            arrays = [array.flatten() for array in arrays]
        flat = np.concatenate([array.to_numpy(zero_copy_only=False) for array in arrays])
        order = np.argsort(time, kind="stable")
        return time[order], (flat.reshape(-1, width) if width > 1 else flat)[order]


@pytest.fixture(scope="module")
def saved_replay(recording_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("rrd") / "replay.rrd"
    with daq.open(recording_path) as opened:
        save(Replay(opened), path)
    return RrdFile(path)


@pytest.fixture
def without_spectrum(monkeypatch):
    """Leave out the picture of the spectra, which takes longer than all else in a short replay."""
    monkeypatch.setattr(spectrum_picture, "spectrum_picture", lambda *arguments: b"")


def test_saved_channels_have_every_sample(recording, saved_replay):
    for name in recording.channels:
        time, shown_mm = saved_replay.series(f"/channels/displacement/{name}", "scalars")
        np.testing.assert_allclose(time, np.arange(recording.samples) / recording.rate, atol=1e-9)
        np.testing.assert_array_equal(shown_mm, 1e3 * recording.read(name))


def test_saved_gaps_and_contacts_match_truth(recording, saved_replay):
    time, gap_mm = saved_replay.series("/dampers/gap_mm/damper_1", "scalars")
    np.testing.assert_array_equal(gap_mm, 1e3 * recording.truth("gap")[0])
    assert gap_mm.max() == pytest.approx(0.98, rel=1e-6), "the damper should have reached its ceiling"
    # The viewer draws the line before a point in the color of the point.
    ends, colors = saved_replay.series("/dampers/contact/damper_1", "colors")
    displayed = colors[np.searchsorted(ends, time[:-1] + 1e-9, side="right")]
    true = np.array(CONTACT_COLORS)[recording.truth("contact")[0].astype(int)]
    assert (displayed == true[:-1]).all()
    assert set(displayed) == set(CONTACT_COLORS[:3])


def test_drawn_rig_follows_displacement_channels(recording, saved_replay):
    replay = Replay(recording)
    frames = np.arange(0, recording.samples, replay.step)
    # At most 1000 frames per second, rounded to whole samples.
    assert 500 <= recording.rate / replay.step <= 1100
    for body in (1, 2, 3):
        time, position = saved_replay.series(f"/rig/body_{body}", "translation", width=3)
        np.testing.assert_allclose(time, frames / recording.rate, atol=1e-9)
        height = position[:, 2] - position[:, 2].mean()
        displacement = recording.read(f"body{body}")[frames] * replay.view.exaggeration
        np.testing.assert_allclose(height, displacement - displacement.mean(), atol=1e-6)
    _, gap = saved_replay.series("/rig/body_2/damper", "translation", width=3)
    true = recording.truth("gap")[0][frames] * replay.view.exaggeration
    np.testing.assert_allclose(gap[:, 2], true, atol=1e-6)


def test_saved_replay_has_markers_and_description(recording, saved_replay):
    (mark,) = (mark for mark in recording.markers if mark.kind == "measure")
    times, texts = saved_replay.series("/markers", "text")
    (index,) = (index for index, text in enumerate(texts) if text.startswith("measure"))
    assert times[index] == pytest.approx(mark.first_sample / recording.rate)
    assert f"frequency {FREQUENCY:g} Hz" in texts[index]
    (page,) = saved_replay.static["/about", "text"].to_pylist()[0]
    factor = Replay(recording).view.exaggeration
    assert f"motion exaggerated {factor:g} times" in page
    assert "body 1: channel body1" in page
    assert recording.scene.name in page
    assert "0.98 mm" in page


def test_only_the_chosen_part_is_saved(recording, tmp_path):
    save(Replay(recording, 0.5, 0.6), tmp_path / "part.rrd")
    time, _ = RrdFile(tmp_path / "part.rrd").series("/channels/displacement/body1", "scalars")
    assert time[0] == pytest.approx(0.5)
    assert time[-1] == pytest.approx(0.6)


def test_lost_samples_are_gaps_in_curves(recording, tmp_path):
    path, lost = tmp_path / "gap.mcap", range(1000, 1600)
    scene = recording.scene.replace(dampers=(), recording={"truth": False, "display": False})
    infos = list(recording.channels.values())
    volts = np.array([recording.read(info.name) * info.sensitivity for info in infos])
    scene = scene.replace(recording={"truth": False, "display": False, "samples": "float64"})
    with daq.Recorder(path, scene, infos, recording.rate) as recorder:
        recorder.write(volts[:, : lost.start])
        recorder.gap(len(lost))
        recorder.write(volts[:, lost.stop :])
    with daq.open(path) as with_gap:
        save(Replay(with_gap), tmp_path / "gap.rrd")
        replay_file = RrdFile(tmp_path / "gap.rrd")
        _, displayed = replay_file.series("/channels/displacement/body1", "scalars")
        assert np.isnan(displayed[lost.start : lost.stop]).all()
        assert np.isfinite(np.delete(displayed, np.arange(lost.start, lost.stop))).all()
        time, _ = replay_file.series("/rig/body_1", "translation", width=3)
        is_lost = (time > (lost.start - 0.5) / with_gap.rate) & (time < (lost.stop - 0.5) / with_gap.rate)
        assert not is_lost.any()
        assert any("gap" in text for text in replay_file.series("/markers", "text")[1])


def test_accelerations_are_integrated_and_described(tmp_path):
    scene = rig.load("bare-structure").replace(
        channels=None,
        shaker={"kind": "table", "body": 1, "spring": "6.6 kN/m"},
        test={"kind": "sine", "frequency": "30 Hz", "drive": "1 mm", "duration": "2 s"},
        recording={"truth": True, "display": False},
    )
    path = daq.record(scene, tmp_path / "bare.mcap")
    with daq.open(path) as opened:
        motion = RecordedMotion(opened)
        assert {source.quantity for source in motion.sources} == {"truth"}
        true = opened.truth("displacement")
    without_truth = scene.replace(recording={"truth": False, "display": False})
    path = daq.record(without_truth, tmp_path / "without_truth.mcap")
    with daq.open(path) as opened:
        motion = RecordedMotion(opened)
        assert all(f"high-passed at {HIGH_PASS_HZ:g} Hz" in source.sentence for source in motion.sources)
        parts = [part for _, part in motion.segments(0, opened.samples, 1)]
        result = np.concatenate([np.vstack([part.displacement, part.tables]) for part in parts], axis=1)
    second_half = slice(result.shape[1] // 2, None)
    error = np.abs(result[:, second_half] - true[:, second_half]).max(axis=1)
    # The high-pass filter shifts the phase of a 30 Hz tone by about 5 degrees; its transient adds to the error.
    assert (error < 0.15 * np.abs(true[:, second_half]).max(axis=1)).all(), error


@pytest.mark.parametrize(
    ("begin", "end", "speed", "message"),
    [(2.0, None, 1.0, r"length is 1\.000 s"), (0.6, 0.5, 1.0, "is after `to_s` 0.5 s"), (None, None, 0.0, "`speed` 0")],
)
def test_impossible_part_or_speed_is_rejected(recording, begin, end, speed, message):
    with pytest.raises(SceneError, match=message):
        Replay(recording, begin, end, speed)


def test_wrong_extension_overwrites_nothing(recording, recording_path):
    before = recording_path.read_bytes()
    with pytest.raises(SceneError, match=r"ends in \.rrd"):
        save(Replay(recording), recording_path)
    assert recording_path.read_bytes() == before


@pytest.mark.skipif(sys.platform == "win32", reason="no limits to the size of a file")
@pytest.mark.parametrize("size_limit", [10, 30_000])
@pytest.mark.usefixtures("without_spectrum")
def test_full_disk_keeps_the_old_replay_file(recording, tmp_path, size_limit, capfd):
    import resource

    (tmp_path / "x.rrd").write_text("before")
    previous_limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_limit, previous_limits[1]))
    try:
        with allow_overwriting(True), pytest.raises(RunError, match=r"cannot write .*x\.rrd: File too large"):
            save(Replay(recording), tmp_path / "x.rrd")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, previous_limits)
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("x.rrd", "before")]
    assert capfd.readouterr().err == ""


def test_existing_file_is_not_replaced(recording, tmp_path):
    (tmp_path / "x.rrd").write_text("before")
    with pytest.raises(SceneError, match=r"x\.rrd exists"):
        save(Replay(recording), tmp_path / "x.rrd")
    assert (tmp_path / "x.rrd").read_text(encoding="utf-8") == "before"


def test_missing_folder_of_saved_replay_is_created(recording, tmp_path):
    save(Replay(recording), tmp_path / "nowhere" / "x.rrd")
    assert (tmp_path / "nowhere" / "x.rrd").stat().st_size > 0


def test_hit_phase_extends_to_next_hit(tmp_path):
    scene = rig.load("bare-structure").replace(shaker=None, test=None)
    path = tmp_path / "hits.mcap"
    channels = Chain(scene, 5120.0, ["body 1", "body 2", "body 3"]).channels
    with Recorder(path, scene, channels, 5120.0) as recorder:
        recorder.write(np.zeros((3, 5120)))
        recorder.mark("hit", 512, 530)
        recorder.mark("overload", 515, 520, channel="body1")
        recorder.mark("hit", 2560, 2580)
    with daq.open(path) as opened:
        result = [(phase.label, phase.start, phase.stop) for phase in phases(opened, 0, 5120)]
    assert result == [("impact 1", 512, 2560), ("impact 2", 2560, 5120)]


@pytest.mark.usefixtures("without_spectrum")
def test_overloaded_channel_has_a_lane(tmp_path):
    scene = rig.load("bare-structure").replace(shaker=None, test=None)
    channels = Chain(scene, 5120.0, ["body 1", "body 2", "body 3"]).channels
    with Recorder(tmp_path / "overload.mcap", scene, channels, 5120.0) as recorder:
        recorder.write(np.random.default_rng(1).normal(size=(3, 5120)))
        recorder.mark("overload", 512, 1023, channel="body1")
        recorder.mark("overload", 4096, 5000, channel="body1")
    with daq.open(tmp_path / "overload.mcap") as opened:
        save(Replay(opened, end_s=0.85), tmp_path / "overload.rrd")
    changed, states = RrdFile(tmp_path / "overload.rrd").series("/overload/body1", "state")
    displayed = dict(zip(changed.round(6).tolist(), states, strict=True))
    # Times of samples 512, 1024 and 4096; the replay ends with sample 4352, one interval before 0.850195 s.
    assert displayed == {0.1: "0", 0.2: "none", 0.8: "1", 0.850195: "none"}


def views(part):
    """Return the names and contents of all views of a layout."""
    if isinstance(part, rrb.View):
        return [(str(part.name), part.contents)]
    return [view for inner in getattr(part, "contents", []) for view in views(inner)]


def test_short_overload_is_drawn_visibly(tmp_path):
    scene = rig.load("bare-structure").replace(shaker=None, test=None)
    channels = Chain(scene, 5120.0, ["body 1", "body 2", "body 3"]).channels
    with Recorder(tmp_path / "overload.mcap", scene, channels, 5120.0) as recorder:
        recorder.write(np.zeros((3, 5120)))
        recorder.mark("overload", 512, 512, channel="body1")
        recorder.mark("overload", 514, 514, channel="body1")
    with daq.open(tmp_path / "overload.mcap") as opened:
        ((drawn,),) = overloads(opened, 0, 5120).values()
    assert drawn.stop - drawn.start == 20


def test_shown_segment_is_named(recording):
    whole, part = (views(each.blueprint().root_container) for each in (Replay(recording), Replay(recording, end_s=0.5)))
    assert any("whole recording" in name for name, _ in whole)
    assert any("0 s to 0.5 s of the recording" in name for name, _ in part)


def test_overview_has_envelopes_of_all_channels(recording, saved_replay):
    for name in recording.channels:
        _, envelope = saved_replay.series(f"/envelopes/{name}", "scalars", width=2)
        samples = 1e3 * recording.read(name)
        assert (envelope[:, 0].min(), envelope[:, 1].max()) == (samples.min(), samples.max())
        assert len(envelope) < len(samples) / 2


def test_channel_name_with_slash_is_escaped():
    assert channel_entity("acceleration", "top left/2") == r"/channels/acceleration/top\ left\/2"


@pytest.mark.parametrize("change", [{"structure": "more"}, {"dampers": "more"}])
def test_truth_of_another_rig_is_ignored(change, recording):
    scene = recording.scene
    if "structure" in change:
        springs = {"masses": [1.0] * 4, "springs": [1e4] * 4}
        recording.scene = scene.replace(structure=springs)
    else:
        recording.scene = scene.replace(dampers=[*scene.dampers, *scene.dampers])
    motion = RecordedMotion(recording)
    assert recording.truth_points and not recording.has_truth
    assert not motion.gaps_known
    for _, rig_motion in motion.segments(0, 512, 64):
        assert rig_motion.gap is None and len(rig_motion.displacement) == recording.scene.structure.bodies


@pytest.mark.parametrize(
    ("kind", "frequency", "value"),
    [(TestKind.TONES, 8.0, 3.0), (TestKind.RANDOM, 8.0, 4.0), (TestKind.HITS, 0.25, 0.5)],
)
def test_spectrum_suits_the_kind_of_test(kind, frequency, value):
    rate, time = 128.0, np.arange(128 * 400) / 128.0
    pulse = np.zeros(time.size)
    pulse[1280] = 0.5 * rate  # 0.5 N s
    signals = {
        TestKind.TONES: 3.0 * np.sin(2.0 * np.pi * 8.0 * time),
        # 4 N²/Hz up to 64 Hz
        TestKind.RANDOM: 16.0 * np.random.default_rng(1).standard_normal(time.size),
        TestKind.HITS: pulse,
    }
    recording = SimpleNamespace(
        test=SimpleNamespace(kind=kind), rate=rate, markers=[Marker("hit", 1280, 1290, {})],
        read=lambda channel, first, stop: signals[kind][first:stop],
    )  # fmt: skip
    lines, spectrum = spectrum_picture.channel_spectrum(recording, "force", 0, time.size)
    assert spectrum[np.searchsorted(lines, frequency)] == pytest.approx(value, rel=0.15)


def test_spectrum_picture_fills_its_view(recording):
    # The width and height of a PNG follow its signature; the view is about twice as wide as high.
    picture = spectrum_picture.spectrum_picture(recording, 0, round(recording.duration * recording.rate))
    width, height = np.frombuffer(picture, ">u4", 2, 16)
    assert 1.9 < width / height < 2.3
