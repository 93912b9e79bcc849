"""The table of a study: recovery after a termination, rejection of other files, order, and digest of the code."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.core.base.errors import RunError
from rig.core.base.output_files import allow_overwriting
from rig.core.base.study import StoredValues, Study, code_digest, digest, read_rows, unfinished_file

HEADER = ("level", "gap, m", "result")
GAPS: Study[Any, Any] = Study("gaps", HEADER, str, tuple, lambda key, _: key, lambda row: (tuple(row), row))


def add_rows(path: Path, *added: object) -> list[list[str]]:
    """Open a table, add rows (a string is a row of its characters), and return all its rows."""
    values = StoredValues(GAPS, path)
    for row in added:
        values.add(row, row)
    return [list(key) for key in values.values]


def test_stored_rows_are_read_again(tmp_path: Path) -> None:
    path = tmp_path / "new" / "table.csv"
    add_rows(path, ["1", "0.5, about", "[1.5, 2]"])

    assert add_rows(path) == read_rows(path, HEADER, "gaps") == [["1", "0.5, about", "[1.5, 2]"]]


@pytest.mark.parametrize("cut", range(1, 6))
def test_incomplete_line_is_not_a_row(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "table.csv"
    add_rows(path, "123", ["4", "5", "678"])
    path.write_bytes(path.read_bytes()[:-cut])

    assert read_rows(path, HEADER, "gaps") == [["1", "2", "3"]]
    assert add_rows(path, "789") == add_rows(path) == [["1", "2", "3"], ["7", "8", "9"]]


@pytest.mark.parametrize("line", ['"', "x" * 200_000, "1,2", "\0"])
def test_damaged_line_affects_no_other_row(tmp_path: Path, line: str) -> None:
    path = tmp_path / "table.csv"
    add_rows(path, "123")
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{line}\n4,5,6\n")

    assert add_rows(path) == [["1", "2", "3"], ["4", "5", "6"]]


def test_empty_file_becomes_a_table(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.touch()
    add_rows(path, "123")

    assert read_rows(path, HEADER, "gaps") == [["1", "2", "3"]]


@pytest.mark.parametrize("content", [b"mine", b"mine\n", b"level,gap\n1,2\n", b"\x00\xff\n\x00", b"\n"])
def test_other_file_is_rejected_and_kept(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mine.csv"
    path.write_bytes(content)

    with pytest.raises(RunError, match=r"mine.csv: .* table of gaps.*-o"):
        add_rows(path)

    assert path.read_bytes() == content


def test_unwritable_table_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()

    with pytest.raises(RunError, match="a file has this name"):
        add_rows(tmp_path / "file" / "table.csv")
    with pytest.raises(RunError, match=r"table.csv cannot be read"):
        read_rows(tmp_path / "table.csv", HEADER, "gaps")


def test_sorted_rows_replace_the_table(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    study: Study[str, int] = Study(
        "gaps", HEADER, int, str, lambda key, value: [key, value, value], lambda row: (row[0], int(row[1]))
    )
    values = StoredValues(study, path)
    values.add("4", 5)
    values.add("1", 2)

    values.sort()

    assert path.read_text() == 'level,"gap, m",result\n1,2,2\n4,5,5\n'


def test_other_code_gives_another_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [digest(("scene", 50.0)), digest(np.arange(3.0))]
    monkeypatch.setattr("rig.core.base.study.code_digest", lambda *packages: "other sources")

    assert not set(rows) & {digest(("scene", 50.0)), digest(np.arange(3.0))}


def test_code_digest_follows_every_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    room = tmp_path / "some_code" / "room"
    room.mkdir(parents=True)
    (tmp_path / "some_code" / "__init__.py").touch()
    digests = set()
    for file, text in (("inner.py", "a = 1\n"), ("inner.py", "a = 2\n"), ("preset.yaml", "a: 3\n")):
        (room / file).write_text(text)
        digests.add(code_digest.__wrapped__("some_code"))

    assert len(digests) == 3


def test_removed_table_gets_its_heading_again(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    values = StoredValues(GAPS, path)
    values.add("123", "123")
    # Another process with the same study has finished.
    path.unlink()
    values.add("456", "456")
    assert add_rows(path) == [["4", "5", "6"]]


@pytest.mark.skipif(sys.platform == "win32", reason="no locks")
def test_table_is_computed_by_one_command(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    with GAPS.reserve(table):
        add_rows(unfinished_file(table), "123")
        with pytest.raises(RunError, match=r"table.csv: another command .*table.csv.kept"), GAPS.reserve(table):
            pytest.fail("a second command started")
        assert read_rows(unfinished_file(table), HEADER, "gaps")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rows", [[], ["123"]])
def test_only_stored_results_remain_after_an_interruption(tmp_path: Path, rows: list[str]) -> None:
    with pytest.raises(KeyboardInterrupt), GAPS.reserve(tmp_path / "table.csv"):
        add_rows(tmp_path / "table.csv.kept", *rows)
        raise KeyboardInterrupt
    assert len(list(tmp_path.iterdir())) == len(rows)


def test_unfinished_file_of_other_columns_is_replaced(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    unfinished_file(table).write_bytes(b"other,columns\n1,2\n")
    with pytest.raises(RunError, match="exists"), GAPS.reserve(table):
        pytest.fail("the study started")
    with allow_overwriting(True), GAPS.reserve(table):
        assert add_rows(unfinished_file(table), "123") == [["1", "2", "3"]]
