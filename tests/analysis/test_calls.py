"""The `analysis` commands as Python functions: their results equal the written files and can be plotted."""

import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from typer.testing import CliRunner

import analysis
import daq
import rig
from analysis.commands.cli import app
from rig.core.base.errors import RecordingError
from tests.analysis.responses import synthetic

BARE = Path("recordings/demo-sweep-no-damper.mcap")
DAMPED = Path("recordings/demo-sweep-three-dampers.mcap")


@pytest.fixture
def axes():
    figure, axes = plt.subplots()
    yield axes
    plt.close(figure)


def test_frf_table_contains_all_recordings(axes):
    with daq.open(DAMPED) as rec:
        result = analysis.frf([BARE, rec], ["body3"])
    assert [each.keys() for each in result] == [("body3",), ("body3",)]
    columns = result.columns()
    assert {len(column) for column in columns.values()} == {sum(each.frequency.size for each in result)}
    assert np.unique(columns["label"]).size == 2
    result.plot(axes)
    assert len(axes.get_legend().get_texts()) == 2 and result[1].label in result._repr_html_()
    assert [row[0] for row in result.table().rows] == [result[0].label, "body3", result[1].label, "body3"]


def test_modes_of_two_recordings_are_compared_by_mac():
    result = analysis.modes([BARE, DAMPED], modes=3)
    natural_frequencies = [13.04, 34.78, 49.66]  # of the scene, Hz
    assert result[0].frequency == pytest.approx(natural_frequencies, rel=1e-3)
    assert np.diag(analysis.mac(result[0].shapes, result[1].shapes)).min() > 0.99


@pytest.mark.usefixtures("undrawn_figures")
def test_dampers_returns_rows_of_the_command(tmp_path, axes):
    test = {"kind": "stepped_sine", "frequencies": [48.6, 49.0], "force": 3.3, "measure": {"periods": 25}}
    path = daq.record(rig.load("fig9").replace(test=test), tmp_path / "fig9.mcap")
    [result] = analysis.dampers(path)
    assert CliRunner().invoke(app, ["dampers", str(path), "-o", str(tmp_path)]).exit_code == 0
    [table] = tmp_path.glob("*.csv")
    with table.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    columns = result.columns()
    assert [row["motion"] for row in rows] == columns["motion"].tolist()
    assert [float(row["dampers_J"]) for row in rows] == pytest.approx(columns["dampers_J"].tolist(), rel=1e-8)
    result.plot(axes)
    largest = np.nanargmax(columns["dampers_J"])
    assert f"dissipate most at {columns['frequency_Hz'][largest]:.4g} Hz" in result.summary()


def test_compare_returns_the_changes_of_the_peaks(axes):
    result = analysis.compare([BARE, DAMPED])
    assert result.columns()["change_dB"].size == len(result.changes) > 0
    result.plot(axes)
    assert f"of {len(result.changes)} resonance peaks changed" in result.summary()


def test_export_and_report_return_their_files(tmp_path):
    target = analysis.export(BARE, tmp_path / "a.npz", ["body1"], to_s=1.0)
    assert target.exists()
    hit = synthetic.impulses(tmp_path / "hit.mcap", interval=1.0)
    page = analysis.report(hit, tmp_path / "page.html")
    assert page == tmp_path / "page.html" and page.exists()


def test_dampers_rejects_a_file_of_responses(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("frequency,real,imag\n1,1,0\n", encoding="utf-8")
    with pytest.raises(RecordingError, match=r"a\.csv.*frequency responses"):
        analysis.dampers(path)
