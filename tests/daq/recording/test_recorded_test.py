"""The kind of a recorded test, stated in its metadata or deduced from its markers, and the outline of its scene."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

import daq
import rig
from daq.core.recording.recorded_test import SceneOutline, TestKind, kind_of_settings
from daq.core.recording.recorder import Recorder
from tests.analysis.responses import synthetic

RECORDINGS = Path(__file__).parents[3] / "recordings"
SHORT_TESTS = {
    TestKind.TONES: "{kind: sine, frequency: 20 Hz, duration: 0.2 s, force: 1 N}",
    TestKind.SWEEP: "{kind: swept_sine, from: 20 Hz, to: 40 Hz, duration: 0.2 s, drive: 0.1 mm}",
    TestKind.HITS: "{kind: impulse, body: 1, peak: 50 N, width: 4 ms, interval: 0.2 s}",
    TestKind.FREE: "{kind: free, displacement: [1 mm, 0 mm, 0 mm], duration: 0.2 s}",
}


@pytest.mark.filterwarnings("ignore::daq.RunWarning")
@pytest.mark.parametrize("kind", SHORT_TESTS)
def test_recording_contains_the_kind_of_its_test(kind, tmp_path):
    scene = rig.load("bare-structure", {"test": yaml.safe_load(SHORT_TESTS[kind])})
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as recording:
        assert recording.metadata["run"]["kind"] == kind == recording.test.kind
        assert recording.test.settings == scene.test


@pytest.mark.parametrize(("name", "kind"), [("sweep", TestKind.TONES), ("impulse", TestKind.HITS)])
def test_kind_of_older_recording_follows_from_markers(name, kind):
    with daq.open(RECORDINGS / f"demo-{name}-no-damper.mcap") as recording:
        assert "kind" not in recording.metadata["run"]
        assert recording.test.kind is kind


@pytest.mark.parametrize(
    ("marker", "fields", "kind"),
    [
        ("measure", {"frequency": 20.0}, TestKind.TONES),
        ("measure", {"from": 5.0, "to": 60.0}, TestKind.RANDOM),
        ("measure", {"from": 5.0, "to": 60.0, "spacing": "linear"}, TestKind.SWEEP),
        ("measure", {"from": 5.0, "to": 60.0, "realisation": 1}, TestKind.MULTISINE),
        ("hit", {}, TestKind.HITS),
        ("note", {}, TestKind.NONE),
    ],
)
def test_unstated_kind_follows_from_markers(marker, fields, kind, tmp_path):
    scene = rig.load("bare-structure", {"test": None})
    with Recorder(tmp_path / "a.mcap", scene, synthetic.channels(), synthetic.RATE) as recorder:
        recorder.write(np.zeros((len(synthetic.channels()), 512)))
        recorder.mark(marker, 0, 255, **fields)
    with daq.open(tmp_path / "a.mcap") as recording:
        assert recording.test.kind is kind


def test_scene_without_test_is_of_no_kind():
    assert kind_of_settings(None) is TestKind.NONE


@pytest.mark.parametrize("name", ["fig8-three-dampers", "fig10b-no-damper", "bare-structure", "reference-A"])
def test_outline_survives_metadata(name: str) -> None:
    outline = SceneOutline.of(rig.load(name))
    assert SceneOutline.from_metadata(outline.to_metadata()) == outline


def test_outline_names_bodies() -> None:
    scene = rig.loads("structure: {masses: {base: 4 kg, arm: 1 kg}, springs: [1 kN/m, 1 kN/m]}")
    outline = SceneOutline.of(scene)
    assert [outline.label(point) for point in ("body 1", "body 2", "table")] == ["base", "arm", "table"]


def test_recording_without_outline_computes_it_from_scene(tmp_path: Path) -> None:
    scene = rig.load("fig10b-no-damper", {"test.repeats": 1, "test.interval": "0.3s"})
    with daq.open(daq.record(scene, tmp_path / "hit.mcap")) as recording:
        assert recording.outline == SceneOutline.of(scene)
        del recording.metadata["run"]["dampers"], recording.outline
        assert recording.outline == SceneOutline.of(scene)


def test_info_loads_no_scene(tmp_path: Path) -> None:
    scene = rig.load("fig10b-no-damper", {"test.repeats": 1, "test.interval": "0.3s"})
    path = daq.record(scene, tmp_path / "hit.mcap")
    code = (
        "import sys\nfrom daq.commands.cli import app\napp(sys.argv[1:], standalone_mode=False)\n"
        "assert not {'rig.core.scene.scene', 'numba', 'scipy.linalg'} & set(sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code, "info", str(path)], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "analysis decay" in result.stdout
