"""The pieces of a study that its table lacks, computed by workers and kept as they come."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple, TypeVar

from rig.kept_table import KeptTable, rows_of
from rig.workers import Workers

Row = dict[str, str]
Piece = TypeVar("Piece", bound=tuple[object, ...])


class Table(NamedTuple):
    """What the table of a study looks like.

    Attributes
    ----------
    header : tuple of str
        Names of its columns.
    what : str
        What it is a table of, for messages.
    file : str
        Name of the one that the package brings.
    whole, words : tuple of str
        Columns of whole numbers and of words; the others are of numbers.
    """

    header: tuple[str, ...]
    what: str
    file: str
    whole: tuple[str, ...] = ()
    words: tuple[str, ...] = ()

    @property
    def kept(self) -> Path:
        """The table that the package brings."""
        return Path(str(files("analysis.paper") / "data" / self.file))


def complete(
    path: Path,
    table: Table,
    pieces: Sequence[Piece],
    piece_of: Callable[[Row], Piece],
    compute: Callable[[Piece], Row],
    said: Callable[[Row], str],
    say: Callable[[str], None],
    cluster: str | None = None,
) -> None:
    """Compute the pieces that a table lacks, and put its rows into their order once all are there.

    Parameters
    ----------
    path : Path
        CSV file.
    pieces : sequence
        In the order of the rows; rows of others stay, behind them.
    piece_of, compute, said : callable
        The piece of a row, the row of a piece (a function of a module), and what to say of a row.
    say : callable
        Called with a line for each row that is new.
    cluster : str, optional
        See `rig.workers.Workers`.

    Raises
    ------
    RunError
        If the file is another one, or cannot be written.
    """
    kept = KeptTable(path, table.header, table.what)
    known = {piece_of(row): row for row in _named(table, kept.rows)}
    missing = [piece for piece in pieces if piece not in known]
    if missing:
        with Workers(cluster) as workers:
            for done, (number, row) in enumerate(workers.compute(compute, missing), 1):
                known[missing[number]] = row
                kept.append(_cells(table, row))
                say(f"[{done}/{len(missing)}] {said(row)}")
    place = {piece: number for number, piece in enumerate(pieces)}
    order = sorted(known, key=lambda piece: (place.get(piece, len(place)), piece))
    kept.put_in_order(_cells(table, known[piece]) for piece in order)


def rows(path: Path, table: Table) -> list[Row]:
    """Read the rows of a table, by the names of its columns."""
    return _named(table, rows_of(path, table.header, table.what))


def _named(table: Table, lines: Sequence[Sequence[str]]) -> list[Row]:
    """Name the cells of those rows that hold what their columns are of: somebody may have written into the file."""
    named = (dict(zip(table.header, line, strict=True)) for line in lines)
    return [row for row in named if all(_is_sound(table, name, cell) for name, cell in row.items())]


def _is_sound(table: Table, name: str, cell: str) -> bool:
    if name in table.words:
        return bool(cell)
    try:
        (int if name in table.whole else float)(cell)
    except ValueError:
        return False
    return True


def _cells(table: Table, row: Row) -> list[str]:
    return [row[name] for name in table.header]
