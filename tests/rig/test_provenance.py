"""Outputs are replaced with later outputs of the same source; edited files and files of other origin are protected."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from rig.core.base.errors import SceneError
from rig.core.base.figure_style import new_figure, save_with_table
from rig.core.base.output_files import atomic_write
from rig.core.base.provenance import allow_overwriting, output_source

TEXTS = {".csv": "a,b\n1,2\n", ".svg": "<svg><a/></svg>\n", ".html": "<a>\n", ".yaml": "a: 1\n", ".md": "# a\n"}


def write_output(path: Path, content: bytes, source: str = "s") -> None:
    """Write a file as the output of a command on a source, such as a recording."""
    with output_source("test", source), atomic_write(path) as part:
        part.write_bytes(content)


@pytest.mark.parametrize("ending", TEXTS)
def test_unchanged_output_is_replaced(tmp_path: Path, ending: str) -> None:
    path, text = tmp_path / f"out{ending}", TEXTS[ending].encode()
    write_output(path, text)
    write_output(path, text.replace(b"a", b"new"))
    assert b"new" in path.read_bytes()


@pytest.mark.parametrize("ending", TEXTS)
def test_edited_output_is_protected(tmp_path: Path, ending: str) -> None:
    path, text = tmp_path / f"out{ending}", TEXTS[ending].encode()
    write_output(path, text)
    edited = path.read_bytes().replace(b"a", b"mine", 1)
    path.write_bytes(edited)
    with pytest.raises(SceneError, match="exists and was changed"):
        write_output(path, text)
    assert path.read_bytes() == edited


def test_output_of_another_source_is_protected(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    write_output(path, b"a\n1\n", "first")
    with pytest.raises(SceneError, match="another source"):
        write_output(path, b"a\n2\n", "second")
    with allow_overwriting(True):
        write_output(path, b"a\n2\n", "second")
    assert path.read_bytes().endswith(b"\n2\n")


def test_file_of_the_user_is_protected(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    path.write_text("mine")
    with pytest.raises(SceneError, match="--overwrite"):
        write_output(path, b"a\n1\n")
    assert path.read_text(encoding="utf-8") == "mine" and list(tmp_path.iterdir()) == [path]


def test_file_without_provenance_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "out.uff"
    write_output(path, b"a")
    write_output(path, b"a")
    with pytest.raises(SceneError, match="exists"):
        write_output(path, b"b")
    assert path.read_bytes() == b"a" and list(tmp_path.iterdir()) == [path]


def test_figures_and_archives_with_provenance_are_readable(tmp_path: Path) -> None:
    from matplotlib.image import imread

    for value in (1.0, 2.0):
        with output_source("test"), new_figure(1.0) as figure:
            figure.subplots().plot([value])
            files = save_with_table(figure, tmp_path / "out", [["a"], [value]])
            with atomic_write(tmp_path / "out.npz") as part:
                np.savez(part, value=value)
    assert imread(files[0]).ndim == 3 and float(np.load(tmp_path / "out.npz")["value"]) == 2.0
    (row,) = csv.DictReader(files[2].read_text(encoding="utf-8").splitlines())
    assert row["a"] == "2.0"
    # A changed figure is protected.
    files[0].write_bytes(files[0].read_bytes().replace(b"IDAT", b"IDAX", 1))
    with pytest.raises(SceneError, match="changed"), output_source("test"), atomic_write(files[0]):
        pass
