"""Recordings of the reproduction are reused if the same version of the program made them."""

from pathlib import Path

import pytest

import daq.core.recording.recorder  # noqa: F401 - reads its version when it is imported
import rig
from analysis.studies.paper.experiment import open_or_record


def test_recording_of_another_version_is_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = rig.load("fig10b-no-damper", {"test.repeats": 1, "test.interval": "0.3 s"})
    path, files = tmp_path / "hit.mcap", []
    for is_updated in (False, False, True):
        if is_updated:
            monkeypatch.setattr("importlib.metadata.version", lambda _: "another version")
        open_or_record(scene, path).close()
        files.append(path.stat().st_ino)
    assert files[0] == files[1] != files[2]
