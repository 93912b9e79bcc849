"""Reading of input files into memory: scenes, tables, certificates, data sheets; and detection of duplicate files."""

import errno
from collections.abc import Sequence
from pathlib import Path

from rig.core.base.errors import SceneError

# Files up to this size are read completely.
MAX_BYTES = 64_000_000


def as_path(path: str | Path, name: str = "path") -> Path:
    """Convert an argument to the path of a file.

    Raises `SceneError` if it is not a valid path; the message begins with the name of the argument.
    """
    if not isinstance(path, str | Path):
        raise SceneError(f"{name}: got {path!r:.60}; expected the path of a file")
    return Path(path)


def read_file(path: Path) -> bytes:
    """Read a regular file; pipes and devices are rejected, because reading them may never end.

    Raises `OSError` if the file does not exist, is not a regular file, cannot be read or is too large; `strerror`
    gives the reason.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise OSError(errno.EFBIG, f"larger than {MAX_BYTES // 1_000_000} MB", str(path))
    return data


def duplicate_files(paths: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Return pairs of files with the same content: each repeated file, and the first file with its content."""
    import hashlib

    by_size: dict[int, list[Path]] = {}
    for path in paths:
        if path.is_file():
            by_size.setdefault(path.stat().st_size, []).append(path)
    pairs = []
    for candidates in by_size.values():
        if len(candidates) == 1:
            continue
        first_of_digest: dict[bytes, Path] = {}
        for path in candidates:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").digest()
            if digest in first_of_digest:
                pairs.append((first_of_digest[digest], path))
            first_of_digest.setdefault(digest, path)
    return pairs
