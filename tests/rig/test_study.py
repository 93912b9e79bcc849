"""The table of a study: recovery after a kill, rejection of foreign files, and order."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.errors import RunError
from rig.study import KeptTable, rows_of

HEADER = ["level", "gap, m", "found"]


def test_kept_rows_are_read_again(tmp_path: Path) -> None:
    path = tmp_path / "new" / "table.csv"
    first = KeptTable(path, HEADER, "gaps")
    first.append([1, "0.5, about", "[1.5, 2]"])

    again = KeptTable(path, HEADER, "gaps")

    assert first.rows == []
    assert again.rows == [["1", "0.5, about", "[1.5, 2]"]]
    assert rows_of(path, HEADER, "gaps") == again.rows


@pytest.mark.parametrize("cut", range(1, 6))
def test_torn_line_is_never_a_row(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "table.csv"
    table = KeptTable(path, HEADER, "gaps")
    table.append([1, 2, 3])
    table.append([4, 5, 678])
    path.write_bytes(path.read_bytes()[:-cut])

    torn = rows_of(path, HEADER, "gaps")
    opened = KeptTable(path, HEADER, "gaps")
    opened.append([7, 8, 9])

    assert torn == opened.rows == [["1", "2", "3"]]
    assert KeptTable(path, HEADER, "gaps").rows == [["1", "2", "3"], ["7", "8", "9"]]


@pytest.mark.parametrize("line", ['"', "x" * 200_000, "1,2", "\0"])
def test_spoilt_line_costs_no_other_row(tmp_path: Path, line: str) -> None:
    path = tmp_path / "table.csv"
    KeptTable(path, HEADER, "gaps").append([1, 2, 3])
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{line}\n4,5,6\n")

    assert KeptTable(path, HEADER, "gaps").rows == [["1", "2", "3"], ["4", "5", "6"]]


def test_empty_file_becomes_a_table(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.touch()

    KeptTable(path, HEADER, "gaps").append([1, 2, 3])

    assert rows_of(path, HEADER, "gaps") == [["1", "2", "3"]]


@pytest.mark.parametrize("content", [b"mine", b"mine\n", b"level,gap\n1,2\n", b"\x00\xff\n\x00", b"\n"])
def test_foreign_table_is_rejected_and_kept(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mine.csv"
    path.write_bytes(content)

    with pytest.raises(
        RunError, match=r"mine.csv: is not a table of gaps. Move it, or choose another name with -o"
    ):
        KeptTable(path, HEADER, "gaps")

    assert path.read_bytes() == content


def test_unwritable_place_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()

    with pytest.raises(RunError, match=r"cannot write .*table.csv.*choose another place with -o"):
        KeptTable(tmp_path / "file" / "table.csv", HEADER, "gaps")


def test_missing_table_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"cannot read .*table.csv"):
        rows_of(tmp_path / "table.csv", HEADER, "gaps")


def test_ordered_rows_replace_the_table(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    table = KeptTable(path, HEADER, "gaps")
    table.append([4, 5, 6])
    table.append([1, 2, 3])

    table.replace([[1, 2, 3], [4, 5, 6]])

    assert path.read_text() == 'level,"gap, m",found\n1,2,3\n4,5,6\n'
