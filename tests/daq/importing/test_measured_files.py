"""Measured files of other people: each is read, or refused in one sentence with the remedy."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

import analysis
import daq
import rig
from daq.extras.importing.channel_table import Column
from daq.extras.importing.files import signals_of
from rig.core.base.errors import RecordingError

FOLDER = Path(__file__).parents[4] / "shared" / "data" / "measured"
pytestmark = [
    pytest.mark.skipif(not FOLDER.is_dir(), reason="the measured files are absent"),
    pytest.mark.filterwarnings("ignore"),
]
# Number of signals of the files with time histories, and refusals of the others.
SIGNALS = {"d7.lvm": 6, "1.tdms": 8, "2.tdms": 21, "Sample_UFF58_ascii.uff": 1, "Sample_UFF58b_bin.uff": 1} | {
    f"m{number}.npy": 2 for number in range(1, 6)
}
REFUSALS = {
    "Artemis-export---Geometry-RPBC_setup_05_14102016_105117.uff": "Export time histories or frequency responses",
    "ruler_grid_acc_3.mat": "give the file to `analysis frf`",
    "uff55_translation.uff": "Export time histories or frequency responses as data set 58",
    "uff55-sample_test-record10.uff": "Export time histories or frequency responses as data set 58",
    "groups_test.uff": "Export time histories or frequency responses as data set 58",
    "heat_engine_housing.uff": "Export time histories or frequency responses as data set 58",
    "TestLab-161-164-18-15-82.uff": "Export time histories or frequency responses as data set 58",
    "sample_dataset58_psd.uff": "Export time histories",
    "non_ascii_header.uff": "Give its frequency responses to",
}


def file_of(name: str) -> Path:
    return next(FOLDER.glob(f"*/{name}"))


@pytest.mark.parametrize(("name", "count"), SIGNALS.items())
def test_time_histories_are_listed(name: str, count: int) -> None:
    with ExitStack() as stack:
        assert len(signals_of(file_of(name), stack)) == count


@pytest.mark.parametrize(("name", "remedy"), REFUSALS.items())
def test_other_files_are_refused_with_remedy(name: str, remedy: str) -> None:
    with ExitStack() as stack, pytest.raises(RecordingError, match=remedy):
        signals_of(file_of(name), stack)


def test_every_file_is_covered() -> None:
    assert {file.name for file in FOLDER.glob("*/*")} == {*SIGNALS, *REFUSALS}


def test_array_of_responses_is_read() -> None:
    responses = analysis.read_frfs(file_of("ruler_grid_acc_3.mat"), unit="m/s^2/N")
    assert len(responses.keys()) == 10 and responses.frequency[-1] == 10_000.0


def test_measured_modes_do_not_depend_on_band() -> None:
    responses = list(analysis.read_frfs(file_of("ruler_grid_acc_3.mat"), unit="m/s^2/N"))
    narrow, wide = (analysis.identify([each.band(*band) for each in responses]) for band in ((155, 250), (60, 300)))
    assert narrow.frequency[0] in wide.frequency and narrow.damping_std[0] in wide.damping_std
    assert abs(narrow.frequency[0] - 212.2) < 0.3


def test_response_with_foreign_heading_is_read() -> None:
    assert analysis.read_frfs(file_of("non_ascii_header.uff")).frequency.size == 5


def test_measured_hits_give_their_peaks(tmp_path: Path) -> None:
    scene = rig.loads(
        "structure: {masses: [1 kg], springs: [1 MN/m], damping: {dashpots: [20 N s/m]}}\n"
        "test: {kind: impulse, body: 1, peak: 100 N, width: 0.2 ms}\n"
        "channels: [{name: force, at: hammer}, {name: tip, at: body 1}]\n"
    )
    table = {"force": Column("array(2)", unit="N"), "tip": Column("array(3)", unit="m/s^2")}
    files = [file_of(f"m{number}.npy") for number in range(1, 6)]
    frf = analysis.frfs(daq.import_files(files, scene, tmp_path / "hits.mcap", table=table))["tip"]
    for peak in (810.0, 900.0, 2640.0):
        band = frf.band(peak - 20.0, peak + 20.0)
        spacing = np.diff(band.frequency).max()
        assert abs(band.frequency[abs(band.value).argmax()] - peak) <= spacing


@pytest.mark.parametrize(
    ("name", "frequencies", "points"),
    [("uff55_translation.uff", 3, "+X"), ("uff55-sample_test-record10.uff", 1, "60101 +Z")],
)
def test_modes_of_other_programs_are_read(name: str, frequencies: int, points: str) -> None:
    modes = analysis.read_modes(file_of(name))
    assert modes.frequency.size == frequencies and any(points in response for response in modes.responses)
    assert "unknown" not in modes.summary() and "nan" not in modes.summary()
