"""Studies of many independent pieces: computed by workers, stored in a CSV table, continued after an interruption."""

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
#: Called with the number of pieces done and the total.
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Study(Generic[Piece, Value]):
    """A study of pieces whose values are stored in a table.

    `compute`: computes the value of a piece; a module-level function, so that other processes can import it;
    `decode`: returns key and value of a row; raises `ValueError`, `KeyError` or `TypeError` for a damaged row.
    """

    name: str  # content of the table, for messages
    columns: tuple[str, ...]  # column names of the table
    compute: Callable[[Piece], Value]
    key: Callable[[Piece], Any]  # returns the identity of a piece, which includes all its inputs
    encode: Callable[[Any, Value], Sequence[object]]  # returns the table row for a key and a value
    decode: Callable[[list[str]], tuple[Any, Value]]

    def run(
        self, pieces: Sequence[Piece], table: Path | None = None, cluster: str | None = None,
        progress: Progress | None = None, prepare: Callable[[], object] = lambda: None,
    ) -> list[Value]:  # fmt: skip
        """Compute pieces that are missing in the table; return the values of all pieces.

        Parameters
        ----------
        table : Path, optional
            CSV file; pieces in this file are not recomputed.
        cluster : str, optional
            See `rig.workers.Workers`.
        prepare : callable, optional
            Called before the first piece is computed.

        Raises
        ------
        RunError
            If the table cannot be read or written, or a worker process ends unexpectedly.
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
    """Values of a study's pieces, in memory and in an optional table."""

    def __init__(self, study: Study[Piece, Value], path: Path | None) -> None:
        self.study = study
        self._table = None if path is None else KeptTable(path, study.columns, study.name)
        self.values = dict(decoded(study, self._table.rows)) if self._table is not None else {}

    def __contains__(self, piece: Piece) -> bool:
        return self.study.key(piece) in self.values

    def __getitem__(self, piece: Piece) -> Value:
        return self.values[self.study.key(piece)]

    def add(self, piece: Piece, value: Value) -> None:
        """Store the value of a piece."""
        key = self.study.key(piece)
        self.values[key] = value
        if self._table is not None:
            self._table.append(self.study.encode(key, value))

    def complete(self, pieces: Sequence[Piece], cluster: str | None = None) -> Iterator[Value]:
        """Compute missing pieces; yield each value after it is stored."""
        missing = [piece for piece in pieces if piece not in self]
        if missing:
            with Workers(cluster) as workers:
                for number, value in workers.compute(self.study.compute, missing):
                    self.add(missing[number], value)
                    yield value

    def put_in_order(self, order: Callable[[Any], Any] | None = None) -> None:
        """Sort the table by its keys, so that the file does not depend on the order of computation."""
        if self._table is not None:
            keys = sorted(self.values, key=order)
            self._table.replace(self.study.encode(key, self.values[key]) for key in keys)


def digest(text: str) -> str:
    """Compute a short digest of the inputs of a piece.

    >>> digest("('scene', 50.0)")
    '4fc6f88757844cf7'
    """
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def decoded(study: Study[Piece, Value], rows: Iterable[list[str]]) -> Iterator[tuple[Any, Value]]:
    """Yield keys and values of valid rows."""
    for row in rows:
        try:
            yield study.decode(row)
        except (ValueError, KeyError, TypeError):
            continue


class KeptTable:
    """A CSV table that is written to disk row by row.

    `path`: CSV file; created with its folder if it does not exist. An incomplete last line is removed; `header`:
    names of the columns; `what`: content of the table, for messages; `rows`: content of the file when it was opened.
    Raises `RunError` if the file is not such a table, or cannot be written.
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
        # A single write: an interruption leaves a complete line or nothing, unless the disk is full.
        with self._path.open("a", newline="", encoding="utf-8") as file:
            file.write(_csv([row]))

    def replace(self, rows: Iterable[Sequence[object]]) -> None:
        """Replace all rows."""
        with replacing(self._path, overwrite=True) as part:
            part.write_text(_csv([self._header, *rows]), encoding="utf-8", newline="")


def rows_of(path: Path, header: Sequence[str], what: str) -> list[list[str]]:
    """Read the rows of a table without changing it.

    Raises `RunError` if the file is not such a table, or cannot be read.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from None
    return _rows(path, content, list(header), what)


def _whole_lines(content: bytes) -> int:
    """Return the length of complete lines; a truncated number could be read as a number."""
    return content.rfind(b"\n") + 1


def _rows(path: Path, content: bytes, header: list[str], what: str) -> list[list[str]]:
    lines = content[: _whole_lines(content)].decode("utf-8", errors="replace").splitlines()
    rows = [_cells(line) for line in lines]
    if rows[:1] != [header]:
        raise RunError(f"{path}: is not a table of {what}. Move it, or choose another name with -o.")
    return [row for row in rows[1:] if len(row) == len(header)]


def _cells(line: str) -> list[str]:
    """Parse a single line, so that an open quote does not affect other rows.

    >>> _cells('a,"1, 2"'), _cells('b,"torn'), _cells("x" * 200_000)
    (['a', '1, 2'], ['b', 'torn'], [])
    """
    try:
        return next(csv.reader([line]), [])
    except csv.Error:
        # The line exceeds the field size limit of the csv module.
        return []


def _csv(rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
