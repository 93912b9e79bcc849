"""Studies that consist of many independent computations (pieces), such as one design at one level.

Workers compute the pieces. A CSV table stores their values, so an interrupted study continues where it stopped.
"""

import csv
import functools
import hashlib
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from rig.core.base.errors import RunError
from rig.core.base.file_lock import lock
from rig.core.base.output_files import atomic_write, create_folder, csv_text, prepare_outputs
from rig.core.base.progress import CountProgress
from rig.core.base.workers import Workers

Piece = TypeVar("Piece")
Value = TypeVar("Value")


@functools.cache
def code_digest(*packages: str) -> str:
    """Return a digest of the version, sources and data sheets of given packages, which identifies a result's code."""
    digest = hashlib.sha256(version("shotrig").encode())
    for package in packages:
        spec = find_spec(package)
        assert spec is not None and spec.origin is not None
        for file in sorted(Path(spec.origin).parent.rglob("*")):
            if file.suffix in (".py", ".yaml"):
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def digest(inputs: object) -> str:
    """Return a short digest of the inputs of a result (bytes of an array, or `repr`) and of the code of `rig`."""
    content = inputs.tobytes() if isinstance(inputs, np.ndarray) else repr(inputs).encode()
    return hashlib.sha256(code_digest("rig").encode() + content).hexdigest()[:16]


@dataclass(frozen=True)
class Study(Generic[Piece, Value]):
    """A study of pieces whose values are stored in a table.

    `compute`: computes the value of a piece; a module-level function, so other processes can import it;
    `decode`: returns key and value of a row; raises `ValueError`, `KeyError` or `TypeError` for a damaged row.
    """

    name: str  # content of the table, for messages, such as "designs"
    columns: tuple[str, ...]  # column names of the table
    compute: Callable[[Piece], Value]
    key: Callable[[Piece], Any]  # returns the identity of a piece, which includes all its inputs
    encode: Callable[[Any, Value], Sequence[object]]  # returns the table row for a key and a value
    decode: Callable[[list[str]], tuple[Any, Value]]

    def is_table(self, path: Path) -> bool:
        """Return whether a file is a table of this study, or is missing or empty."""
        if not path.exists() or not path.stat().st_size:
            return True
        try:
            read_rows(path, self.columns, self.name)
        except RunError:
            return False
        return True

    @contextmanager
    def reserve(self, table: Path) -> Iterator[None]:
        """Lock `unfinished_file` during the `with` block; remove it unless it has values of an interrupted run.

        Raises `RunError` if another command computes the same table, or `unfinished_file` belongs to a different study
        and the user has not allowed to replace it.
        """
        file, is_complete = unfinished_file(table), False
        create_folder(table.parent, RunError)
        with ExitStack() as open_files:
            try:
                # Windows cannot replace an open file.
                if sys.platform != "win32" and not lock(open_files.enter_context(file.open("ab"))):
                    raise RunError(
                        f"{table}: another command is computing this table, and has locked {file.name}. Wait until it "
                        "ends, or choose another folder with -o."
                    )
                if not self.is_table(file):
                    prepare_outputs(file, error_type=RunError)
                    file.write_bytes(b"")
            except OSError as error:
                raise RunError(
                    f"{file} cannot be written ({error.strerror}). Remove it, or choose another folder with -o."
                ) from None
            try:
                yield
                is_complete = True
            finally:
                if is_complete or (file.exists() and not file.stat().st_size):
                    file.unlink(missing_ok=True)

    def run(
        self, pieces: Sequence[Piece], table: Path | None = None, cluster: str | None = None,
        progress: CountProgress | None = None, prepare: Callable[[], object] = lambda: None,
    ) -> list[Value]:  # fmt: skip
        """Compute pieces that are missing in the table; return the values of all pieces.

        `table`: CSV file; pieces in this file are not recomputed; `cluster`: see `rig.core.base.workers.Workers`;
        `prepare`: called before the first piece is computed. Raises `RunError` if the table cannot be read or written,
        or a worker process ends unexpectedly.
        """
        stored, report = StoredValues(self, table), progress or (lambda n_completed, total: None)
        n_completed = sum(piece in stored for piece in pieces)
        if n_completed:
            report(n_completed, len(pieces))
        if n_completed < len(pieces):
            prepare()
        for number, _ in enumerate(stored.complete(pieces, cluster), n_completed + 1):
            report(number, len(pieces))
        return [stored[piece] for piece in pieces]


class StoredValues(Generic[Piece, Value]):
    """Values of a study's pieces, in memory and in an optional table that is written to disk row by row.

    `path`: CSV file; created with its folder if it does not exist. An incomplete last line is removed. Raises
    `RunError` if the file is not a table of this study, or cannot be written.
    """

    def __init__(self, study: Study[Piece, Value], path: Path | None) -> None:
        self.study, self._path = study, path
        self.values: dict[Any, Value] = {}
        if path is None:
            return
        create_folder(path.parent, RunError)
        try:
            content = path.read_bytes() if path.exists() else b""
            rows = _parse_rows(path, content, study.columns, study.name) if content else []
            with path.open("ab") as file:
                # Only an incomplete line is removed, because another process may add rows.
                if _complete_length(content) < len(content):
                    file.truncate(_complete_length(content))
        except OSError as error:
            raise RunError(
                f"{path} cannot be written ({error.strerror}). Choose another name or folder with -o."
            ) from None
        for row in rows:
            try:
                key, value = study.decode(row)
            except (ValueError, KeyError, TypeError):
                continue
            self.values[key] = value

    def __contains__(self, piece: Piece) -> bool:
        return self.study.key(piece) in self.values

    def __getitem__(self, piece: Piece) -> Value:
        return self.values[self.study.key(piece)]

    def add(self, piece: Piece, value: Value) -> None:
        """Store the value of a piece."""
        key = self.study.key(piece)
        self.values[key] = value
        self._append(self.study.encode(key, value))

    def complete(self, pieces: Sequence[Piece], cluster: str | None = None) -> Iterator[Value]:
        """Compute missing pieces; yield each value after it is stored."""
        missing = [piece for piece in pieces if piece not in self]
        if missing:
            with Workers(cluster) as workers:
                for number, value in workers.compute(self.study.compute, missing):
                    self.add(missing[number], value)
                    yield value

    def sort(self, order: Callable[[Any], Any] | None = None) -> None:
        """Sort the table by its keys so that the file does not depend on the order of computation."""
        if self._path is None:
            return
        rows = [self.study.encode(key, self.values[key]) for key in sorted(self.values, key=order)]
        with atomic_write(self._path, overwrite=True) as temporary:
            temporary.write_text(csv_text([self.study.columns, *rows]), encoding="utf-8", newline="")

    def _append(self, *rows: Sequence[object]) -> None:
        """Append rows to the file of the table, with the heading if another process has removed the file."""
        # One call writes all rows: after an interruption they are complete or missing, unless the disk is full.
        if self._path is not None:
            with self._path.open("a", newline="", encoding="utf-8") as file:
                file.write(csv_text([*([] if file.tell() else [self.study.columns]), *rows]))


def unfinished_file(table: Path) -> Path:
    """Return the file that stores results until a table is complete."""
    return table.with_name(f"{table.name}.kept")


def read_rows(path: Path, header: Sequence[str], name: str) -> list[list[str]]:
    """Read the rows of a table without changing it; raise `RunError` if it is unreadable or not such a table."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path} cannot be read ({error.strerror}). Check the path and its permissions.") from None
    return _parse_rows(path, content, header, name)


def _complete_length(content: bytes) -> int:
    """Return the length of the complete lines; a truncated number would be a wrong number."""
    return content.rfind(b"\n") + 1


def _parse_rows(path: Path, content: bytes, header: Sequence[str], name: str) -> list[list[str]]:
    lines = content[: _complete_length(content)].decode("utf-8", errors="replace").splitlines()
    rows = [_cells(line) for line in lines]
    if rows[:1] != [list(header)]:
        raise RunError(f"{path}: this file is not a table of {name}. Move the file, or choose another name with -o.")
    return [row for row in rows[1:] if len(row) == len(header)]


def _cells(line: str) -> list[str]:
    """Parse a single line so that an open quote does not affect other rows.

    >>> _cells('a,"1, 2"'), _cells('b,"torn'), _cells("x" * 200_000)
    (['a', '1, 2'], ['b', 'torn'], [])
    """
    try:
        return next(csv.reader([line]), [])
    except csv.Error:
        # The line exceeds the field size limit of the csv module.
        return []
