"""Options without effect are rejected before any work."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from daq.cli import app
from rig.errors import RecordingError, SceneError


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("import run.csv --table channels.yaml", "--scene"),
        ("import run.csv --from 1", "--scene"),
        ("import run.csv -o run.mcap --overwrite", "--scene"),
        ("replay r.mcap --save x.rrd --at 1", "requires --screenshot"),
        ("replay r.mcap --at 1", "requires --screenshot"),
        ("replay r.mcap --screenshot x.png --speed 2", "combined with --screenshot"),
        ("serve fig9 --overwrite", "Give its name with -o"),
        ("serve --set seed=1", "--set requires a scene"),
    ],
)
def test_ineffective_option_names_what_it_needs(words, message):
    ended = CliRunner().invoke(app, words.split())
    if not isinstance(ended.exception, SceneError):
        assert ended.exit_code == 2
    assert message in " ".join(f"{ended.output} {ended.exception}".replace("│", " ").split())


@pytest.mark.parametrize(
    "words",
    ["record fig9 -o a.csv", "import x.csv --scene fig9 -o a.UFF", "recover a.mcap -o a.npz", "scope fig9 -o a.rrd"],
)
def test_recording_with_other_extension_is_rejected(words):
    ended = CliRunner().invoke(app, words.split())
    assert isinstance(ended.exception, RecordingError)
    assert "expected a name such as a.mcap" in str(ended.exception)
