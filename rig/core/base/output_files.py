"""Output files: written atomically; an existing file is replaced only if the user allows it.

`--overwrite` or `overwrite=True` allows the replacement. Without it, a command on a terminal asks before its work
starts.
"""

import io
import os
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from rig.core.base.errors import RunError, SceneError, ShotrigError
from rig.core.base.escaping import escape_cell

#: Maximum number of characters of a scene's name in a file name; file systems allow 255 bytes for the whole name.
_MAX_SCENE_LENGTH = 80
#: Suffixes of output files, which are not accepted for folders.
_FILE_SUFFIXES = (".png", ".svg", ".csv", ".html", ".mcap", ".npz", ".yaml", ".pdf")
# Function that is called before existing files are replaced, and returns whether they may be replaced.
_confirm_replacement: ContextVar[Callable[[Sequence[Path]], bool]] = ContextVar(
    "confirm_replacement", default=lambda paths: False
)


@contextmanager
def allow_overwriting(allowed: bool) -> Iterator[None]:
    """Allow outputs written inside the `with` block to replace existing files, if `allowed`."""
    token = _confirm_replacement.set((lambda paths: True) if allowed else _confirm_replacement.get())
    try:
        yield
    finally:
        _confirm_replacement.reset(token)


def ask_before_replacing(ask: Callable[[Sequence[Path]], bool]) -> None:
    """Ask whether existing files may be replaced, instead of raising an error."""
    _confirm_replacement.set(ask)


def _is_allowed(*existing: Path) -> bool:
    """Return whether files may be replaced; a positive answer applies to the whole command."""
    if allowed := _confirm_replacement.get()(existing):
        _confirm_replacement.set(lambda paths: True)
    return allowed


def create_folder(folder: Path, error_type: type[ShotrigError] = SceneError) -> None:
    """Create an output folder if it does not exist, and check that files can be created in it.

    `error_type`: type of the error. Raises `ShotrigError` if the folder is not writable, or does not exist and has the
    suffix of an output file.
    """
    from tempfile import TemporaryFile

    try:
        if folder.suffix.lower() in _FILE_SUFFIXES and not folder.exists():
            raise error_type(
                f"{folder}: this is the name of a file, but a folder is expected. Give the name of a folder, such as "
                f"{folder.with_suffix('')}."
            )
        folder.mkdir(parents=True, exist_ok=True)
        # A file is created as a test: the folder /proc has permissions for new files, but rejects them.
        with TemporaryFile(dir=folder):
            pass
    except (FileExistsError, NotADirectoryError):
        raise error_type(f"{folder} cannot be created, because a file has this name. Choose another folder.") from None
    except FileNotFoundError:
        raise error_type(f"{folder}: accepts no new files. Choose another folder.") from None
    except OSError as error:
        raise error_type(f"{folder} cannot be written ({error.strerror}). Choose another folder.") from None


def prepare_outputs(*paths: Path, error_type: type[ShotrigError] = SceneError) -> None:
    """Create the folders of output files, and reject paths that must not be written, before the work starts.

    Raises `ShotrigError` (`error_type`) if `resolve_output` rejects a path, or if files exist and may not be replaced.
    """
    existing = [path for path in paths if resolve_output(path, True, error_type).exists()]
    if existing and not _is_allowed(*existing):
        names = ", ".join(map(str, existing))
        verb = "exists" if len(existing) == 1 else "exist"
        raise error_type(f"{names} {verb}. Choose another name or folder, or pass `overwrite`.")


def resolve_output(path: Path, overwrite: bool, error_type: type[ShotrigError] = SceneError) -> Path:
    """Resolve the path of an output file, create its folder, and reject a file that must not be written.

    `path`: file to create or replace; symbolic links are followed; `overwrite`: whether an existing file may be
    replaced without a question; `error_type`: type of the error. Returns the resolved path. Raises `ShotrigError` if a
    special file or a file that may not be replaced exists at this path, or `create_folder` rejects its folder.
    """
    try:
        file = path.resolve()
        existing = _status(file)
    except (OSError, ValueError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise error_type(f"cannot create {path}: {reason}. Choose another name or folder.") from None
    if existing is not None:
        if not stat.S_ISREG(existing.st_mode):
            raise error_type(f"{path} is a folder or a device. Choose another name.")
        if not (overwrite or _is_allowed(path)):
            raise error_type(f"{path} exists. Choose another name, or pass `overwrite`.")
        if not os.access(file, os.W_OK):
            raise error_type(f"{path} is write-protected. Choose another name.")
    create_folder(file.parent, error_type)
    return file


def _status(file: Path) -> os.stat_result | None:
    """Return the status of a file; None if it does not exist."""
    try:
        return file.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None


@contextmanager
def atomic_write(path: Path, overwrite: bool = False) -> Iterator[Path]:
    """Write a temporary file, and rename it to its final name when it is complete.

    `path` always contains the complete old or the complete new file. If a finished file cannot be renamed, it is saved
    under another name, given in the error message.

    `path`: file to create or replace; its folder is created; `overwrite`: whether an existing file may be replaced
    without a question. Yields the temporary file, with the suffix of `path`. Raises `RunError` if the disk is full or
    fails, `SceneError` if `resolve_output` rejects `path` or such a file was created in the meantime.
    """
    file = resolve_output(path, overwrite)
    overwrite = overwrite or file.exists()
    temporary = _new_temporary(file)
    try:
        yield temporary
        _sync(temporary)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            reason = error.strerror or error
            raise RunError(f"cannot write {path}: {reason}. Free disk space, or choose another folder.") from error
        raise
    try:
        _rename(temporary, file, overwrite)
    except FileExistsError:
        raise SceneError(
            f"{path}: another program created this file in the meantime. The result was saved as "
            f"{_save_next_to(temporary, file)} instead."
        ) from None
    except OSError as error:
        raise RunError(
            f"cannot write {path}: {error.strerror or error}. The result was saved as {_save_next_to(temporary, file)} "
            "instead."
        ) from error


def _new_temporary(file: Path) -> Path:
    """Return the name of a temporary file for an output; remove temporary files of killed processes."""
    prefix = _remove_leftovers(file.parent, name_digest(file.name))
    return file.with_name(f"{prefix}{os.urandom(4).hex()}{file.suffix}")


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a folder for temporary files and remove it at the end; remove leftovers of killed processes first."""
    from tempfile import TemporaryDirectory, gettempdir

    with TemporaryDirectory(prefix=_remove_leftovers(Path(gettempdir()), "shotrig")) as folder:
        yield Path(folder)


def _remove_leftovers(folder: Path, label: str) -> str:
    """Remove temporary files and folders of ended processes; return the prefix of the names of this process."""
    import platform
    import shutil

    # The name contains the host and the process that writes.
    prefix = f".{label}-{name_digest(platform.node())}-"
    for other in folder.glob(f"{prefix}*"):
        process = other.name.removeprefix(prefix).partition("-")[0]
        if process.isdecimal() and not _is_running(int(process)):
            if other.is_dir():
                shutil.rmtree(other, ignore_errors=True)
            else:
                with suppress(OSError):
                    other.unlink()
    return f"{prefix}{os.getpid()}-"


def name_digest(text: str) -> str:
    """Return six digits of a digest of a name, which is not necessarily valid UTF-8."""
    from hashlib import sha256

    return sha256(os.fsencode(text)).hexdigest()[:6]


def _is_running(process: int) -> bool:
    import psutil

    try:
        # The parent of a killed process may be slow to collect its exit code.
        return bool(psutil.Process(process).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
    except psutil.AccessDenied:
        return True


def rename_complete(temporary: Path, file: Path, overwrite: bool) -> None:
    """Rename a complete file to its final name, replacing an existing file only if allowed.

    Raises `FileExistsError` if another file of that name exists. Raises `OSError` if the disk fails.
    """
    _sync(temporary)
    _rename(temporary, file, overwrite)


def _sync(temporary: Path) -> None:
    """Flush the new file to disk before the old file is replaced; Windows requires write access for this."""
    with temporary.open("r+b") as file:
        os.fsync(file.fileno())


def _rename(temporary: Path, file: Path, overwrite: bool) -> None:
    if overwrite:
        with suppress(FileNotFoundError):
            temporary.chmod(stat.S_IMODE(file.stat().st_mode))
        temporary.replace(file)
        return
    try:
        os.link(temporary, file)
    except FileExistsError:
        raise
    except OSError:
        # Some file systems do not support hard links.
        if os.path.lexists(file):
            raise FileExistsError(str(file)) from None
        temporary.rename(file)
        return
    temporary.unlink()


def _save_next_to(temporary: Path, file: Path) -> Path:
    """Rename a finished file to the first free name next to the intended name, if possible."""
    for number in range(2, 100):
        free_name = file.with_name(f"{file.stem}-{number}{file.suffix}")
        try:
            _rename(temporary, free_name, overwrite=False)
        except FileExistsError:
            continue
        except OSError:
            return temporary
        return free_name
    return temporary


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as CSV, with a line feed after each; text cells are escaped."""
    import csv

    text = io.StringIO(newline="")
    escaped = ([escape_cell(cell) if isinstance(cell, str) else cell for cell in row] for row in rows)
    csv.writer(text, lineterminator="\n").writerows(escaped)
    return text.getvalue()


def file_stem(study: str, scene: str) -> str:
    """Return the file stem for a study and the name of its scene; a very long name is cut after a word.

    >>> file_stem("cost", "Fig 9, a damper in body 2 of clearance 0.98 mm")
    'cost-fig-9-a-damper-in-body-2-of-clearance-0-98-mm'
    """
    name = "-".join("".join(letter if letter.isalnum() else " " for letter in scene.lower()).split())
    if len(name) > _MAX_SCENE_LENGTH:
        name = name[:_MAX_SCENE_LENGTH].rpartition("-")[0] or name[:_MAX_SCENE_LENGTH]
    return f"{study}-{name}" if name else study
