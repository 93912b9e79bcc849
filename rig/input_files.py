"""Files that a person names and a command reads whole: scenes, tables, certificates, data sheets."""

from __future__ import annotations

import errno
import hashlib
from collections.abc import Sequence
from pathlib import Path

from rig.errors import SceneError

MOST_BYTES = 64_000_000


def path_of(path: str | Path, name: str = "path") -> Path:
    """Take an argument that is the path of a file.

    Raises
    ------
    SceneError
        If it is no path; the message begins with the argument's name.
    """
    if not isinstance(path, str | Path):
        raise SceneError(f"{name}: got {path!r:.60}; expected the path of a file")
    return Path(path)


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


def repeated(paths: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Pair each file with the first one given that has the same content, under whatever name."""
    by_size: dict[int, list[Path]] = {}
    for path in paths:
        if path.is_file():
            by_size.setdefault(path.stat().st_size, []).append(path)
    pairs = []
    for alike in by_size.values():
        if len(alike) == 1:
            continue
        first: dict[bytes, Path] = {}
        for path in alike:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").digest()
            if digest in first:
                pairs.append((first[digest], path))
            first.setdefault(digest, path)
    return pairs
