"""Memory limit of a computation, checked before it starts."""

import os
import re

from rig.core.base.errors import RunError

# Memory limit if the environment variable is not set.
DEFAULT_LIMIT_BYTES = 1e9
# Memory of the program itself, before it reads a file (measured).
PROGRAM_BYTES = 0.2e9
# Environment variable with the memory limit.
LIMIT_VARIABLE = "SHOTRIG_MEMORY"
_PREFIXES = {"": 1.0, "M": 1e6, "G": 1e9, "T": 1e12}


def require_memory(size: float, purpose: str) -> None:
    """Reject a computation that would exceed the memory limit.

    `size`: bytes; `purpose`: what needs the memory, as the subject of the message. Raises `RunError` if `size` exceeds
    1 GB, or the limit in the environment variable `SHOTRIG_MEMORY`.

    >>> require_memory(1e15, "a motion")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    rig.core.base.errors.RunError: a motion would need 1e+06 GB of memory; the limit is 1 GB. ...
    """
    limit = memory_limit()
    if size > limit:
        raise RunError(
            f"{purpose} would need {size / 1e9:.4g} GB of memory; the limit is {limit / 1e9:.3g} GB. Raise the limit "
            f"with the environment variable {LIMIT_VARIABLE}, such as {LIMIT_VARIABLE}=8GB."
        )


def require_memory_with_program(size: float, purpose: str) -> None:
    """Reject a computation that would exceed the memory limit together with the program itself.

    Parameters and exceptions are those of `require_memory`; 0 bytes are never rejected.
    """
    if size > 0.0:
        require_memory(PROGRAM_BYTES + size, purpose)


def memory_limit() -> float:
    """Return the memory limit of a command [bytes].

    Raises `RunError` if the environment variable is not an amount of memory.
    """
    text = os.environ.get(LIMIT_VARIABLE, "")
    if not text:
        return DEFAULT_LIMIT_BYTES
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([MGT]?)B\s*", text, re.IGNORECASE)
    if match is None:
        raise RunError(f"{LIMIT_VARIABLE}={text[:40]!r}: not an amount of memory. Set an amount such as 8GB.")
    return float(match[1]) * _PREFIXES[match[2].upper()]
