"""Protection of output files: a command replaces only unchanged shotrig outputs from the same source.

An output contains a mark, `shotrig SOURCE CONTENT`: the digest of its inputs, and the digest of the file without the
mark. A file without a mark, with another source, or with a different content digest belongs to the user. The mark is
stored where other programs ignore it: the last header cell of a table, the text chunk `Software` of a PNG, a
comment at the end of SVG, HTML, Markdown and YAML, the comment of a zip archive. Files for other programs (UFF,
MATLAB, WAV, RRD, exported tables) have no mark; they remain unchanged if the new content is identical.
"""

from __future__ import annotations

import hashlib
import os
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from rig.core.base.errors import SceneError

# Number of hexadecimal digits of a digest.
_DIGITS = 16
_MARK = re.compile(rb"shotrig ([0-9a-f]{16}) ([0-9a-f]{16})")
_MARK_BYTES = len("shotrig ") + _DIGITS + 1 + _DIGITS
# Text before and after the mark in text formats.
_DELIMITERS = {
    ".csv": (b",", b""),
    ".svg": (b"<!-- ", b" -->\n"),
    ".html": (b"<!-- ", b" -->\n"),
    ".htm": (b"<!-- ", b" -->\n"),
    ".md": (b"<!-- ", b" -->\n"),
    ".yaml": (b"# ", b"\n"),
    ".yml": (b"# ", b"\n"),
}
_PNG_KEYWORD = b"Software\0"
# Size of length, type and checksum of a PNG chunk; the last chunk, IEND, has no other content.
_PNG_CHUNK = 12
# A zip archive ends with the length of its comment and the comment; this is an empty comment.
_ZIP_NO_COMMENT = b"\0\0"

_source: ContextVar[str] = ContextVar("source", default="")
_overwriting: ContextVar[bool] = ContextVar("allow_overwriting", default=False)


@contextmanager
def output_source(*identity: str) -> Iterator[None]:
    """Set the source of outputs written inside the `with` block: command, and content or digest of its input."""
    token = _source.set(_digest("\0".join(identity).encode("utf-8", errors="surrogateescape")))
    try:
        yield
    finally:
        _source.reset(token)


@contextmanager
def allow_overwriting(allowed: bool) -> Iterator[None]:
    """Allow outputs written inside the `with` block to replace any file, if `allowed`."""
    token = _overwriting.set(allowed)
    try:
        yield
    finally:
        _overwriting.reset(token)


def relative_paths(paths: Sequence[Path], folder: Path) -> list[str]:
    """Return input paths relative to the output folder, so that both can be moved together."""
    return [_relative(path.resolve(), folder.resolve()) for path in paths]


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        # A file on another drive has no relative path.
        return path.as_posix()


def may_overwrite() -> bool:
    """Return whether outputs may replace any file."""
    return _overwriting.get()


def is_unchanged_output(path: Path) -> bool:
    """Return whether a file was written from the current source and has not been changed since."""
    source = _mark_of(path)
    return bool(_source.get()) and source == _source.get()


def is_from_another_source(path: Path) -> bool:
    """Return whether a file was written by shotrig from another source, and has not been changed since."""
    return _mark_of(path) not in ("", _source.get())


def can_contain_mark(path: Path) -> bool:
    """Return whether an output with this name contains a mark."""
    return bool(_source.get()) and path.suffix.lower() in (*_DELIMITERS, ".png", ".npz")


def overwrite_error(path: Path) -> SceneError:
    """Return the error for a file that belongs to the user, or was written from another source."""
    reason = "was changed since shotrig wrote it, or was written by another program"
    if _mark_of(path):
        reason = "was written from another source (command, scene or recording)"
    return SceneError(
        f"{path} exists and {reason}. The file is not replaced. Choose another name or folder with -o, or pass "
        "--overwrite."
    )


def add_mark(path: Path) -> None:
    """Add the mark to a complete file."""
    content = path.read_bytes()
    mark = f"shotrig {_source.get()} {_digest(content)}".encode()
    suffix = path.suffix.lower()
    position = _mark_position(suffix, content)
    path.write_bytes(content[: position - _replaced_bytes(suffix)] + _delimited(suffix, mark) + content[position:])


def _mark_of(path: Path) -> str:
    """Return the digest of the source in the mark of a file; empty if it has no mark, or was changed since."""
    suffix = path.suffix.lower()
    try:
        if suffix not in (*_DELIMITERS, ".png", ".npz") or not path.is_file():
            return ""
        content = path.read_bytes()
    except OSError:
        return ""
    stop = _mark_position(suffix, content)
    start = stop - len(_delimited(suffix, bytes(_MARK_BYTES)))
    match = _MARK.search(content, max(start, 0), stop)
    if start < 0 or match is None or content[start:stop] != _delimited(suffix, match[0]):
        return ""
    unmarked = content[:start] + _ZIP_NO_COMMENT[: _replaced_bytes(suffix)] + content[stop:]
    return match[1].decode() if _digest(unmarked) == match[2].decode() else ""


def _mark_position(suffix: str, content: bytes) -> int:
    """Return the position at which the mark of a file ends or is inserted."""
    if suffix == ".csv":
        line = content.partition(b"\n")[0]
        return len(line) - line.endswith(b"\r")
    return len(content) - (_PNG_CHUNK if suffix == ".png" else 0)


def _delimited(suffix: str, mark: bytes) -> bytes:
    """Return a mark with the bytes that the format needs around it."""
    if suffix == ".png":
        data = b"tEXt" + _PNG_KEYWORD + mark
        return struct.pack(">I", len(data) - 4) + data + struct.pack(">I", zlib.crc32(data))
    if suffix == ".npz":
        return struct.pack("<H", len(mark)) + mark
    before, after = _DELIMITERS[suffix]
    return before + mark + after


def _replaced_bytes(suffix: str) -> int:
    """Return the number of bytes of an unmarked file that the mark replaces."""
    return len(_ZIP_NO_COMMENT) if suffix == ".npz" else 0


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGITS]
