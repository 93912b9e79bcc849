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


def aligned(rows: Sequence[Sequence[str]], left: int = 0) -> list[str]:
    """Return the lines of a table: the first `left` columns are aligned to the left, the others to the right.

    >>> aligned([("channel", "peak / Hz"), ("body1", "12.54")], left=1)
    ['channel  peak / Hz', 'body1        12.54']
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if number < left else cell.rjust(width)
            for number, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
