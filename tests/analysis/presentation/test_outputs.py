"""Names of the files that analysis commands write, and tables with any text."""

import csv
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.commands.presentation.outputs import output_stem, separate_stems, with_channel_name, with_ending
from analysis.commands.presentation.tables import write_table
from rig.core.base.escaping import escape_terminal


def test_names_with_dots_are_kept(tmp_path):
    stems = [output_stem([tmp_path / name], None, "report") for name in ("a0.5.mcap", "a0.7.mcap")]
    assert [with_ending(stem, "csv").name for stem in stems] == ["a0.5-report.csv", "a0.7-report.csv"]


def test_recordings_of_same_name_have_separate_files(tmp_path):
    paths = [tmp_path / folder / "a.mcap" for folder in ("x", "y")]
    stems = separate_stems([*paths, tmp_path / "b.mcap"], tmp_path / "out", "modes")
    assert [stem.name for stem in stems] == ["x-a-modes", "y-a-modes", "b-modes"]


def test_similar_names_have_separate_files(tmp_path):
    first = [tmp_path / f"{'long' * 8}-{number}.mcap" for number in (1, 2, 3)]
    second = [*first[:2], tmp_path / f"{'long' * 8}-4.mcap"]
    assert output_stem(first, None, "frf") != output_stem(second, None, "frf")


def test_undecodable_name_is_kept(tmp_path):
    path = tmp_path / os.fsdecode(b"a\xff.mcap")
    names = [output_stem([path] * count, None, "frf").name for count in (1, 40)]
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
