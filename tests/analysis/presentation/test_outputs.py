"""Names of the files that analysis commands write, and tables with any text."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.commands.presentation.outputs import output_stem, with_channel_name, with_ending
from analysis.commands.presentation.tables import write_table
from rig.core.base.errors import RunError, SceneError
from rig.core.base.escaping import escape_terminal


def write_output(paths, output, kind):
    """Write a table as a command does; return its path."""
    with output_stem(paths, output, kind, "csv") as stem:
        return write_table(with_ending(stem, "csv"), ["a"], [])


def stem_of(paths):
    with output_stem(paths, None, "frf") as stem:
        return stem


def test_names_with_dots_are_kept(tmp_path):
    files = [write_output([tmp_path / name], None, "report").name for name in ("a0.5.mcap", "a0.7.mcap")]
    assert files == ["a0.5-report.csv", "a0.7-report.csv"]


def test_recordings_of_same_name_have_separate_files(tmp_path):
    paths = [tmp_path / folder / "a.mcap" for folder in ("x", "y", "z/y")]
    first, second = (write_output([path], tmp_path / "out", "modes") for path in paths[:2])
    assert (first.name, second.name) == ("a-modes.csv", "y-a-modes.csv")
    with pytest.raises(RunError, match="results of other recordings have this name"):
        write_output([paths[2]], tmp_path / "out", "modes")


def test_own_files_are_replaced(tmp_path):
    path = tmp_path / "a.mcap"
    names = [write_output([path], None, kind).name for kind in ("frf", "modes", "frf")]
    assert names == ["a-frf.csv", "a-modes.csv", "a-frf.csv"]


def test_table_moved_with_its_recording_is_replaced(tmp_path):
    for folder in (tmp_path / "before", tmp_path / "after"):
        path = folder / "a.mcap"
        if folder.name == "after":
            (tmp_path / "before").rename(folder)
        assert write_output([path], None, "frf").name == "a-frf.csv"


def test_table_of_the_user_is_not_replaced(tmp_path):
    (tmp_path / "a-frf.csv").write_text("mine")
    with pytest.raises(SceneError, match=r"a-frf\.csv exists"):
        write_output([tmp_path / "a.mcap"], None, "frf")
    assert (tmp_path / "a-frf.csv").read_text(encoding="utf-8") == "mine"


def test_similar_names_have_separate_files(tmp_path):
    first = [tmp_path / f"{'long' * 8}-{number}.mcap" for number in (1, 2, 3)]
    second = [*first[:2], tmp_path / f"{'long' * 8}-4.mcap"]
    assert stem_of(first) != stem_of(second)


def test_undecodable_name_is_kept(tmp_path):
    path = tmp_path / os.fsdecode(b"a\xff.mcap")
    names = [stem_of([path] * count).name for count in (1, 40)]
    assert os.fsencode(names[0]) == b"a\xff-frf" and names[1].startswith(os.fsdecode(b"a\xff+39-more-"))


@pytest.mark.parametrize("name", ["../../etc/passwd", "a\nb", "x" * 300, "\u202e", "/", "nul\0"])
def test_impossible_channel_name_stays_in_folder(name: str, tmp_path: Path) -> None:
    path = with_channel_name(tmp_path / "run-frf", name)

    path.touch()

    assert path.parent == tmp_path and list(tmp_path.iterdir()) == [path]
    assert path != with_channel_name(tmp_path / "run-frf", f"{name} ")


@settings(max_examples=25)
@given(st.text(st.characters(codec=None), max_size=20))
def test_table_preserves_any_text(text: str) -> None:
    with TemporaryDirectory() as folder:
        path = write_table(Path(folder) / "a.csv", ["label", "x"], [(text, 1.0)])
        with path.open(newline="", encoding="utf-8") as file:
            assert list(csv.reader(file)) == [["label", "x"], [escape_terminal(text), "1"]]
