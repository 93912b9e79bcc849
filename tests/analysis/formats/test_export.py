"""`analysis export`: samples and results in files that other programs read back."""

import contextlib
import csv
import os
import shutil
import wave
from types import SimpleNamespace

import numpy as np
import pytest
import pyuff
from scipy.io import loadmat, wavfile
from typer.testing import CliRunner

import analysis
import daq
from analysis.commands.cli import app
from analysis.core.recordings.slices import Slice
from analysis.extras.formats.export import expected_bytes, export
from analysis.extras.formats.results import export_results
from analysis.extras.formats.uff import write_uff
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo
from daq.extras.importing.files import signals_of
from rig.core.base.errors import RecordingError, RunError, SceneError
from tests.analysis.responses import synthetic
from tests.daq.recording.recordings import RATE, make_scene, random_volts, two_channels, write_recording
from tests.daq.recording.test_validation import rewrite

SAMPLES = 5000


def sets_of(path, kind):
    """Return the data sets of a type in a Universal File."""
    return [data_set for data_set in pyuff.UFF(str(path)).read_sets() if data_set["type"] == kind]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = write_recording(tmp_path_factory.mktemp("export") / "a.mcap", random_volts(SAMPLES))
    with daq.open(path) as opened:
        yield opened


@pytest.fixture(scope="module")
def recording_with_gap(tmp_path_factory):
    path = tmp_path_factory.mktemp("gap") / "a.mcap"
    with Recorder(path, make_scene(), two_channels(), RATE) as recorder:
        recorder.write(random_volts(1000))
        recorder.gap(500)
        recorder.write(random_volts(1000))
    with daq.open(path) as opened:
        yield opened


def test_csv_has_exact_samples(recording, tmp_path):
    export(Slice.of(recording), tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as stream:
        head, *rows = csv.reader(stream)
    assert head == ["time [s]", "body1 [m]", "body2 [m/s^2]"]
    table = np.array(rows, dtype=float).T
    assert np.array_equal(table[0], np.arange(SAMPLES) / RATE)
    assert np.array_equal(table[1], recording.read("body1"))
    assert np.array_equal(table[2], recording.read("body2"))


def test_npz_loads_without_pickles(recording, tmp_path):
    export(Slice.of(recording, ["body2"], 0.5, 1.0), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert set(arrays) == {"body2", "channels", "units", "rate", "start_s"}
        assert np.array_equal(arrays["body2"], recording.read("body2", 1280, 2560))  # 0.5 to 1 s at 2560 Hz
        assert arrays["units"].tolist() == ["m/s^2"]
        assert (arrays["rate"], arrays["start_s"]) == (RATE, 0.5)


def test_repeated_npz_is_byte_equal(recording, tmp_path):
    for name in ("a.npz", "b.npz"):
        export(Slice.of(recording), tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_wav_is_read_by_scipy(recording, tmp_path):
    notes = export(Slice.of(recording), tmp_path / "a.wav", speed=3.0)
    rate, sound = wavfile.read(tmp_path / "a.wav")
    assert rate == round(3 * RATE)
    assert sound.shape == (SAMPLES, 2)
    for row, name in enumerate(recording.channels):
        samples = recording.read(name)
        full_scale = np.abs(samples).max()
        # scipy returns 24 bits in the upper three bytes of four.
        assert sound[:, row] / 2**31 == pytest.approx(samples / full_scale, abs=2**-22)
        assert notes[row] == f"{name}: full scale is {full_scale:.6g} {recording.channels[name].unit}"
    with wave.open(str(tmp_path / "a.wav")) as header:
        assert header.getsampwidth() == 3


def test_silent_wav_stays_silent(tmp_path):
    with daq.open(write_recording(tmp_path / "a.mcap", np.zeros((2, 100)))) as recording:
        export(Slice.of(recording), tmp_path / "a.wav")
    assert not wavfile.read(tmp_path / "a.wav")[1].any()


def test_uff_is_read_by_pyuff(recording, tmp_path):
    export(Slice.of(recording, None, 0.25, 1.25), tmp_path / "a.uff")
    sets = sets_of(tmp_path / "a.uff", 58)
    assert [data_set["type"] for data_set in sets] == [58, 58]
    assert [data_set["func_type"] for data_set in sets] == [1, 1]  # time response
    assert [data_set["rsp_node"] for data_set in sets] == [1, 2]
    assert [data_set["rsp_dir"] for data_set in sets] == [3, 3]  # +Z
    assert [data_set["ordinate_spec_data_type"] for data_set in sets] == [8, 12]  # displacement, acceleration
    assert [data_set["ordinate_axis_units_lab"] for data_set in sets] == ["m", "m/s^2"]
    assert sets[1]["id1"].startswith("body2: acceleration at body 2")
    assert sets[1]["id4"] == "sample rate 2560.0 Hz"
    for data_set, name in zip(sets, recording.channels, strict=True):
        assert data_set["data"] == pytest.approx(recording.read(name, 640, 3200), rel=1e-11)
        assert data_set["x"][0] == pytest.approx(0.25)
        assert np.diff(data_set["x"]) == pytest.approx(1 / RATE, rel=2e-6)


def test_line_break_in_name_is_replaced(recording, tmp_path):
    path = tmp_path / os.fsdecode(b"a\nb\xff.mcap")
    shutil.copy(recording.path, path)
    with daq.open(path) as opened:
        export(Slice.of(opened), tmp_path / "a.uff")
    assert {data_set["id2"] for data_set in sets_of(tmp_path / "a.uff", 58)} == {r"from a b\udcff.mcap"}


def test_series_follow_sep005_rules(recording):
    series = analysis.sep005(recording, to_s=1.0)
    assert [channel["name"] for channel in series] == ["body1", "body2"]
    assert [channel["unit_str"] for channel in series] == ["m", "m/s²"]
    assert [channel["quantity"] for channel in series] == ["d", "a"]
    for channel in series:
        assert channel["data"].ndim == 1
        assert channel["fs"] == RATE
        assert "timestamp" not in channel and "start_timestamp" not in channel
        assert np.array_equal(channel["data"], recording.read(channel["name"], 0, 2560))


def test_series_pass_sep005_reference_check(recording):
    import sdypy_sep005 as reference

    for channel in analysis.sep005(recording):
        checked = reference.Sep005Data.model_validate(channel)
        assert (checked.name, checked.fs) == (channel["name"], RATE)


def test_series_have_start_time(tmp_path):
    start = 1_763_726_400_250_000_000
    with Recorder(tmp_path / "a.mcap", make_scene(), two_channels(), RATE, start_ns=start) as recorder:
        recorder.write(random_volts(3000))
    with daq.open(tmp_path / "a.mcap") as recording:
        series = analysis.sep005(recording, from_s=1.0)
    assert series[0]["start_timestamp"] == "2025-11-21T12:00:01.250000+00:00"


def test_lost_samples_are_nan_or_rejected(recording_with_gap, tmp_path):
    for name in ("a.csv", "a.npz"):
        export(Slice.of(recording_with_gap), tmp_path / name)
    table = np.genfromtxt(tmp_path / "a.csv", delimiter=",", skip_header=1)
    with np.load(tmp_path / "a.npz") as arrays:
        assert np.array_equal(arrays["body1"], table[:, 1], equal_nan=True)
    assert np.flatnonzero(np.isnan(table[:, 1])).tolist() == list(range(1000, 1500))
    for name in ("a.wav", "a.uff"):
        with pytest.raises(RecordingError, match=r"the samples of body1, body2 from 0.390625 to 0.585938 s are lost"):
            export(Slice.of(recording_with_gap), tmp_path / name)
        export(Slice.of(recording_with_gap, to_s=0.390625), tmp_path / name)
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_piece_length_does_not_change_file(recording, tmp_path, monkeypatch):
    names = ("a.csv", "a.npz", "a.wav")
    for name in names:
        export(Slice.of(recording), tmp_path / name)
    monkeypatch.setattr("analysis.core.recordings.slices.PIECE_SAMPLES", 777)
    for name in names:
        export(Slice.of(recording), tmp_path / f"b{name}")
        assert (tmp_path / name).read_bytes() == (tmp_path / f"b{name}").read_bytes()


@pytest.mark.parametrize(
    ("selection", "message"),
    [
        ({"channels": ["body9"]}, "no channel 'body9'. Choose one of body1, body2"),
        ({"from_s": 5.0}, "times from 0 s to 1.95312 s"),
        ({"from_s": 1.0, "to_s": 0.5}, "`from_s` 1 s is after `to_s` 0.5 s"),
    ],
)
def test_missing_segment_names_available_range(recording, selection, message):
    with pytest.raises(SceneError, match=message):
        Slice.of(recording, **selection)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.xls", {}, "unknown format '.xls'"),
        ("a", {}, "ends in one of .csv"),
        ("a.csv", {"speed": 2.0}, "`speed`"),
        ("a.wav", {"speed": 1e9}, "Choose another `speed`"),
        ("a.wav", {"speed": 0.0}, "Choose another `speed`"),
    ],
)
def test_impossible_export_leaves_no_file(recording, tmp_path, name, options, message):
    with pytest.raises(SceneError, match=message):
        export(Slice.of(recording), tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []


def test_missing_folder_of_export_is_created(recording, tmp_path):
    export(Slice.of(recording), tmp_path / "missing" / "a.csv")
    assert (tmp_path / "missing" / "a.csv").is_file()


def test_full_disk_is_reported_before_writing(recording, tmp_path, monkeypatch):
    segment = Slice.of(recording)
    usage = SimpleNamespace(free=int(expected_bytes(segment, ".csv") / 4) - 1)  # a quarter may suffice
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(RunError, match=r"would take about .* MB, and its disk has .* MB left"):
        export(segment, tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []
    usage.free += 1
    export(segment, tmp_path / "a.csv")


def test_missing_folder_is_reported(recording, tmp_path):
    with pytest.raises(FileNotFoundError):
        write_uff(Slice.of(recording), tmp_path / "missing" / "a.uff")


def test_huge_gap_is_reported_quickly(tmp_path):
    path = rewrite(write_recording(tmp_path / "a.mcap", random_volts(SAMPLES)), shift=2**40)
    with daq.open(path) as recording:
        with pytest.raises(RecordingError, match="of them are in the file"):
            Slice.of(recording)
        assert Slice.of(recording, to_s=0.5).stop == round(0.5 * RATE)


def test_uff_rejects_single_sample(recording, tmp_path):
    with pytest.raises(SceneError, match="this segment has 1"):
        export(Slice.of(recording, to_s=1e-4), tmp_path / "a.uff")


def test_existing_file_needs_overwrite(recording, tmp_path):
    path = tmp_path / "a.uff"
    path.write_text("precious")
    with pytest.raises(SceneError, match="exists"):
        export(Slice.of(recording), path)
    assert path.read_text(encoding="utf-8") == "precious"
    export(Slice.of(recording), path, overwrite=True)
    assert len(sets_of(path, 58)) == 2


def test_target_folder_is_reported(recording, tmp_path):
    (tmp_path / "a.csv").mkdir()
    with pytest.raises(SceneError, match="is a folder or a device"):
        export(Slice.of(recording), tmp_path / "a.csv", overwrite=True)


def test_channel_names_like_paths_are_replaced(tmp_path):
    info = [ChannelInfo("../x y", "body 1", "force", 1.0, RATE)]
    with Recorder(tmp_path / "a.mcap", make_scene(), info, RATE) as recorder:
        recorder.write(np.ones((1, 10)))
    with daq.open(tmp_path / "a.mcap") as recording:
        export(Slice.of(recording), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays[".._x_y"].tolist() == [1.0] * 10


@pytest.mark.parametrize(("names", "rejected"), [(("rate",), "rate"), (("a b", "a/b"), "a b")])
def test_npz_rejects_channels_with_names_in_use(tmp_path, names, rejected):
    infos = [ChannelInfo(name, "body 1", "force", 1.0, RATE) for name in names]
    with Recorder(tmp_path / "a.mcap", make_scene(), infos, RATE) as recorder:
        recorder.write(np.ones((len(names), 10)))
    with daq.open(tmp_path / "a.mcap") as recording, pytest.raises(SceneError, match=f"channel '{rejected}' cannot be"):
        export(Slice.of(recording), tmp_path / "a.npz")


def test_unknown_format_is_rejected_before_writing(recording, tmp_path):
    result = CliRunner().invoke(app, ["export", str(recording.path), "-o", str(tmp_path / "a.tdms")])
    assert "ends in one of .csv" in str(result.exception) and "writing" not in result.output


def test_command_names_written_file(recording, tmp_path):
    path = tmp_path / "a.csv"
    result = CliRunner().invoke(
        app, ["export", str(recording.path), "-o", str(path), "--channel", "body2", "--to", "0.1"]
    )
    assert result.exit_code == 0
    assert f"wrote {path}" in result.output
    assert len(path.read_text(encoding="utf-8").splitlines()) == 1 + 0.1 * RATE  # header and samples


def test_exported_matlab_file_imports_equal(recording, tmp_path):
    progress = []
    export(Slice.of(recording), tmp_path / "a.mat", progress=lambda done, total: progress.append((done, total)))
    assert progress[-1] == (2 * SAMPLES, 2 * SAMPLES)
    scene_of_import = recording.scene.replace(converter={"rate": RATE}, recording={}, test=None)
    with (
        pytest.warns(daq.RunWarning, match="no signal for the channels body3, table"),
        pytest.warns(daq.RunWarning, match="no channel measures the force on the structure"),
    ):
        path = daq.import_files(tmp_path / "a.mat", scene_of_import, tmp_path / "again.mcap")
    with daq.open(path) as imported:
        for name in recording.channels:
            np.testing.assert_allclose(imported.read(name), recording.read(name), rtol=1e-14)
        assert imported.rate == RATE


@pytest.mark.parametrize("form", ["csv", "npz", "mat", "wav", "uff"])
def test_size_is_estimated_before_export(form, recording, tmp_path):
    export(Slice.of(recording), tmp_path / f"a.{form}")
    estimate = expected_bytes(Slice.of(recording), f".{form}")
    assert estimate == pytest.approx((tmp_path / f"a.{form}").stat().st_size, rel=0.3)


def test_exported_responses_and_modes_read_equal(tmp_path):
    # A downward sweep with five frequencies at each resonance.
    frequencies = np.ravel([np.linspace(1.006, 0.994, 5) * f for f in reversed(synthetic.NATURAL_FREQUENCIES)])
    path = synthetic.stepped_sine(tmp_path / "a.mcap", frequencies, noise=1e-6)
    curves = analysis.frfs(path)
    modes = analysis.identify(curves)
    for result_type, extension in (("frfs", "uff"), ("frfs", "mat"), ("modes", "uff"), ("modes", "mat")):
        export_results(path, tmp_path / f"{result_type}.{extension}", result_type)
    read_back = analysis.read_frfs(tmp_path / "frfs.uff")
    order = np.argsort(curves["body3"].frequency)
    np.testing.assert_allclose(read_back["body3"].value, curves["body3"].value[order], rtol=1e-10)
    assert sets_of(tmp_path / "frfs.uff", 58)[0]["ref_node"] == 1
    sets = sets_of(tmp_path / "modes.uff", 55)
    np.testing.assert_allclose([abs(data_set["eig"]) / (2 * np.pi) for data_set in sets], modes.frequency, rtol=1e-5)
    np.testing.assert_allclose(sets[0]["r3"], modes.shapes[:, 0], atol=1e-5)
    assert sets[0]["node_nums"].tolist() == [1, 2, 3]
    again = analysis.read_modes(tmp_path / "modes.uff")
    assert again.responses == ("1 +Z", "2 +Z", "3 +Z")
    np.testing.assert_allclose(again.damping, modes.damping, rtol=1e-4)
    np.testing.assert_allclose(analysis.mac(again.shapes, modes.shapes).diagonal(), 1.0, rtol=1e-6)
    matlab = loadmat(tmp_path / "frfs.mat", squeeze_me=True)
    np.testing.assert_array_equal(matlab["body3"], curves["body3"].value[order])
    np.testing.assert_allclose(analysis.read_frfs(tmp_path / "frfs.mat")["body3"].value, matlab["body3"], rtol=1e-12)
    np.testing.assert_array_equal(loadmat(tmp_path / "modes.mat")["damping_ratio"].ravel(), modes.damping)
    (tmp_path / "frfs.mat").write_bytes(b"mine")
    with pytest.raises(SceneError, match=r"frfs\.mat exists"):
        export_results(path, tmp_path / "frfs.mat", "frfs")
    with pytest.raises(SceneError, match="unknown format"):
        export_results(path, tmp_path / "modes.csv", "modes")


@pytest.mark.parametrize("name", ["=1+1", "+1", "@SUM(A1)", "-body", "'=1", "'body"])
def test_csv_has_no_formulas(tmp_path, name):
    infos = [ChannelInfo(name, "body 1", "displacement", 500.0, RATE), two_channels()[1]]
    with Recorder(tmp_path / "a.mcap", make_scene(), infos, RATE) as recorder:
        recorder.write(random_volts(100))
    with daq.open(tmp_path / "a.mcap") as recording:
        export(Slice.of(recording), tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as stream:
        head = next(csv.reader(stream))
    assert not any(cell.startswith(("=", "+", "-", "@")) for cell in head)
    # Import reads the original name.
    with contextlib.ExitStack() as stack:
        assert [signal.name for signal in signals_of(tmp_path / "a.csv", stack)] == [name, "body2"]


def test_universal_file_states_units_and_geometry(recording, tmp_path):
    export(Slice.of(recording), tmp_path / "a.uff")
    path = tmp_path / "a.uff"
    assert [data_set["type"] for data_set in pyuff.UFF(str(path)).read_sets()][:4] == [151, 164, 15, 82]
    (units,), (nodes,), (line,) = (sets_of(path, kind) for kind in (164, 15, 82))
    assert (units["units_code"], units["length"], units["force"]) == (1, 1.0, 1.0)
    bodies = sorted({info.body for info in recording.channels.values() if info.body})
    assert list(nodes["node_nums"]) == list(nodes["z"]) == list(line["nodes"]) == bodies
