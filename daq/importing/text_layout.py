"""The layout of a text table: its encoding, delimiter, decimal mark, and the names and units in its heading.

Above its text tables (.lvm) LabVIEW writes names, units, clocks, and which columns contain times. Facts: NI,
"Specification for the LabVIEW Measurement File (.lvm)", 2022. Line by line the heading is a key and a cell for each
channel; it has two ends, the file's and the first segment's; then follow the names of the columns and the numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from daq.importing.clock import rate_of_interval
from rig.errors import RecordingError

# Maximum number of lines before the first line of numbers.
_MAX_HEADING_LINES = 200
# A unit in brackets after a name; the unit may contain parentheses.
_UNIT_IN_BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\[\]()]*(?:\([^\[\]()]*\)[^\[\]()]*)?)[\])]\s*")
# A unit after an underscore, as in our own tables.
_UNIT_AFTER_UNDERSCORE = re.compile(r"(.+)_(m/s\^2|m/s²|m/s|m|N|V|g|s|ms)")
# First cells of a line of units.
_TIME_UNITS = ("s", "ms", "us", "sec", "Seconds", "")
# Length of the longest unit, characters.
_MAX_UNIT_LENGTH = 12
#: Name of a column without a name.
UNNAMED = "column {}"
# Digits of a second's fraction in a time of day.
_FRACTION = re.compile(r":\d\d[.,](\d+)")
# A stamp is read to microseconds.
_STAMP_DIGITS = 6
# Beginning of LabVIEW's files.
LABVIEW_BEGIN = "LabVIEW Measurement"
# Line at the end of a heading.
_LABVIEW_END = "***End_of_Header***"
# Beginnings of the lines of a further segment.
LABVIEW_SEGMENT = ("Channels", "Notes", "X_Value", _LABVIEW_END)
_CLOCK = re.compile(r"(\d{4})/(\d\d)/(\d\d) (\d\d):(\d\d):(\d\d)(\.\d+)?")


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
    is_utf16 = begin.startswith((b"\xff\xfe", b"\xfe\xff"))
    if b"\0" in begin and not is_utf16:
        raise RecordingError(f"{path} is not text; expected a table of numbers")
    encoding = "utf-16" if is_utf16 else "utf-8-sig"
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
    raise RecordingError(f"{path}: no line of numbers among its first {len(lines)} lines; expected a table of numbers")


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
    date_and_time = cell if re.match(r"\d{4}-?\d\d", cell) else f"1970-01-01T{cell}"
    try:
        stamp = datetime.fromisoformat(date_and_time)
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


class LabviewChannel(NamedTuple):
    """A channel of the heading."""

    name: str
    unit: str
    cell: int  # its position in a line
    samples: int  # -1: not stated
    rate: float | None  # Hz
    rate_error: float  # Largest error of the rate by the digits of the sample interval, Hz
    start_s: float
    start_ns: int


class LabviewHeading(NamedTuple):
    """The heading of a file."""

    separator: str
    decimal_comma: bool
    lines: int
    times: bool  # Whether the first cell of every line is its time
    channels: list[LabviewChannel]


def labview_heading(lines: Sequence[str], where: str) -> LabviewHeading:
    """Read the heading of a LabVIEW measurement file; raise `RecordingError` if it is cut off or contradicts itself."""
    ends = [number for number, line in enumerate(lines) if line.startswith(_LABVIEW_END)]
    if len(ends) < 2 or len(lines) <= ends[1] + 1:
        raise RecordingError(
            f"{where}: its LabVIEW heading does not end; expected {_LABVIEW_END} twice, names, and numbers"
        )
    separator = "," if _keys(lines[: ends[0]], r"[\t,]").get("Separator", ["Tab"])[0] == "Comma" else "\t"
    file_keys, segment = _keys(lines[: ends[0]], separator), _keys(lines[ends[0] + 1 : ends[1]], separator)
    names = [cell.strip() for cell in lines[ends[1] + 1].rstrip("\r\n").split(separator)]
    columns = file_keys.get("X_Columns", ["One"])[0]
    # Old versions do not state the decimal separator.
    numbers = [*file_keys.get("Decimal_Separator", []), *segment.get("Delta_X", [])]
    comma = separator != "," and "," in "".join(numbers)
    step = 2 if columns == "Multi" else 1
    try:
        count = int(segment.get("Channels", ["0"])[0])
        if not 0 < step * count < len(names) + step - 1:
            raise ValueError(f"{count} channels under {len(names)} names")
        channels = [_channel(segment, names[1 + step * k], step * k, comma) for k in range(count)]
    except ValueError as error:
        raise RecordingError(f"{where}: its LabVIEW heading contradicts itself: {error}. Export it again.") from None
    return LabviewHeading(separator, comma, ends[1] + 2, columns == "One", channels)


def _keys(lines: Sequence[str], separator: str) -> dict[str, list[str]]:
    rows = [re.split(separator, line.strip("\r\n")) for line in lines]
    return {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows if len(row) > 1}


def _channel(segment: dict[str, list[str]], name: str, place: int, comma: bool) -> LabviewChannel:
    def stated(key: str, default: str) -> str:
        cells = segment.get(key, [])
        text = (cells[place] if place < len(cells) else "") or default
        return text.replace(",", ".") if comma else text

    interval = stated("Delta_X", "0")
    error = _rounding_error(interval)
    rate = rate_of_interval(float(interval), error) if float(interval) else None
    return LabviewChannel(
        name,
        stated("Y_Unit_Label", ""),
        place + 1,
        int(stated("Samples", "-1")),
        rate,
        rate**2 * error if rate else 0.0,
        float(stated("X0", "0")),
        _nanoseconds(f"{stated('Date', '')} {stated('Time', '').replace(',', '.')}"),
    )


def _rounding_error(number: str) -> float:
    """Largest rounding error of a number as it is written.

    >>> _rounding_error("0.000977"), _rounding_error("1.9531E-5")
    (5e-07, 5e-10)
    """
    mantissa, _, power = number.lower().partition("e")
    return float(f"0.5e{int(power or 0) - len(mantissa.partition('.')[2])}")


def _nanoseconds(stamp: str) -> int:
    """Time since 1970; local time without its zone is taken as UTC. 0 where there is none."""
    clock = _CLOCK.fullmatch(stamp)
    if clock is None:
        return 0
    try:
        instant = datetime(*map(int, clock.groups()[:6]), tzinfo=UTC)  # type: ignore[arg-type,misc]
    except ValueError:
        return 0
    return max(0, int(instant.timestamp()) * 10**9 + int(float(clock[7] or 0.0) * 1e9))
