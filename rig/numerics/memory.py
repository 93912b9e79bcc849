"""Limit on the memory of a computation, checked before it begins."""

from __future__ import annotations

import os
import re

from rig.errors import RunError

# What a command takes unless it is allowed more, bytes.
USUAL = 1e9
# What a process that reads files takes before it reads one, bytes, measured.
PROGRAM = 0.2e9
ALLOWED = "SHOTRIG_MEMORY"
_PREFIXES = {"": 1.0, "M": 1e6, "G": 1e9, "T": 1e12}


def need(size: float, what: str) -> None:
    """Refuse what would need more memory than is allowed.

    `size`: bytes; `what`: what takes them. Raises `RunError` if they are more than 1 GB, or than the environment
    variable `SHOTRIG_MEMORY` allows.

    >>> need(1e15, "a motion")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    rig.errors.RunError: a motion would need 1e+06 GB of memory; the limit is 1 GB. ...
    """
    allowed = most()
    if size > allowed:
        raise RunError(
            f"{what} would need {size / 1e9:.4g} GB of memory; the limit is {allowed / 1e9:.3g} GB. The "
            f"environment variable {ALLOWED} raises it, such as {ALLOWED}=8GB."
        )


def need_beside_program(size: float, what: str) -> None:
    """Refuse what would need more memory than is allowed, the program's own memory included.

    Parameters and errors as `need`; 0 bytes are never refused.
    """
    if size > 0.0:
        need(PROGRAM + size, what)


def most() -> float:
    """Give what a command may take, bytes.

    Raises `RunError` if the environment variable says no amount.
    """
    written = os.environ.get(ALLOWED, "")
    if not written:
        return USUAL
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([MGT]?)B\s*", written, re.IGNORECASE)
    if match is None:
        raise RunError(f"{ALLOWED}={written[:40]!r}: expected an amount of memory such as 8GB")
    return float(match[1]) * _PREFIXES[match[2].upper()]
