"""Files that a person names and a command reads whole: scenes, tables, certificates, data sheets."""

from __future__ import annotations

import errno
from pathlib import Path

MOST_BYTES = 64_000_000


def read_whole(path: Path) -> bytes:
    """Read an ordinary file; a pipe would never answer, and a device never end.

    Raises
    ------
    OSError
        If there is none, it is none, it cannot be read, or it is larger than any such file; `strerror` says which.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "no ordinary file", str(path))
    with path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise OSError(errno.EFBIG, f"larger than {MOST_BYTES // 1_000_000} MB", str(path))
    return data
