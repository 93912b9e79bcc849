"""What a command found: files, lines and warnings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Result:
    """What a command has to say."""

    files: tuple[Path, ...]
    lines: tuple[str, ...]  # Findings, one to a line
    warnings: tuple[str, ...]
    """Doubts, each with the recording it concerns."""


def noted(path: Path, notes: Sequence[str]) -> list[str]:
    """Put the recording's name before each of its doubts."""
    return [f"{path.name}: {note}" for note in notes]
