"""Files that commands write: never half, never in place of one that was to stay, never over what is no file."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from filecmp import cmp
from pathlib import Path
from secrets import token_hex

from rig.errors import RunError, SceneError, ShotrigError
from rig.provenance import add_mark, carries_mark, is_own, may_overwrite, refusal

#: Endings of what commands write, which no folder is meant to have.
_OF_FILES = (".png", ".svg", ".csv", ".html", ".mcap", ".npz", ".yaml", ".pdf")


def make_ready(folder: Path) -> None:
    """Make a folder if it does not exist, before the work whose results go there.

    Raises
    ------
    SceneError
        If it cannot be written to, or is new and named like one of the files that commands write.
    """
    if folder.suffix.lower() in _OF_FILES and not folder.exists():
        raise SceneError(
            f"{folder}: several files go there; expected the name of a folder, such as -o {folder.with_suffix('')}"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(
            f"{folder}: cannot be written ({error.strerror}); choose another place with -o"
        ) from None
    if not os.access(folder, os.W_OK):
        raise SceneError(f"{folder}: cannot be written; choose another place with -o")


def destination(path: Path, overwrite: bool, refusal: type[ShotrigError] = SceneError) -> Path:
    """Find the file that a name stands for, and refuse one that must not be written.

    Parameters
    ----------
    path : Path
        File to make or to replace; a symbolic link stands for what it points to.
    overwrite : bool
        Whether an existing file may be replaced.
    refusal : type
        What to raise.

    Returns
    -------
    Path
        The file itself.

    Raises
    ------
    ShotrigError
        If there is a file that is to stay or is write-protected, or something that is no ordinary file; if its
        folder does not exist.
    """
    try:
        file = path.resolve()
        there = file.stat() if os.path.lexists(file) else None
        if not file.parent.is_dir():
            if file.parent.exists():
                raise refusal(f"cannot make {path}: {file.parent} is a file, no directory")
            raise refusal(f"cannot make {path}: there is no folder {file.parent}; make it first")
    except (OSError, ValueError, RuntimeError) as error:
        why = getattr(error, "strerror", None) or error
        raise refusal(f"cannot make {path}: {why}; choose another name or place with -o") from None
    if there is None:
        return file
    if not stat.S_ISREG(there.st_mode):
        raise refusal(f"{path} is no ordinary file and is left as it is; choose another name with -o")
    if not overwrite:
        raise refusal(f"{path} exists and is left as it is; choose another name with -o, or pass --overwrite")
    if not os.access(file, os.W_OK):
        raise refusal(f"{path} is write-protected and is left as it is; choose another name with -o")
    return file


@contextmanager
def replacing(path: Path, overwrite: bool | None = None) -> Iterator[Path]:
    """Make a file beside its final place, and put it there once it is complete.

    Whatever happens meanwhile, at `path` is what was there before, whole, or the new file, whole. A finished file that
    cannot get its name is kept under another name, which the message gives.

    Parameters
    ----------
    path : Path
        File to make or to replace, in an existing folder.
    overwrite : bool, optional
        Whether an existing file may be replaced; omitted, as `rig.provenance` says of outputs.

    Yields
    ------
    Path
        File to write; its name ends as that of `path`.

    Raises
    ------
    SceneError
        If `path` must not be written, see `destination`; if a file of that name, which is to stay, was created in
        the meantime.
    RunError
        If the disk is full or fails.
    """
    marked, unmarked = overwrite is None and carries_mark(path), overwrite is None and not carries_mark(path)
    if overwrite is None:
        overwrite = may_overwrite() or is_own(path)
        if marked and not overwrite and path.is_file():
            raise refusal(path)
    # Only once it is complete is it known whether a file without a mark comes out the same.
    file = destination(path, overwrite or unmarked)
    part = file.with_name(f".{token_hex(6)}{file.suffix}")
    try:
        yield part
        if marked:
            add_mark(part)
        elif unmarked and not overwrite and file.is_file():
            if not cmp(part, file, shallow=False):
                raise refusal(path)
            part.unlink()
            return
        _sync(part)
    except BaseException as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise RunError(f"cannot write {path}: {error.strerror or error}") from error
        raise
    try:
        _name(part, file, overwrite)
    except FileExistsError:
        raise SceneError(
            f"{path}: this file was created in the meantime and is left as it is. The result is in {_kept(part, file)}."
        ) from None
    except OSError as error:
        raise RunError(
            f"cannot write {path}: {error.strerror or error}. The result is in {_kept(part, file)}."
        ) from error


def put_in_place(part: Path, file: Path, overwrite: bool) -> None:
    """Give a complete file its name, in place of the file of that name or only if there is none.

    Raises
    ------
    FileExistsError
        If there is one that is to stay.
    OSError
        If the disk fails.
    """
    _sync(part)
    _name(part, file, overwrite)


def _sync(part: Path) -> None:
    """Put the new bytes on the disk before the old ones lose their name; Windows syncs what is open to write."""
    with part.open("r+b") as written:
        os.fsync(written.fileno())


def _name(part: Path, file: Path, overwrite: bool) -> None:
    if overwrite:
        with suppress(FileNotFoundError):
            part.chmod(stat.S_IMODE(file.stat().st_mode))
        part.replace(file)
        return
    try:
        os.link(part, file)
    except FileExistsError:
        raise
    except OSError:
        # Some disks know no second name for a file.
        if os.path.lexists(file):
            raise FileExistsError(str(file)) from None
        part.rename(file)
        return
    part.unlink()


def _kept(part: Path, file: Path) -> Path:
    """Give a finished file the first free name next to the intended name; it keeps its own where that fails."""
    for number in range(2, 100):
        free = file.with_name(f"{file.stem}-{number}{file.suffix}")
        try:
            _name(part, free, overwrite=False)
        except FileExistsError:
            continue
        except OSError:
            return part
        return free
    return part


def stem(study: str, scene: str) -> str:
    """Name a study's files after it and its scene.

    Examples
    --------
    >>> stem("cost", "Fig 9, a damper in body 2")
    'cost-fig-9-a-damper-in-body-2'
    """
    words = "".join(letter if letter.isalnum() else " " for letter in scene.lower()).split()
    return "-".join([study, *words])
