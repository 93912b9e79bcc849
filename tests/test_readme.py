"""README's recipes as typed: sh and Python run; of what takes long or waits for a user, all options are read."""

from __future__ import annotations

import os
import re
import shlex
import warnings
from importlib import import_module
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import rig
from rig.scene.scene_files import bundled
from rig.scene.yaml_reader import read

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
PROGRAMS = ("rig", "daq", "analysis")


def commands(kind: str) -> list[list[str]]:
    lines = [
        shlex.split(line, comments=True)
        for name, block in BLOCKS
        if name == kind
        for line in block.splitlines()
    ]
    return [words for words in lines if words and words[0] in PROGRAMS]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with what the repository's has for a user: the recordings, and mine.yaml as README says."""
    (tmp_path / "recordings").mkdir()
    for file in (ROOT / "recordings").glob("*.mcap"):
        os.link(file, tmp_path / "recordings" / file.name)
    (own,) = (block for name, block in BLOCKS if name == "yaml" and block.startswith("name:"))
    (tmp_path / "mine.yaml").write_text(own, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    return tmp_path


@pytest.mark.thorough
def test_given_the_readme_when_its_commands_are_typed_then_each_does_what_it_says(folder) -> None:
    for words in commands("sh"):
        with warnings.catch_warnings():
            # Few points do not always settle, and the recording says so.
            warnings.simplefilter("ignore")
            done = CliRunner().invoke(import_module(f"{words[0]}.cli").app, words[1:])
        assert done.exit_code == 0, (words, done.output, done.exception)
        assert done.output, words
        if words[:2] == ["analysis", "compare"]:
            (quoted,) = re.findall(r"^    (.*) \.\.\.$", README, re.MULTILINE)
            assert quoted in done.output
    for made in ("sweep.mcap", "sweep-frf.png", "hit.mcap", "mine.mcap", "mine-frf.csv"):
        assert (folder / "recordings" / made).stat().st_size > 0


@pytest.mark.thorough
def test_given_the_readme_when_its_python_is_run_then_it_runs(folder) -> None:
    for name, block in BLOCKS:
        if name == "python":
            exec(compile(block, "README.md", "exec"), {})
    assert (folder / "body3.png").exists()


def test_given_the_readme_when_its_long_commands_are_parsed_then_all_their_options_exist(folder) -> None:
    (folder / "your_script.py").touch()
    for words in [*commands("sh"), *commands("bash")]:
        group = typer.main.get_command(import_module(f"{words[0]}.cli").app)
        command = group.commands[words[1]]
        command.make_context(words[1], words[2:])
        for word in words[2:]:
            named = word in ("mine.yaml", *bundled())
            assert not named or rig.load(word)


def test_given_the_readme_when_its_other_tests_take_the_place_of_the_scenes_then_they_load(folder) -> None:
    (tests,) = (block for name, block in BLOCKS if name == "yaml" and block.startswith("test:"))
    for line in filter(lambda line: line.startswith("test:"), tests.splitlines()):
        kind = re.search(r"kind: (\w+)", line)
        changes = {"test": read(line).content["test"]}
        assert kind is not None and rig.load("mine.yaml", changes).test.kind == kind[1]


def test_given_the_readme_when_its_links_are_followed_then_something_is_there() -> None:
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    assert links and all((ROOT / link).exists() for link in links)
