"""The one limit of memory for all readers of other programs' files."""

from __future__ import annotations

from pathlib import Path

from rig.numerics.memory import need

# What an importing process takes before it reads a file, bytes, measured.
PROGRAM = 0.2e9


def need_for_import(size: float, path: Path) -> None:
    """Refuse a file whose content would take more memory than is allowed.

    Parameters
    ----------
    size : float
        Bytes that its content takes in memory, as far as it is held; 0 is never refused.
    path : Path
        The file.

    Raises
    ------
    RunError
        If the process would take more than 1 GB, or than the environment variable `SHOTRIG_MEMORY` allows.
    """
    if size > 0.0:
        need(PROGRAM + size, f"{path}: importing it")
