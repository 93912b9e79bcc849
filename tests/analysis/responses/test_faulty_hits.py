"""Double and clipped hits are named in the results of hammer tests, recorded or imported."""

import warnings
from pathlib import Path

import pytest

import analysis
import daq
import rig
from analysis.core.recordings.slices import Slice
from analysis.extras.formats.export import export

SCENE = """
structure: {masses: [4.2 kg, 1.1 kg], springs: [839.2 kN/m, 964.4 kN/m], damping: {modal: 0.8 %}}
shaker: {kind: force, body: 1}
test:
  {kind: impulse, body: 1, peak: 50 N, width: 1 ms, repeats: 3, interval: 1 s,
  double_hit: {hits: [2], after: 25 ms, ratio: 0.5}}
channels: [{name: hammer, at: hammer}, {name: low, at: body 1}, {name: high, at: body 2}]
converter: {rate: 5120 Hz, filter: delta_sigma}
recording: {display: false}
"""


@pytest.fixture(scope="module")
def double_hit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return daq.record(rig.loads(SCENE, where="a test"), tmp_path_factory.mktemp("hits") / "a.mcap")


def test_double_hit_is_named_in_results(double_hit: Path) -> None:
    text = "Faulty impacts: impact 2 double."
    frfs = analysis.frfs(double_hit)
    assert text in frfs.warnings and text in analysis.identify(frfs).warnings
    assert any(text in line for line in daq.info(double_hit).lines)
    assert any("Impact 2 was double" in note for note in analysis.decay(double_hit, "low", impact=2).warnings)
    assert not any("double" in note for note in analysis.decay(double_hit, "low", impact=1).warnings)


def test_double_hit_of_imported_file_is_named(double_hit: Path, tmp_path: Path) -> None:
    with daq.open(double_hit) as recording:
        scene = recording.scene
        export(Slice.of(recording), tmp_path / "a.npz")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        imported = daq.import_files(tmp_path / "a.npz", scene, tmp_path / "b.mcap")
    assert any("impact 2: double" in str(warning.message) for warning in caught)
    assert "Faulty impacts: impact 2 double." in analysis.frfs(imported).warnings
