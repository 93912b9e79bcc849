"""The `daq` commands as Python functions: signatures, results and errors."""

import inspect
from pathlib import Path

import pytest

import daq
import rig
from rig.core.base.errors import SceneError

COMMANDS = ("record", "import_", "info", "recover", "replay", "serve", "bench", "run")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = rig.load("fig10b-no-damper", {"test.repeats": 1, "test.interval": "0.5s"})
    return daq.record(scene, tmp_path_factory.mktemp("surface") / "hit.mcap")


@pytest.mark.parametrize("name", COMMANDS)
def test_command_is_a_documented_call(name: str) -> None:
    call = getattr(daq, name)
    signature = inspect.signature(call)
    assert name in daq.__all__
    assert signature.return_annotation is not inspect.Signature.empty
    assert all(each.annotation is not inspect.Parameter.empty for each in signature.parameters.values())
    assert "Parameters\n" in inspect.getdoc(call)


def test_info_is_a_result_with_a_table(recording: Path) -> None:
    result = daq.info(recording, check=True)
    assert str(result).startswith(result.summary()) and result.checked
    assert result.columns()["name"].tolist() == ["body1", "body2", "body3", "hammer"]
    assert result.next_steps[0] == f"analysis decay {recording}"
    assert "body1" in result._repr_html_()
    assert len(result.plot().lines) == 4


def test_replay_returns_the_file_it_writes(recording: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    path = daq.replay(recording, save=tmp_path / "a.rrd", to_s=0.1, announce=lines.append)
    assert path == tmp_path / "a.rrd" and path.stat().st_size > 0
    assert "rerun" in lines[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"save": "a.rrd", "web": True}, "choose one of"),
        ({"at": 1.0}, "`screenshot`"),
        ({"screenshot": "a.png", "speed": 2.0}, "`speed`"),
    ],
)
def test_contradicting_replay_options_are_rejected(recording: Path, options, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        daq.replay(recording, **options)
