"""Output of a command: files, lines and warnings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Result:
    """Output of a command."""

    files: tuple[Path, ...]
    lines: tuple[str, ...]
    warnings: tuple[str, ...]
    """Each begins with the name of its recording."""


def noted(path: Path, notes: Sequence[str]) -> list[str]:
    """Prefix each warning with the name of its recording."""
    return [f"{path.name}: {note}" for note in notes]


def aligned(rows: Sequence[Sequence[str]], alignment: str) -> list[str]:
    """Return the lines of a table with a header; `alignment` has ``<`` or ``>`` for each column.

    Columns that are empty below the header are left out.

    >>> aligned([("channel", "peak / Hz", "note"), ("body1", "12.54", "")], "<><")
    ['channel  peak / Hz', 'body1        12.54']
    """
    columns = [
        [f"{cell:{side}{max(map(len, column))}}" for cell in column]
        for column, side in zip(zip(*rows, strict=True), alignment, strict=True)
        if any(column[1:])
    ]
    return ["  ".join(row).rstrip() for row in zip(*columns, strict=True)]
