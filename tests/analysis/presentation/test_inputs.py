"""Recordings that cannot be combined (they differ in driven body, band or channels, or are copies) are reported or
kept separate."""

import csv
import re
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import analysis
import daq
import rig
from analysis.commands.cli import app
from analysis.commands.presentation.comparison import MeasurementPoints, present_compare
from analysis.commands.presentation.frf_findings import present_frf, stated_tolerances
from analysis.commands.presentation.inputs import check_recording
from analysis.commands.presentation.mode_findings import present_modes
from analysis.extras.formats.results import export_results
from daq.extras.importing.channel_table import Column
from rig.core.base.errors import RecordingError, SceneError
from rig.core.results.uncertainty import SENSITIVITY
from tests.analysis.responses import synthetic

BRACKET = """\
name: bracket
structure: {masses: [4.2 kg, 1.1 kg], springs: [900 kN/m, 900 kN/m], damping: {modal: 0.8 %}}
shaker: {kind: force, body: 1}
test: {kind: random, from: 20 Hz, to: 300 Hz, duration: 2 s, force: 5 N}
channels:
  - {name: base, at: body 1, accelerometer: {sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz)}}
  - {name: arm, at: body 2, accelerometer: {sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz)}}
  - {name: force, at: shaker, hammer: {sensitivity: 10 mV/N}}
converter: {rate: 2048 Hz, bits: 24, range: 5 V}
"""


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return recordings of the bracket: driven at its base, driven at its arm, and driven up to 150 Hz only."""
    folder = tmp_path_factory.mktemp("bracket")
    (folder / "bracket.yaml").write_text(BRACKET, encoding="utf-8")
    changes = {"base": {}, "arm": {"shaker.body": 2}, "low": {"test.to": "150 Hz"}}
    paths = {}
    for name, change in changes.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", daq.RunWarning)
            paths[name] = daq.record(rig.load(folder / "bracket.yaml", change), folder / f"{name}.mcap")
    return paths


@pytest.mark.usefixtures("undrawn_figures")
def test_responses_to_different_inputs_have_separate_figures(bracket: dict[str, Path], tmp_path: Path) -> None:
    result = present_frf([bracket["base"], bracket["arm"]], tmp_path)
    assert re.findall(r"force at body \d", " ".join(result.lines)) == ["force at body 1", "force at body 2"]
    pictures = {path.stem: path.read_text(encoding="utf-8") for path in result.files if path.suffix == ".svg"}
    assert len(pictures) == 4
    assert "arm / force at body 1" in pictures["base+arm-frf-arm-by-force-at-body-1"]
    rows = csv.DictReader(result.files[-1].read_text(encoding="utf-8").splitlines())
    assert {(row["scene"], row["reference"]) for row in rows} == {
        ("base", "force at body 1"),
        ("arm", "force at body 2"),
    }


@pytest.mark.usefixtures("undrawn_figures")
def test_modes_name_their_input(bracket: dict[str, Path], tmp_path: Path) -> None:
    result = present_modes([bracket["arm"]], tmp_path)
    assert result.lines[0] == "bracket, force at body 2: 2 modes"


@pytest.mark.usefixtures("undrawn_figures")
def test_warnings_of_modes_name_their_sweep(tmp_path: Path) -> None:
    near_resonances = np.ravel([np.linspace(0.98, 1.02, 9) * f for f in synthetic.NATURAL_FREQUENCIES])
    frequencies = np.unique(np.append(near_resonances, np.arange(8.0, 60.0)))
    # Channels in a different order than the samples: the shapes match no mode of the scene.
    body1, body2, body3, table = synthetic.channels()
    path = synthetic.stepped_sine(
        tmp_path / "a.mcap", frequencies, level=(1.0, 2.0), noise=1e-6, infos=[body1, body3, body2, table]
    )
    mismatches = [warning for warning in present_modes([path], tmp_path).warnings if "matches no mode" in warning]
    assert [warning.split(": ")[:2] for warning in mismatches] == [["a.mcap", "1 N up"], ["a.mcap", "2 N up"]]


def test_exported_responses_keep_their_input(bracket: dict[str, Path], tmp_path: Path) -> None:
    export_results(bracket["arm"], tmp_path / "arm.uff", "frfs")
    curves = analysis.read_frfs(tmp_path / "arm.uff")
    assert [curve.ratio for curve in curves] == ["base / force at body 2", "arm / force at body 2"]
    assert [curve.is_driving_point for curve in curves] == [False, True]


@pytest.mark.usefixtures("undrawn_figures")
def test_mode_outside_the_other_band_is_explained(bracket: dict[str, Path], tmp_path: Path) -> None:
    result = present_compare([bracket["base"], bracket["low"]], tmp_path)
    # The second mode, at 165.8 Hz, is above the band of the second recording.
    assert any("165.8" in line and "low.mcap was measured from 20 to 150 Hz" in line for line in result.lines)


@pytest.mark.usefixtures("undrawn_figures")
def test_copy_is_reported_and_not_fitted(bracket: dict[str, Path], tmp_path: Path) -> None:
    copy = tmp_path / "copy.mcap"
    shutil.copy(bracket["base"], copy)
    for present in (present_frf, present_compare):
        assert any("the same content as" in warning for warning in present([bracket["base"], copy], tmp_path).warnings)
    with pytest.raises(SceneError, match="Give each recording once"):
        analysis.fit([bracket["base"], copy], str(bracket["base"].with_name("bracket.yaml")))


@pytest.mark.usefixtures("undrawn_figures")
def test_reversed_force_is_reported(bracket: dict[str, Path], tmp_path: Path) -> None:
    table = tmp_path / "base.csv"
    assert CliRunner().invoke(app, ["export", str(bracket["base"]), "-o", str(table)]).exit_code == 0
    scene = rig.load(bracket["base"].with_name("bracket.yaml"))
    for sign, n_warnings in ((1, 0), (-1, 1)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", daq.RunWarning)
            columns = {"force": Column("force", sign=sign)}
            path = daq.import_files(table, scene, tmp_path / f"{n_warnings}.mcap", table=columns)
        assert sum("channel is reversed" in str(warning.message) for warning in caught) == n_warnings
        for present in (present_frf, present_modes):
            assert sum("reversed" in warning for warning in present([path], tmp_path).warnings) == n_warnings


@pytest.mark.usefixtures("undrawn_figures")
def test_missing_filter_is_named_with_intervals(bracket: dict[str, Path], tmp_path: Path) -> None:
    table = tmp_path / "base.csv"
    assert CliRunner().invoke(app, ["export", str(bracket["base"]), "-o", str(table)]).exit_code == 0
    scene = rig.load(bracket["base"].with_name("bracket.yaml"))
    imported = daq.import_files(table, scene, tmp_path / "imported.mcap")
    recorded_text, imported_text = (present_frf([path], tmp_path).lines[-1] for path in (bracket["base"], imported))
    assert "calibration and the sample clock" in recorded_text and "aliasing" not in recorded_text
    assert imported_text.endswith("the sample clock and aliasing: no tolerance or filter is stated")


@pytest.mark.usefixtures("undrawn_figures")
def test_imported_sensors_have_assumed_tolerance(bracket: dict[str, Path], tmp_path: Path) -> None:
    table = tmp_path / "base.csv"
    assert CliRunner().invoke(app, ["export", str(bracket["base"]), "-o", str(table)]).exit_code == 0
    scene = rig.load(bracket["base"].with_name("bracket.yaml"))
    imported = daq.import_files(table, scene, tmp_path / "imported.mcap")
    output = present_frf([imported], tmp_path)
    assert sum("assumes sensors calibrated within 1 %" in warning for warning in output.warnings) == 1
    [frf] = analysis.frequency_responses(imported, ["arm"])[0]
    line = frf.peak_line()
    # The limits of two sensors: 2 * 1 % / sqrt(3) * sqrt(2).
    assert 0.016 <= frf.expanded()[line] / abs(frf.value[line]) < 0.021
    assert SENSITIVITY not in analysis.frequency_responses(bracket["base"], ["arm"])[0][0].limits


@pytest.mark.parametrize("calibration", [{}, {"sensitivity_tolerance": "1 %"}])
def test_advice_to_calibrate_only_for_presets(calibration, tmp_path: Path) -> None:
    scene = rig.loads(BRACKET, where="bracket").replace(
        channels=[
            {"name": "base", "at": "body 1", "accelerometer": {"preset": "PCB 352C33", **calibration}},
            {"name": "force", "at": "shaker", "hammer": {"preset": "PCB 208C02", **calibration}},
        ]
    )
    with daq.open(daq.record(scene, tmp_path / "calibrated.mcap")) as recording:
        [remark] = stated_tolerances(recording, analysis.frequency_responses(recording)[0].curves())
    assert ("If the sensors were calibrated" in remark) != bool(calibration)
    assert "0.5 % of it by transverse sensitivity" in remark


@pytest.mark.parametrize(
    ("test", "marker_kind", "command", "suggested"),
    [
        ("{kind: random, from: 5 Hz, to: 60 Hz, duration: 10 s, force: 1 N}", "measure", "decay", "analysis frf"),
        ("{kind: random, from: 5 Hz, to: 60 Hz, duration: 10 s, force: 1 N}", "measure", "dampers", "analysis frf"),
        ("{kind: free, mode: 1, amplitude: 5 mm, duration: 10 s}", None, "frf", "analysis decay"),
        ("{kind: free, mode: 1, amplitude: 5 mm, duration: 10 s}", None, "modes", "analysis decay"),
        ("{kind: impulse, body: 1, peak: 50 N, width: 4 ms}", "hit", "dampers", "analysis decay"),
    ],
)
def test_error_names_suitable_command_for_recording(tmp_path, test, marker_kind, command, suggested):
    undriven = test.startswith("{kind: free") or test.startswith("{kind: impulse")
    scene = synthetic.scene(test)
    scene = scene.replace(dampers=[{"body": 1, "mass_ratio": 0.1, "clearance": 1e-3}])
    if undriven:
        scene = scene.replace(shaker=None)
    path = tmp_path / "my test.mcap"
    marker_rows = [] if marker_kind is None else [(marker_kind, 0, 20, {})]
    synthetic.write(path, scene, synthetic.channels(), np.zeros((4, 64)), marker_rows)
    with daq.open(path) as rec, pytest.raises(RecordingError, match=f"{suggested} '.*my test.mcap'"):
        check_recording(rec, path, command)


FIRST = MeasurementPoints(Path("a.mcap"), (1,), {"base": "body 1", "tip": "body 3"})


def test_recordings_with_a_common_point_are_comparable() -> None:
    MeasurementPoints(Path("b.mcap"), (1,), {"tip": "body 3", "other": "body 2"}).comparable_with(FIRST)


@pytest.mark.parametrize(
    ("force_on", "channels", "message"),
    [
        ((3,), {"tip": "body 3"}, r"b\.mcap: driven at body 3, a\.mcap at body 1, .* on the same body"),
        ((1,), {"tip": "body 2"}, r"b\.mcap: tip is at body 2, but at body 3 in a\.mcap"),
        (
            (1,),
            {"top": "body 3"},
            r"b\.mcap: its responses are top \(at body 3\), but those of a\.mcap are base \(at body 1\), tip",
        ),
    ],
)
def test_different_measurement_points_are_explained(force_on, channels, message):
    with pytest.raises(SceneError, match=message):
        MeasurementPoints(Path("b.mcap"), force_on, channels).comparable_with(FIRST)


def test_sensors_of_both_recordings_are_listed() -> None:
    first = MeasurementPoints(Path("a.mcap"), (1,), {}, {"base": "one", "tip": "two"})
    second = MeasurementPoints(Path("b.mcap"), (1,), {}, {"base": "one", "tip": "another", "mid": "three"})
    assert second.same_sensors(first) == ["base"]
