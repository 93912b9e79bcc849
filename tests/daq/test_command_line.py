"""Options of `daq` commands that are invalid, or would have no effect, are rejected; the message names the option."""

import pytest
from typer.testing import CliRunner

from daq.commands.cli import app
from rig.core.base.errors import RecordingError, SceneError


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("import run.csv --table channels.yaml", "require --scene"),
        ("import run.csv --from 1", "require --scene"),
        ("import run.csv -o run.mcap --overwrite", "require --scene"),
        ("replay r.mcap --save x.rrd --at 1", "requires `screenshot`"),
        ("replay r.mcap --at 1", "requires `screenshot`"),
        ("replay r.mcap --screenshot x.png --speed 2", "combined with `screenshot`"),
        ("serve fig9 --overwrite", "--overwrite requires -o"),
        ("serve --set seed=1", "--set requires a scene"),
        ("serve --port 65536", "--port: 65536 is out of range"),
        ("bench --port 65536", "--port: 65536 is out of range"),
        ("bench --device-port 65536", "--device-port: 65536 is out of range"),
    ],
)
def test_error_of_ineffective_or_invalid_option_names_option(command, message):
    result = CliRunner().invoke(app, command.split())
    if not isinstance(result.exception, SceneError):
        assert result.exit_code == 2
    assert message in " ".join(f"{result.output} {result.exception}".replace("│", " ").split())


@pytest.mark.parametrize(
    "command", ["record fig9 -o a.csv", "import x.csv --scene fig9 -o a.UFF", "recover a.mcap -o a.npz"]
)
def test_recording_with_other_extension_is_rejected(command):
    result = CliRunner().invoke(app, command.split())
    assert isinstance(result.exception, RecordingError)
    assert "expected a name such as a.mcap" in str(result.exception)


@pytest.mark.parametrize("command", ["record fig9", "serve fig9", "bench fig9"])
def test_several_missing_folders_are_rejected(command, tmp_path):
    result = CliRunner().invoke(app, [*command.split(), "-o", str(tmp_path / "missing" / "runs" / "a.mcap")])
    assert isinstance(result.exception, RecordingError)
    assert "missing. Create it first, or correct the path" in str(result.exception)
    assert not (tmp_path / "missing").exists()
