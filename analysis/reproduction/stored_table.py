"""CSV tables of the studies of grain beds (claim C7): their columns, the bundled tables, and how to complete them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple, TypeVar

from rig.study import StoredValues, Study, read_rows

Row = dict[str, str]
Case = TypeVar("Case", bound=tuple[object, ...])


class Table(NamedTuple):
    """Columns of the table of a study.

    `integers`, `words`: columns of integers and of words; all other columns contain floating-point numbers.
    """

    header: tuple[str, ...]  # names of its columns
    content: str  # description of the content, for messages
    file: str  # name of the bundled file
    integers: tuple[str, ...] = ()
    words: tuple[str, ...] = ()

    @property
    def bundled(self) -> Path:
        """Path of the bundled table."""
        return Path(str(files("analysis.reproduction") / "data" / self.file))

    def study(self, compute: Callable[[Case], Row], case_of: Callable[[Row], Case]) -> Study[Case, Row]:
        """Return the study whose results are the rows of this table.

        `compute`: computes the row of a case; `case_of`: returns the case of a row.
        """
        return Study(
            self.content,
            self.header,
            compute,
            lambda case: case,
            lambda _, row: [row[name] for name in self.header],
            lambda line: (case_of(self.row(line)), self.row(line)),
        )

    def row(self, line: Sequence[str]) -> Row:
        """Convert a line to a row; raise `ValueError` if a cell has the wrong type for its column."""
        for name, cell in zip(self.header, line, strict=True):
            if name not in self.words:
                (int if name in self.integers else float)(cell)
            elif not cell:
                raise ValueError(name)
        return dict(zip(self.header, line, strict=True))

    def read(self, path: Path | None = None) -> list[Row]:
        """Read the rows of a table, by default the bundled table; damaged rows are skipped."""
        rows = []
        for line in read_rows(path or self.bundled, self.header, self.content):
            with suppress(ValueError):
                rows.append(self.row(line))
        return rows


def complete(
    path: Path, study: Study[Case, Row], cases: Sequence[Case], describe: Callable[[Row], str],
    print_line: Callable[[str], None], cluster: str | None = None,
) -> None:  # fmt: skip
    """Compute the missing cases of a table, and sort its rows in the order of `cases`; rows of other cases are last.

    `path`: CSV file; `describe`: returns a description of a row; `print_line`: called with a line for each new row;
    `cluster`: see `rig.workers.Workers`. Raises `RunError` if the file is not such a table, or cannot be written.
    """
    stored = StoredValues(study, path)
    missing = sum(case not in stored for case in cases)
    for completed, row in enumerate(stored.complete(cases, cluster), 1):
        print_line(f"[{completed}/{missing}] {describe(row)}")
    position = {case: number for number, case in enumerate(cases)}
    stored.sort(lambda case: (position.get(case, len(position)), case))
