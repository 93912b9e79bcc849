"""A table of what a study has found so far, row by row in a CSV file, so that it goes on where it stopped."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from rig.errors import RunError
from rig.output_files import replacing


class KeptTable:
    """The table of a study, which keeps every result as soon as it is there.

    Parameters
    ----------
    path : Path
        CSV file; made, with its folder, if there is none.
    header : sequence of str
        Names of its columns.
    what : str
        What it is a table of, for messages.

    Attributes
    ----------
    rows : list of list of str
        What stood in it. A line that a kill has torn is taken out of the file.

    Raises
    ------
    RunError
        If the file is another one, or cannot be written.
    """

    def __init__(self, path: Path, header: Sequence[str], what: str) -> None:
        self._path, self._header = path, list(header)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            content = path.read_bytes() if path.exists() else b""
            self.rows = _rows(path, content, self._header, what) if content else []
            with path.open("ab") as file:
                file.truncate(_whole(content))
        except OSError as error:
            raise RunError(f"cannot write {path}: {error.strerror}; choose another place with -o") from None
        if not content:
            self.append(self._header)

    def append(self, row: Sequence[object]) -> None:
        """Add a row."""
        # In one piece: a kill leaves a line or none, but for a disk that is full.
        with self._path.open("a", newline="", encoding="utf-8") as file:
            file.write(_text([row]))

    def put_in_order(self, rows: Iterable[Sequence[object]]) -> None:
        """Write all rows anew: the same results make the same file, in whatever order they came."""
        with replacing(self._path, overwrite=True) as part:
            part.write_text(_text([self._header, *rows]), encoding="utf-8", newline="")


def rows_of(path: Path, header: Sequence[str], what: str) -> list[list[str]]:
    """Read the rows of a table that is not to be changed.

    Raises
    ------
    RunError
        If the file is another one, or cannot be read.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from None
    return _rows(path, content, list(header), what)


def _whole(content: bytes) -> int:
    """Length of the lines that end: half a number is one, too."""
    return content.rfind(b"\n") + 1


def _rows(path: Path, content: bytes, header: list[str], what: str) -> list[list[str]]:
    lines = content[: _whole(content)].decode("utf-8", errors="replace").splitlines()
    rows = [_cells(line) for line in lines]
    if rows[:1] != [header]:
        raise RunError(f"{path}: is no table of {what}; move it, or choose another place with -o")
    return [row for row in rows[1:] if len(row) == len(header)]


def _cells(line: str) -> list[str]:
    """Read a line by itself: what an open quote holds ends with it, and costs no other row.

    >>> _cells('a,"1, 2"'), _cells('b,"torn'), _cells("x" * 200_000)
    (['a', '1, 2'], ['b', 'torn'], [])
    """
    try:
        return next(csv.reader([line]), [])
    except csv.Error:
        # More letters than any cell has.
        return []


def _text(rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
