"""CSV tables of the studies of grain beds (claim C7): their columns, the bundled tables, and how to complete them."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple, TypeVar

from rig.core.base.study import StoredValues, Study, code_digest, digest, read_rows

Row = dict[str, str]
Case = TypeVar("Case", bound=tuple[object, ...])


class Table(NamedTuple):
    """Columns of the table of a study.

    `integers`, `words`: columns of integers and of words; all other columns contain floating-point numbers.
    """

    header: tuple[str, ...]  # names of the columns
    content: str  # description of the content, for messages
    file: str  # name of the bundled file
    integers: tuple[str, ...] = ()
    words: tuple[str, ...] = ()

    @property
    def bundled(self) -> Path:
        """Path of the bundled table."""
        return Path(str(files("analysis.studies.paper") / "data" / self.file))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns in the file; the last contains the digest of the code that computed a row."""
        return (*self.header, "code")

    def study(self, compute: Callable[[Case], Row], case_of: Callable[[Row], Case], *versions: str) -> Study[Case, Row]:
        """Return the study whose results are the rows of this table; rows of other code are computed again.

        `compute`: computes the row of a case; `case_of`: returns the case of a row; `versions`: versions of other
        programs on which the results depend.
        """
        code = digest((code_digest("analysis.studies.paper"), *versions))
        return Study(
            self.content,
            self.columns,
            compute,
            lambda case: (code, case),
            lambda key, row: [*(row[name] for name in self.header), key[0]],
            lambda line: ((line[-1], case_of(self.row(line[:-1]))), self.row(line[:-1])),
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
        """Read the rows of a table, by default the bundled table; damaged rows are skipped.

        If the table has rows of several versions of the code, only rows of the version of the first row are returned.
        The version of the bundled tables is unknown, because these tables have no column for it.
        """
        lines, rows = read_rows(path or self.bundled, self.columns, self.content), []
        for line in lines:
            with suppress(ValueError):
                if line[-1] == lines[0][-1]:
                    rows.append(self.row(line[:-1]))
        return rows


def complete(
    path: Path, study: Study[Case, Row], cases: Sequence[Case], describe: Callable[[Row], str],
    print_line: Callable[[str], None], cluster: str | None = None,
) -> None:  # fmt: skip
    """Compute the missing cases of a table, and sort its rows in the order of `cases`.

    Rows of other cases, and then rows of other versions of the code, are last.

    `path`: CSV file; `describe`: returns a description of a row; `print_line`: called with a line for each new row;
    `cluster`: see `rig.core.base.workers.Workers`. Raises `RunError` if the file is not such a table, or cannot be
    written.
    """
    stored = StoredValues(study, path)
    missing = sum(case not in stored for case in cases)
    for completed, row in enumerate(stored.complete(cases, cluster), 1):
        print_line(f"[{completed}/{missing}] {describe(row)}")
    position = {study.key(case): number for number, case in enumerate(cases)}
    code = study.key(cases[0])[0]
    stored.sort(lambda key: (key[0] != code, position.get(key, len(position)), key))
