"""Studies of many independent pieces: computed by workers, kept in a CSV table as they come, continued after a kill."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from rig.errors import RunError
from rig.output_files import replacing
from rig.workers import Workers

Piece = TypeVar("Piece")
Value = TypeVar("Value")
#: Called with the number of pieces done and of all.
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Study(Generic[Piece, Value]):
    """A study of pieces whose values are kept in a table.

    Attributes
    ----------
    name : str
        Content of the table, for messages.
    columns : tuple of str
        Of the table.
    compute : callable
        Computes the value of a piece; a function of a module, so that other processes can import it.
    key : callable
        Gives the identity of a piece, which has all that its value depends on.
    encode : callable
        Makes the row of a key and a value.
    decode : callable
        Reads key and value of a row; raises `ValueError`, `KeyError` or `TypeError` for a row that somebody spoilt.
    """

    name: str
    columns: tuple[str, ...]
    compute: Callable[[Piece], Value]
    key: Callable[[Piece], Any]
    encode: Callable[[Any, Value], Sequence[object]]
    decode: Callable[[list[str]], tuple[Any, Value]]

    def run(
        self, pieces: Sequence[Piece], table: Path | None = None, cluster: str | None = None,
        progress: Progress | None = None, prepare: Callable[[], object] = lambda: None,
    ) -> list[Value]:  # fmt: skip
        """Compute the pieces that the table lacks; returns the values of all.

        Parameters
        ----------
        table : Path, optional
            CSV file; what it has of the same pieces is not computed again.
        cluster : str, optional
            See `rig.workers.Workers`.
        prepare : callable, optional
            Called before the first piece is computed.

        Raises
        ------
        RunError
            If the table cannot be read or written, or workers die.
        """
        kept, report = Kept(self, table), progress or (lambda done, total: None)
        done = sum(piece in kept for piece in pieces)
        if done:
            report(done, len(pieces))
        if done < len(pieces):
            prepare()
        for number, _ in enumerate(kept.complete(pieces, cluster), done + 1):
            report(number, len(pieces))
        return [kept[piece] for piece in pieces]


class Kept(Generic[Piece, Value]):
    """Values of a study's pieces, in memory and in its table if there is one."""

    def __init__(self, study: Study[Piece, Value], path: Path | None) -> None:
        self.study = study
        self._table = None if path is None else KeptTable(path, study.columns, study.name)
        self.values = dict(decoded(study, self._table.rows)) if self._table is not None else {}

    def __contains__(self, piece: Piece) -> bool:
        return self.study.key(piece) in self.values

    def __getitem__(self, piece: Piece) -> Value:
        return self.values[self.study.key(piece)]

    def add(self, piece: Piece, value: Value) -> None:
        """Keep the value of a piece."""
        key = self.study.key(piece)
        self.values[key] = value
        if self._table is not None:
            self._table.append(self.study.encode(key, value))

    def complete(self, pieces: Sequence[Piece], cluster: str | None = None) -> Iterator[Value]:
        """Compute the pieces that are missing; yields each value once it is kept."""
        missing = [piece for piece in pieces if piece not in self]
        if missing:
            with Workers(cluster) as workers:
                for number, value in workers.compute(self.study.compute, missing):
                    self.add(missing[number], value)
                    yield value

    def put_in_order(self, order: Callable[[Any], Any] | None = None) -> None:
        """Sort the table by its keys: the same values give the same file in whatever order they came."""
        if self._table is not None:
            keys = sorted(self.values, key=order)
            self._table.replace(self.study.encode(key, self.values[key]) for key in keys)


def digest(text: str) -> str:
    """Short name for all that the value of a piece depends on.

    >>> digest("('scene', 50.0)")
    '4fc6f88757844cf7'
    """
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def decoded(study: Study[Piece, Value], rows: Iterable[list[str]]) -> Iterator[tuple[Any, Value]]:
    """Keys and values of the rows that can be read."""
    for row in rows:
        try:
            yield study.decode(row)
        except (ValueError, KeyError, TypeError):
            continue


class KeptTable:
    """A CSV table that has every row on disk as soon as it is known.

    Parameters
    ----------
    path : Path
        CSV file; made, with its folder, if there is none. A line that a kill has torn is taken out of the file.
    header : sequence of str
        Names of its columns.
    what : str
        Content of the table, for messages.

    Attributes
    ----------
    rows : list of list of str
        Content of the file when it was opened.

    Raises
    ------
    RunError
        If the file is not such a table, or cannot be written.
    """

    def __init__(self, path: Path, header: Sequence[str], what: str) -> None:
        self._path, self._header = path, list(header)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            content = path.read_bytes() if path.exists() else b""
            self.rows = _rows(path, content, self._header, what) if content else []
            with path.open("ab") as file:
                file.truncate(_whole_lines(content))
        except OSError as error:
            raise RunError(f"cannot write {path}: {error.strerror}; choose another place with -o") from None
        if not content:
            self.append(self._header)

    def append(self, row: Sequence[object]) -> None:
        """Add a row."""
        # In one piece: a kill leaves the whole line or nothing, unless the disk is full.
        with self._path.open("a", newline="", encoding="utf-8") as file:
            file.write(_csv([row]))

    def replace(self, rows: Iterable[Sequence[object]]) -> None:
        """Write all rows again."""
        with replacing(self._path, overwrite=True) as part:
            part.write_text(_csv([self._header, *rows]), encoding="utf-8", newline="")


def rows_of(path: Path, header: Sequence[str], what: str) -> list[list[str]]:
    """Read the rows of a table without changing it.

    Raises
    ------
    RunError
        If the file is not such a table, or cannot be read.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from None
    return _rows(path, content, list(header), what)


def _whole_lines(content: bytes) -> int:
    """Length of the lines that end: half a number is a number as well."""
    return content.rfind(b"\n") + 1


def _rows(path: Path, content: bytes, header: list[str], what: str) -> list[list[str]]:
    lines = content[: _whole_lines(content)].decode("utf-8", errors="replace").splitlines()
    rows = [_cells(line) for line in lines]
    if rows[:1] != [header]:
        raise RunError(f"{path}: is no table of {what}; move it, or choose another place with -o")
    return [row for row in rows[1:] if len(row) == len(header)]


def _cells(line: str) -> list[str]:
    """Read a line by itself: an open quote ends with it, and costs no other row.

    >>> _cells('a,"1, 2"'), _cells('b,"torn'), _cells("x" * 200_000)
    (['a', '1, 2'], ['b', 'torn'], [])
    """
    try:
        return next(csv.reader([line]), [])
    except csv.Error:
        # More letters than any cell has.
        return []


def _csv(rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
