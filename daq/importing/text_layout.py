"""How a text table is written: its encoding, delimiter, decimal mark, and the names and units in its heading."""

from __future__ import annotations

import csv
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from rig.errors import RecordingError

# Maximum number of lines before the first line of numbers.
_MAX_HEADING_LINES = 200
# A unit in brackets after a name; the unit may contain parentheses.
_UNIT_IN_BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\[\]()]*(?:\([^\[\]()]*\)[^\[\]()]*)?)[\])]\s*")
# A unit after an underscore, as in our own tables.
_UNIT_AFTER_UNDERSCORE = re.compile(r"(.+)_(m/s\^2|m/s²|m/s|m|N|V|g|s|ms)")
# First cells of a line of units, and the longest unit.
_TIME_UNITS = ("s", "ms", "us", "sec", "Seconds", "")
_MAX_UNIT_LENGTH = 12
#: Name of a column without a name.
UNNAMED = "column {}"
# Digits of a second's fraction in a time of day.
_FRACTION = re.compile(r":\d\d[.,](\d+)")
# A stamp is read to microseconds.
_STAMP_DIGITS = 6


class Layout(NamedTuple):
    """How a table is written."""

    encoding: str
    delimiter: str | None  # None: any number of blanks
    decimal_comma: bool
    heading: int  # Lines in front of the first line of numbers
    names: list[str]
    units: list[str]
    cells: tuple[int, ...] | None = None  # cells of a line that are read; None: all


def beginning(path: Path) -> tuple[list[str], str]:
    """Return the first lines of a table, at least one, and its encoding."""
    with path.open("rb") as binary:
        begin = binary.read(1 << 18)
    wide = begin.startswith((b"\xff\xfe", b"\xfe\xff"))
    if b"\0" in begin and not wide:
        raise RecordingError(f"{path} is not text; expected a table of numbers")
    encoding = "utf-16" if wide else "utf-8-sig"
    try:
        text = begin.decode(encoding)
    except UnicodeDecodeError as error:
        # The last character may be incomplete.
        encoding = encoding if error.start > len(begin) - 4 else "cp1252"
        text = begin.decode(encoding, errors="replace")
    return text.splitlines()[:_MAX_HEADING_LINES] or [""], encoding


def detect_layout(path: Path, lines: list[str], encoding: str) -> Layout:
    """Detect the layout of a table from its first lines; raise `RecordingError` if none is a line of numbers."""
    for heading, line in enumerate(lines):
        for delimiter in ("\t", ";", ",", None):
            row = cells(line, delimiter)
            comma = delimiter != "," and "," in line
            values = [number(cell, comma) for cell in row]
            if len(values) > 1 and values[0] is None:
                values[0] = seconds_of_stamp(row[0])
            # Empty cells are NaN; a line of empty cells alone has no numbers.
            are_numbers = None not in values and any(value == value for value in values)
            if len(row) < (1 if delimiter is None else 2) or not are_numbers:
                continue
            above = [
                cells(each.lstrip("#%").strip() if each[:1] in "#%" else each, delimiter)
                for each in lines[:heading]
                if each.strip()
            ]
            width, read = len(row), None
            if width > 2 and not row[-1] and above and len(above[-1]) == width - 1:
                # A delimiter behind the last number of each line.
                width, read = width - 1, tuple(range(width - 1))
            return Layout(encoding, delimiter, comma, heading, *_heading(above, width), read)
    raise RecordingError(
        f"{path}: no line of numbers among its first {len(lines)} lines; expected a table of numbers"
    )


def _heading(above: list[list[str]], width: int) -> tuple[list[str], list[str]]:
    """Read names and units from the lines above the numbers."""
    rows = [[cell.strip(" ,;") for cell in row] for row in above[-2:] if len(row) == width]
    if not rows or len(above[-1]) != width:
        return [UNNAMED.format(number) for number in range(1, width + 1)], [""] * width
    names, units = rows[-1], [""] * width
    are_units = all(len(cell) <= _MAX_UNIT_LENGTH for cell in rows[-1])
    are_units &= rows[-1][0].strip("[]()") in _TIME_UNITS
    if len(rows) == 2 and not any(map(_UNIT_IN_BRACKETS.fullmatch, rows[0])) and are_units:
        names, units = rows[0], [cell.strip("[]()") for cell in rows[1]]
    else:
        for place, cell in enumerate(names):
            if match := _UNIT_IN_BRACKETS.fullmatch(cell) or _UNIT_AFTER_UNDERSCORE.fullmatch(cell):
                names[place], units[place] = match[1], match[2].strip()
    return [name or UNNAMED.format(k) for k, name in enumerate(names, 1)], units


def cells(line: str, delimiter: str | None) -> list[str]:
    """Split a line into cells."""
    if delimiter is None:
        return line.split()
    try:
        (row,) = list(csv.reader([line.rstrip("\r\n")], delimiter=delimiter)) or [[]]
    except csv.Error:
        # The csv module rejects cells of more than a hundred thousand characters.
        return [line]
    return [cell.strip() for cell in row]


def number(cell: str, decimal_comma: bool) -> float | None:
    """Read a cell: a number, NaN if it is empty, None if it is something else."""
    if not cell:
        return float("nan")
    try:
        return float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return None


def seconds_of_stamp(cell: str) -> float | None:
    """Read a time of day (ISO 8601), behind a date or alone, as seconds since 1970; None if it is something else.

    Without a zone it is taken as UTC: only differences of times count.

    >>> seconds_of_stamp("1970-01-02 00:00:00.25"), seconds_of_stamp("1970-01-01T00:00:01Z"), seconds_of_stamp("1.5")
    (86400.25, 1.0, None)
    >>> seconds_of_stamp("00:01:00.5")
    60.5
    """
    if ":" not in cell:
        return None
    whole = cell if re.match(r"\d{4}-?\d\d", cell) else f"1970-01-01T{cell}"
    try:
        stamp = datetime.fromisoformat(whole)
    except ValueError:
        return None
    return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()


def resolution_of_stamp(cell: str) -> float:
    """Return the size of the last digit that is read from a stamp, s.

    >>> resolution_of_stamp("2024-05-01 10:00:00"), resolution_of_stamp("2024-05-01 10:00:00.0625")
    (1.0, 0.0001)
    """
    fraction = _FRACTION.search(cell)
    return float(f"1e-{min(len(fraction[1]), _STAMP_DIGITS)}") if fraction else 1.0


def significant_digits(cell: str) -> int:
    """Count the significant digits of a number as it is written.

    >>> significant_digits("0.0125"), significant_digits("1.250E-2"), significant_digits("-12")
    (3, 4, 2)
    """
    mantissa = re.split("[eE]", cell)[0]
    return len(re.sub(r"\D", "", mantissa).lstrip("0"))
