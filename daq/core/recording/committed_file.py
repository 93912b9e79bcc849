"""The file of a recording, which grows by whole commits, so a full disk leaves no half-written record.

A commit writes all bytes that were collected since the previous commit. A file that replaces another file is first
written next to it (a recorder names it `NAME.part`), and renamed when it is complete.
"""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from glob import escape
from io import FileIO
from pathlib import Path
from typing import IO

from rig.core.base.errors import RecordingError, RunError
from rig.core.base.file_lock import lock
from rig.core.base.output_files import rename_complete, resolve_output

# Maximum number of byte strings joined for one write; joining all would double the memory for thousands of channels.
_MAX_PARTS_PER_WRITE = 256
# Disk space that is kept free for the end of the file and the display [bytes].
RESERVE = 1 << 20


class DiskError(RunError):
    """The disk is full or fails."""


class LostPathError(DiskError):
    """The file was moved or deleted, or cannot be renamed; the message is complete."""


class CommittedFile:
    """The output of the MCAP writer: `write` collects bytes in memory, `commit` writes them to the disk together.

    The folder of the file is created, and the file itself by the first commit, so a killed process leaves no empty
    file. `current_path` differs from `path` while an existing file is being replaced. If `failed`, the file ends with
    the previous commit. `ending`: ending of the file's name until it replaces another file. Raises `RecordingError` if
    the file exists or cannot be created.
    """

    def __init__(self, path: Path, overwrite: bool, ending: str = ".part") -> None:
        self.path, self._ending = path, ending
        self.failed = self._is_complete = self._keeps_old = False
        self._waiting: list[bytes] = []
        self._committed = self._end = 0
        self._final = self.current_path = resolve_output(path, overwrite, RecordingError)
        self._old: IO[bytes] | None = None
        self._file: FileIO | None = None

    def _open(self) -> FileIO:
        """Create the file and lock it; also lock the file that it will replace."""
        path = self.path
        with ExitStack() as open_files:
            try:
                self._old = open_files.enter_context(self._final.open("rb")) if self._final.exists() else None
                if self._old is not None:
                    _lock(self._old, path)
                    self.current_path = _unused_name(self._final, self._ending)
                file = open_files.enter_context(self.current_path.open("xb", buffering=0))
            except FileExistsError:
                raise RecordingError(
                    f"{path}: another process created it in the meantime. Choose another name."
                ) from None
            except OSError as error:
                raise RecordingError(f"{path} cannot be created ({error.strerror}). Choose another file.") from error
            _lock(file, path)
            open_files.pop_all()
        return file

    def write(self, data: bytes) -> None:
        """Collect bytes for the next commit."""
        if data:
            self._waiting.append(data)
            self._end += len(data)

    def tell(self) -> int:
        """Return the length of the file after the next commit."""
        return self._end

    def commit(self) -> None:
        """Write the waiting bytes; on `DiskError` the file is truncated to the previous commit."""
        waiting, self._waiting = self._waiting, []
        file = self._file = self._file or self._open()
        try:
            for first in range(0, len(waiting), _MAX_PARTS_PER_WRITE):
                unwritten = memoryview(b"".join(waiting[first : first + _MAX_PARTS_PER_WRITE]))
                while unwritten:
                    unwritten = unwritten[file.write(unwritten) :]
        except OSError as error:
            self.failed = True
            with suppress(OSError):
                os.ftruncate(file.fileno(), self._committed)
            raise DiskError(f"{self.current_path} cannot be written ({error.strerror})") from error
        self._committed = self._end
        if not os.fstat(file.fileno()).st_nlink and not self._is_in_place():
            self.failed = True
            raise LostPathError(f"{self.current_path}: the file was deleted while it was written. Write it again.")

    def free(self) -> int:
        """Return the free space of the file's disk in bytes; raise `DiskError` if the disk fails."""
        if sys.platform == "win32" or self._file is None:
            # Windows cannot move or delete an open file: it is still on the disk of its folder.
            return shutil.disk_usage(self.current_path.parent).free
        try:
            disk = os.fstatvfs(self._file.fileno())
        except OSError as error:
            raise DiskError(
                f"{self.current_path}: its disk fails ({error.strerror}). Check the disk, or record to another."
            ) from error
        return disk.f_bavail * disk.f_frsize

    def _is_in_place(self) -> bool:
        """Return whether the file has been created and is still at its path."""
        try:
            return self._file is not None and os.path.samestat(os.fstat(self._file.fileno()), self.current_path.stat())
        except OSError:
            return False

    def finish(self) -> None:
        """Commit the last bytes, and rename the file; `DiskError` if the disk fails, or the file was moved."""
        self.commit()
        self._is_complete = True
        if not self._is_in_place():
            raise LostPathError(
                f"{self.current_path}: the file was moved while it was written. It is complete under its new name."
            )
        if self._keeps_old or not self.replaces:
            return
        # Windows cannot replace an open file: another process that locks the old file now will replace the new one.
        self.close()
        try:
            rename_complete(self.current_path, self._final, overwrite=True)
        except OSError as error:
            raise LostPathError(
                f"{self.path} cannot be replaced ({error.strerror}). Use the new recording {self.current_path}."
            ) from error
        self.current_path = self._final

    @property
    def replaces(self) -> bool:
        """Whether the complete file will replace another file."""
        return self.current_path != self._final

    def keep_old(self) -> None:
        """Keep the file that would have been replaced; the new file stays at `current_path`."""
        self._keeps_old = True

    def discard(self) -> None:
        """Close the file; if it would have replaced another file, remove it and leave the other file unchanged."""
        if self.replaces:
            self._remove()
        self.close()

    def _remove(self) -> None:
        """Close the file, and remove it unless another file is at its path now."""
        is_in_place = self._is_in_place()
        self.close()
        if is_in_place:
            self.current_path.unlink()

    def close(self) -> None:
        """Close the file; bytes that were not committed are dropped."""
        for file in (self._file, self._old):
            if file is not None:
                file.close()

    @contextmanager
    def removed_on_failure(self) -> Iterator[None]:
        """Remove the new file if the body fails, but not a complete file that could not be renamed."""
        try:
            yield
        except BaseException:
            if not self._is_complete:
                self._remove()
            self.close()
            raise


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock an existing file during the body; raise `RecordingError` if another process is recording to it."""
    # Windows cannot replace a file that a recorder, or this function, has opened.
    if sys.platform == "win32" or not path.is_file():
        yield
        return
    with path.open("rb") as file:
        _lock(file, path)
        yield


def _unused_name(path: Path, ending: str) -> Path:
    """Return an unused name next to a file; the `.part` file of a killed recorder is not replaced.

    >>> _unused_name(Path("there-is-no-such-folder/run.mcap"), ".part").name
    'run.mcap.part'
    """
    part, number = path.with_name(f"{path.name}{ending}"), 1
    while os.path.lexists(part):
        number += 1
        part = path.with_name(f"{path.name}{ending}{number}")
    return part


def remove_unfinished(path: Path, ending: str) -> None:
    """Remove incomplete replacements of a file that killed processes left; only for files that can be made again."""
    for part in path.parent.glob(f"{escape(path.name)}{ending}*"):
        with suppress(OSError, RecordingError), locked(part):
            part.unlink()


def _lock(file: IO[bytes], path: Path) -> None:
    """Lock the file against other recorders; raise `RecordingError` if it is locked already."""
    if not lock(file):
        raise RecordingError(f"{path}: another process is recording to it. Choose another name.")
