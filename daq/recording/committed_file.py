"""The file of a recording: it grows by whole commits, so that a full disk leaves no half-written record.

A file that replaces another is written next to it and takes its name once it is complete.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

from rig.errors import RecordingError, RunError
from rig.output_files import rename_complete, resolve_output

# Number of pieces that are joined for one write: all pieces of thousands of channels would be in memory twice.
_PIECES_PER_WRITE = 256
# Reserve on the disk for the end of the file, and for the display, bytes.
RESERVE = 1 << 20


class DiskError(RunError):
    """The disk is full or fails; the message states the content of the file."""


def make_folder(path: Path) -> None:
    """Create the folder of a recording; raises `RecordingError` if it cannot be created."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot make the folder {path.parent.absolute()} ({error.strerror}). Choose a place that can be "
            "written to (-o FILE.mcap)."
        ) from None


class Disk:
    """The stream of the MCAP writer: bytes wait in memory until `commit` writes them together.

    The file `at` lies next to an existing file that is to be replaced. After `failed`, it ends with the previous
    commit. Raises `RecordingError` if the file exists or cannot be made.
    """

    def __init__(self, path: Path, overwrite: bool) -> None:
        self.path = path
        self.failed = self._is_complete = False
        self._waiting: list[bytes] = []
        self._committed = self._end = 0
        self._final = self.at = resolve_output(path, overwrite, RecordingError)
        with ExitStack() as opened:
            try:
                self._old = opened.enter_context(self._final.open("rb")) if self._final.exists() else None
                if self._old is not None:
                    _lock(self._old, path)
                    self.at = _unused(self._final)
                self._file = opened.enter_context(self.at.open("xb", buffering=0))
            except FileExistsError:
                raise RecordingError(
                    f"{path}: another process created it in the meantime. Choose another name."
                ) from None
            except OSError as error:
                raise RecordingError(f"{path}: cannot create ({_reason(error, path.parent)}") from error
            _lock(self._file, path)
            opened.pop_all()

    def write(self, data: bytes) -> None:
        """Take bytes for the next commit."""
        if data:
            self._waiting.append(data)
            self._end += len(data)

    def tell(self) -> int:
        """Return the length of the file after the next commit."""
        return self._end

    def commit(self) -> None:
        """Write the waiting bytes; on `DiskError` the file is truncated to the previous commit."""
        waiting, self._waiting = self._waiting, []
        try:
            for first in range(0, len(waiting), _PIECES_PER_WRITE):
                unwritten = memoryview(b"".join(waiting[first : first + _PIECES_PER_WRITE]))
                while unwritten:
                    unwritten = unwritten[self._file.write(unwritten) :]
        except OSError as error:
            self.failed = True
            os.ftruncate(self._file.fileno(), self._committed)
            raise DiskError(f"{self.at}: cannot write ({error.strerror})") from error
        self._committed = self._end

    def free(self) -> int:
        """Return the free bytes of the disk that holds the file."""
        return shutil.disk_usage(self.at).free

    def finish(self) -> None:
        """Write the waiting bytes, which complete the file, and give it its name.

        Raises `DiskError` if the disk is full or fails, `RunError` if the file cannot get its name.
        """
        self.commit()
        self._is_complete = True
        if self.at == self._final:
            return
        # Windows cannot replace an open file: another process that locks the old file now will replace the new one.
        self.close()
        try:
            rename_complete(self.at, self._final, overwrite=True)
        except OSError as error:
            raise RunError(
                f"{self.path}: cannot replace ({error.strerror}). Use the new recording {self.at}."
            ) from error
        self.at = self._final

    def discard(self) -> None:
        """Keep the old file, if there is one, and remove the new one, which holds no samples."""
        self.close()
        if self.at != self._final:
            self.at.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; bytes that were not committed are dropped."""
        self._file.close()
        if self._old is not None:
            self._old.close()

    @contextmanager
    def removed_on_failure(self) -> Iterator[None]:
        """Remove the new file if the body fails, except a complete one that could not get its name."""
        try:
            yield
        except BaseException:
            self.close()
            if not self._is_complete:
                self.at.unlink(missing_ok=True)
            raise


def _unused(path: Path) -> Path:
    """Return an unused name next to a file; the partial file of a killed process is not replaced.

    >>> _unused(Path("there-is-no-such-folder/run.mcap")).name
    'run.mcap.part'
    """
    part, number = path.with_name(f"{path.name}.part"), 1
    while os.path.lexists(part):
        number += 1
        part = path.with_name(f"{path.name}.part{number}")
    return part


def _lock(file: IO[bytes], path: Path) -> None:
    """Lock the file against other recorders; raise `RecordingError` if it is locked already."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RecordingError(f"{path}: another process is recording to it. Choose another name.") from None
    except (ImportError, OSError):
        # Not every system and disk supports locks.
        return


def _reason(error: OSError, folder: Path) -> str:
    """State why a file could not be created in a folder, and the remedy."""
    if not isinstance(error, FileNotFoundError):
        return f"{error.strerror}). Choose a folder that you can write to."
    if folder.is_dir():
        # A folder of the system, such as /proc.
        return f"the folder {folder} accepts no new files). Choose another folder."
    return f"there is no folder {folder}). Create it first."
