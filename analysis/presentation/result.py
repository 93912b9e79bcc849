"""Output of a command: files, lines and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Result:
    """Output of a command."""

    files: tuple[Path, ...]
    lines: tuple[str, ...]
    warnings: tuple[str, ...]
    """Each begins with the name of its recording."""


def with_recording_name(path: Path, notes: Sequence[str]) -> list[str]:
    """Prefix each warning with the name of its recording."""
    return [f"{path.name}: {note}" for note in notes]
