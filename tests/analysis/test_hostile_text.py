"""All commands display text of a recording as it is: it is not interpreted as markup or control codes."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

import analysis.commands.cli
import daq
import daq.commands.cli
from daq.core.recording.recorder import Recorder
from daq.extras.viewer.description import markdown_page
from daq.extras.viewer.replay import Replay
from tests.analysis.responses import synthetic

MARKUP = "<script>alert(1)</script> **b** [x](http://x) `c` $\\frac$ |d|"
CONTROL_CODES = "\x1b[31mred\x1b]0;title\x07\r\u202e"
# Commands that print or write texts of recordings.
TESTED_COMMANDS = {
    "daq": ("info r.mcap", "recover r.mcap -o fixed.mcap"),
    "analysis": (
        "frf r.mcap",
        "decay r.mcap",
        "modes r.mcap",
        "report r.mcap",
        "srs r.mcap",
        "export r.mcap -o r.csv",
        "export r.mcap -o r.uff",
    ),
}
EXEMPT_COMMANDS = {
    "daq": {"bench", "record", "replay", "run", "serve", "import"},
    "analysis": {
        "dampers",
        "beds",
        "contacts",
        "demo",
        "cost",
        "paper",
        "compare",
        "fit",
        "profile",
        "backbone",
        "continuation",
        "surface",
    },
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a recording with markup and control codes in its name, data sheets, markers and status."""
    folder = tmp_path_factory.mktemp("hostile")
    synthetic.impulses(folder / "plain.mcap", interval=1.0, name="plain")
    with daq.open(folder / "plain.mcap") as source:
        infos = [
            type(info)(**{**vars(info), "sensor": {"model": CONTROL_CODES + MARKUP}})
            for info in source.channels.values()
        ]
        scene = source.scene.replace(name=MARKUP)
        samples = np.array([source.read(name) * info.sensitivity for name, info in source.channels.items()])
        with Recorder(folder / "r.mcap", scene, infos, source.rate) as recorder:
            recorder.write(samples)
            for mark in source.markers:
                recorder.mark(mark.kind, mark.first_sample, mark.last_sample, **mark.fields)
            recorder.mark("abort", 10, reason=CONTROL_CODES + MARKUP)
            recorder.mark(CONTROL_CODES + MARKUP, 20)
            recorder.close("failed", CONTROL_CODES + MARKUP)
    (folder / "plain.mcap").unlink()
    return folder


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("package", "command"),
    [(package, command) for package, commands in TESTED_COMMANDS.items() for command in commands],
)
def test_commands_print_no_control_codes(folder, package, command, monkeypatch, capsys):
    before = set(folder.iterdir())
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", [package, *command.split()])
    with pytest.raises(SystemExit) as exit_request:
        (daq if package == "daq" else analysis).commands.cli.main()
    printed = capsys.readouterr()
    assert exit_request.value.code == 0, printed.err
    texts = [printed.out, printed.err]
    texts += [
        path.read_text("utf-8") for path in set(folder.iterdir()) - before if path.suffix not in (".png", ".mcap")
    ]
    for text in texts:
        assert not re.search("[\x00-\x08\x0b-\x1f\x7f\x9b\u202e]", text.replace("\r\n", "\n"))


def test_page_escapes_hostile_text(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["analysis", "report", "r.mcap"])
    with pytest.raises(SystemExit):
        analysis.commands.cli.main()
    page = next(folder.glob("*report.html")).read_text("utf-8")
    # The page's own scripts: libraries, and the data of each chart.
    assert "<script>alert" not in page and "&lt;script&gt;" in page


def test_replay_escapes_hostile_text(folder: Path) -> None:
    with daq.open(folder / "r.mcap") as recording:
        replay = Replay(recording)
        page = markdown_page(recording, replay.motion, replay.view)
    prose, _, scene = page.partition("```yaml")
    assert "<script>" not in prose.replace("\\<", "") and "\x1b" not in page and scene.count("```") == 1


def test_every_command_is_tested_or_exempt() -> None:
    for package, app in (("daq", daq.commands.cli.app), ("analysis", analysis.commands.cli.app)):
        names = {
            command.name or str(command.callback.__name__) for command in app.registered_commands if command.callback
        }
        tested_names = {tested.split()[0] for tested in TESTED_COMMANDS[package]}
        assert names <= tested_names | EXEMPT_COMMANDS[package]
