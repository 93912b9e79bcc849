"""Recordings with different driven bodies or bands, and repeated files, are reported and not mixed."""

from __future__ import annotations

import csv
import re
import shutil
import warnings
from pathlib import Path

import pytest

import analysis
import daq
import rig
from analysis.exporting.results import export_results
from analysis.presentation.comparison import present_compare
from analysis.presentation.frf_findings import present_frf
from analysis.presentation.mode_findings import present_modes
from rig.errors import SceneError

BRACKET = """\
name: bracket
structure: {masses: [4.2 kg, 1.1 kg], springs: [900 kN/m, 900 kN/m], damping: {modal: 0.8 %}}
shaker: {kind: force, body: 1}
test: {kind: random, from: 20 Hz, to: 300 Hz, duration: 6 s, force: 5 N}
channels:
  - {name: base, at: body 1, accelerometer: {sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz)}}
  - {name: arm, at: body 2, accelerometer: {sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz)}}
  - {name: force, at: shaker, hammer: {sensitivity: 10 mV/N}}
converter: {rate: 2048 Hz, bits: 24, range: 5 V}
"""


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Recordings of the bracket: driven at its base, at its arm, and up to 150 Hz only."""
    folder = tmp_path_factory.mktemp("bracket")
    (folder / "bracket.yaml").write_text(BRACKET, encoding="utf-8")
    changes = {"base": {}, "arm": {"shaker.body": 2}, "low": {"test.to": "150 Hz"}}
    paths = {}
    for name, change in changes.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", daq.RunWarning)
            paths[name] = daq.record(rig.load(folder / "bracket.yaml", change), folder / f"{name}.mcap")
    return paths


def test_different_inputs_get_axes_of_their_own(bracket: dict[str, Path], tmp_path: Path) -> None:
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


def test_modes_name_their_input(bracket: dict[str, Path], tmp_path: Path) -> None:
    result = present_modes([bracket["arm"]], tmp_path)
    assert result.lines[0] == "bracket, force at body 2: 2 modes"


def test_exported_responses_keep_their_input(bracket: dict[str, Path], tmp_path: Path) -> None:
    export_results(bracket["arm"], tmp_path / "arm.uff", "frfs")
    curves = analysis.read_frfs(tmp_path / "arm.uff")
    assert [curve.ratio for curve in curves] == ["base / force at body 2", "arm / force at body 2"]
    assert [curve.is_driving_point for curve in curves] == [False, True]


def test_a_mode_outside_the_other_band_names_it(bracket: dict[str, Path], tmp_path: Path) -> None:
    result = present_compare([bracket["base"], bracket["low"]], tmp_path)
    assert any("165.8" in line and "low.mcap was measured from 20 to 150 Hz" in line for line in result.lines)


def test_a_copy_is_reported_and_never_fitted(bracket: dict[str, Path], tmp_path: Path) -> None:
    copy = tmp_path / "copy.mcap"
    shutil.copy(bracket["base"], copy)
    for present in (present_frf, present_compare):
        assert any("the same content as" in warning for warning in present([bracket["base"], copy], tmp_path).warnings)
    with pytest.raises(SceneError, match="count twice"):
        analysis.fit([bracket["base"], copy], str(bracket["base"].with_name("bracket.yaml")))


def test_reversed_force_is_reported(bracket: dict[str, Path], tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from analysis.cli import app
    from daq.importing.channel_table import Column

    table = tmp_path / "base.csv"
    assert CliRunner().invoke(app, ["export", str(bracket["base"]), "-o", str(table)]).exit_code == 0
    scene = rig.load(bracket["base"].with_name("bracket.yaml"))
    for sign, count in ((1, 0), (-1, 1)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", daq.RunWarning)
            columns = {"force": Column("force", sign=sign)}
            path = daq.import_files(table, scene, tmp_path / f"{count}.mcap", table=columns)
        assert sum("reversed channel" in str(warning.message) for warning in caught) == count
        for present in (present_frf, present_modes):
            reported = [warning for warning in present([path], tmp_path).warnings if "reversed" in warning]
            assert len(reported) == count
