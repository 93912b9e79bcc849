"""The file under a recording: it grows by whole commits, so that a full disk leaves nothing half-written."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rig.errors import RecordingError, RunError


class Disk:
    """What the MCAP writer writes into: bytes wait here until `commit` puts them into the file together.

    Parameters
    ----------
    overwrite : bool
        Whether an existing file may be replaced.

    Attributes
    ----------
    failed : bool
        Whether a commit has failed; the file then ends with the commit before.

    Raises
    ------
    RecordingError
        If the file exists, or cannot be made.
    """

    def __init__(self, path: Path, overwrite: bool) -> None:
        self.path = path
        self.failed = False
        self._waiting: list[bytes] = []
        self._committed = self._end = 0
        try:
            self._file = path.open("wb" if overwrite else "xb", buffering=0)
        except FileExistsError:
            raise RecordingError(
                f"{path} exists and is left as it is; choose another name, or ask for it to be overwritten"
            ) from None
        except OSError as error:
            raise RecordingError(f"cannot make {path}: {_reason(error, path.parent)}") from error

    def write(self, data: bytes) -> None:
        """Take bytes for the next commit."""
        if data:
            self._waiting.append(data)
            self._end += len(data)

    def tell(self) -> int:
        """Give the length of the file after the next commit."""
        return self._end

    def flush(self) -> None:
        """Do nothing: the MCAP writer flushes every chunk, but its chunks go to the disk in groups."""

    def commit(self) -> None:
        """Put what waits into the file.

        Raises
        ------
        RunError
            If the disk is full or fails. The file is cut back to the commit before.
        """
        rest = memoryview(b"".join(self._waiting))
        self._waiting.clear()
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self.failed = True
            os.ftruncate(self._file.fileno(), self._committed)
            raise RunError(
                f"cannot write to {self.path}: {error.strerror}; it holds what was flushed before, without "
                f"an end: `daq recover {self.path} -o FIXED.mcap` makes it whole"
            ) from error
        self._committed = self._end

    def free(self) -> int:
        """Give the free bytes of the disk that holds the file."""
        return shutil.disk_usage(self.path).free

    def close(self) -> None:
        """Close the file; what was not committed is dropped."""
        self._file.close()

    @contextmanager
    def removed_on_failure(self) -> Iterator[None]:
        """Leave no file behind if the body fails."""
        try:
            yield
        except BaseException:
            self.close()
            self.path.unlink(missing_ok=True)
            raise


def _reason(error: OSError, folder: Path) -> str:
    """Say why a file could not be made in a folder, and what to do."""
    if not isinstance(error, FileNotFoundError):
        return f"{error.strerror}; choose a place that can be written to"
    if folder.is_dir():
        # Where the folder is there, it is one of the system's own, such as /proc.
        return f"the folder {folder} takes no new files; choose another one"
    return f"there is no folder {folder}; make it first"
