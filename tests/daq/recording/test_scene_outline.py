"""Facts of the recorded scene that describe a recording without loading the scene."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import daq
import rig
from daq.recording.scene_outline import SceneOutline


@pytest.mark.parametrize("name", ["fig8-three-dampers", "fig10b-no-damper", "bare-structure", "reference-A"])
def test_outline_survives_metadata(name: str) -> None:
    outline = SceneOutline.of(rig.load(name))
    assert SceneOutline.from_metadata(outline.to_metadata()) == outline


def test_outline_names_bodies() -> None:
    scene = rig.loads("structure: {masses: {base: 4 kg, arm: 1 kg}, springs: [1 kN/m, 1 kN/m]}")
    outline = SceneOutline.of(scene)
    assert [outline.label(place) for place in ("body 1", "body 2", "table")] == ["base", "arm", "table"]


def test_recording_without_facts_takes_scene_outline(tmp_path: Path) -> None:
    scene = rig.load("fig10b-no-damper", {"test.repeats": 1, "test.interval": "0.3s"})
    with daq.open(daq.record(scene, tmp_path / "hit.mcap")) as recording:
        assert recording.outline == SceneOutline.of(scene)
        del recording.metadata["run"]["dampers"], recording.outline
        assert recording.outline == SceneOutline.of(scene)


def test_info_loads_no_scene(tmp_path: Path) -> None:
    scene = rig.load("fig10b-no-damper", {"test.repeats": 1, "test.interval": "0.3s"})
    path = daq.record(scene, tmp_path / "hit.mcap")
    code = (
        "import sys\nfrom daq.cli import app\napp(sys.argv[1:], standalone_mode=False)\n"
        "assert not {'rig.scene.scene', 'numba', 'scipy.linalg'} & set(sys.modules)"
    )
    ended = subprocess.run([sys.executable, "-c", code, "info", str(path)], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert "analysis decay" in ended.stdout
