"""Layout of a text table: encoding, delimiter, decimal mark, and the names and units in its heading."""

import csv
import math
import re
from collections.abc import Container, Sequence
from datetime import UTC, datetime
from itertools import accumulate, chain, takewhile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from daq.extras.importing.analyzer_heading import keyed_heading
from daq.extras.importing.clock import TIME_NAMES, looks_like_times, rate_of_interval, warn
from daq.extras.importing.units import GIVE_VALUE_OF_COUNT, KINDS, quantity_of
from rig.core.base.errors import RecordingError
from rig.core.base.escaping import unescape_cell
from rig.core.settings.quantities import is_unit

# Maximum number of lines before the first line of numbers; a text without numbers must not be searched completely.
_MAX_HEADING_LINES = 200
# A unit in brackets after a name; the unit may contain parentheses. A number before the unit is a range or a scale:
# ``X (100g)`` is the 100 g sensor of a logger.
_UNIT_IN_BRACKETS = re.compile(r"(.*?)\s*[\[(](?!\d)([^\[\]()]*(?:\([^\[\]()]*\)[^\[\]()]*)*)[\])]\s*")
# A unit after an underscore, as `analysis export` writes it.
_UNIT_AFTER_UNDERSCORE = re.compile(r"(.+)_(m/s\^?2|m/s²|m/s|m|N|V|g|s|ms|us|ns|k?Hz)")
# A unit after a slash between blanks (ISO 80000-1), or after "in": ``f / kHz``, ``force in N``.
_UNIT_AFTER_SLASH = re.compile(r"(?:(.+?) )?(?:/|in) (\S+(?: re .+)?)")
# A unit after a slash without blanks (DIN 1313), in the first column: ``Time/s``, ``f/Hz``. Other names contain
# slashes, too.
_ABSCISSA_WITH_SLASH = re.compile(r"(t|time|zeit|f|freq|frequency|frequenz)/([mnuµ]?s|k?Hz)", re.IGNORECASE)
# Units that are not products of powers of other units.
_ANGLE_OR_DECIBEL = re.compile(r"deg(rees?)?|°|rad(ians?)?|grad|dB\b.*", re.IGNORECASE)
# Name of a column of line numbers; the abscissa is the next column.
_LINE_NUMBER = re.compile(
    r"(#|no|nr|n|number|line|index|idx|sample|point|row)\.?( ?(#|no|nr|number)\.?)?", re.IGNORECASE
)
# A line that announces the line of units below.
_UNITS_FOLLOW = re.compile(r"\W*(units?|einheit(en)?)\W*", re.IGNORECASE)
#: Units of time: the first cell of a line of units is one of them, or empty.
TIME_UNITS = ("s", "ms", "us", "µs", "ns", "sec", "msec", "usec", "µsec", "second", "Second", "Seconds")
# Units of time or of frequency.
_ABSCISSA_UNITS = ("", *TIME_UNITS, "Hz", "kHz")
# Length of the longest unit [characters].
_MAX_UNIT_LENGTH = 16
#: Name of a column without a name.
UNNAMED = "column {}"
_NO_NAME = UNNAMED.format("")
# A complex number in one cell, as numpy and MATLAB write it: ``(1.2+3.4j)``, ``1.2 - 3.4 i``. numpy writes ``+-``
# before a negative imaginary part.
_NUMBER = r"\d[\d.,]*(?:e[-+]?\d+)?"
_COMPLEX_CELL = re.compile(rf"\(?\s*([-+]?{_NUMBER})\s*\+?([-+])\s*({_NUMBER})\s*\*?\s*[ij]\s*\)?", re.IGNORECASE)
# A pair of real and imaginary parts, as C++ and Fortran write it: ``(1.2,3.4)``.
_COMPLEX_PAIR = re.compile(r"\(([^(),]+),([^(),]+)\)")
# An exponent of Fortran's double precision.
_FORTRAN_EXPONENT = re.compile(r"(?<=[\d.])[dD](?=[-+]\d+$)")
# A number with dots between thousands and a decimal comma.
_GROUPED_NUMBER = re.compile(r"[-+]?\d{1,3}(?:\.\d{3})+,\d*")
# A number with marks or blanks between thousands, in a heading.
_GROUPED_RATE = re.compile(r"\d{1,3}(?:([., ])\d{3})(?:\1\d{3})*")
# Minimum number of lines of numbers that show that the first column contains line numbers.
_MIN_NUMBERED_LINES = 5
# Maximum number of lines of numbers that are examined for decimal commas.
_MAX_EXAMINED_ROWS = 50
# A part of a number that a decimal comma separates.
_INTEGER = re.compile(r"[-+]?\d+(?:e[-+]?\d+)?|", re.IGNORECASE)
# An empty cell, or a number with or without a unit, as a setting has it.
_SETTING = re.compile(r"[^\w.]*|\W*[\d.]+\s*[A-Za-z/%]*")
# A line of a heading with the value of one count: ``Scale factor;0.0005``.
_SCALE = re.compile(r"\W*(scal(e|ing)[ _-]?factor|multiplier|skalierungsfaktor)\W.*\d.*", re.IGNORECASE)
# A column of texts at the end of the lines.
_COMMENTS = re.compile(r"(comment|remark|note|event|bemerkung|kommentar)(s|en)?", re.IGNORECASE)
# The sample rate in a line of a heading: ``Sample rate: 51.2 kHz``, ``Sampling frequency [Hz]\t51200``. A number with
# an unknown unit is no rate.
_RATE_UNIT, _INTERVAL_UNIT = "[kM]?(?:Hz|Sa?/s|sps)", "[mnuµμ]?s|seconds?"
_STATED_RATE = re.compile(
    rf"\W*(?:fs|(?:sampl\w*|scan|abtast|mess)[ _-]?(?:rate|freq\w*))\W*({_RATE_UNIT})?\W*"
    rf"(\d(?:[\d.,]| (?=\d{{3}}\b))*(?:e[-+]?\d+)?)(?:\W*|\W*({_RATE_UNIT})\W*)",
    re.IGNORECASE,
)
# The sample interval in a line of a heading: ``Delta T (s): 0.001``. A "time period" is a duration.
_STATED_INTERVAL = re.compile(
    rf"\W*(?:delta[ _]?t|dt|sampl\w*[ _-]?(?:interval|period)|time[ _-]?interval)\W*({_INTERVAL_UNIT})?\W*"
    rf"(\d[\d.,]*(?:e[-+]?\d+)?)(?:\W*|\W*({_INTERVAL_UNIT})\W*)",
    re.IGNORECASE,
)
# A longer "time interval" is the duration of a measurement: vibration is sampled at more than 10 Hz [s].
_MAX_TIME_INTERVAL = 0.1
# Last cells of the heading of an oscilloscope, above the time of the first sample and the sample interval.
_START_AND_INTERVAL = ("Start", "Increment")
# A time of day with the date before it; the day is first unless the parts are separated by slashes.
_DATED_TIME = re.compile(r"(\d\d?)([./])(\d\d?)[./](\d{4})[ T](.+)")
# A time of day in the first or in the second half of the day.
_TWELVE_HOURS = re.compile(r"(.*?)\b(\d\d?)(:\d\d:\d\d\S*) ?([AP])M", re.IGNORECASE)
# A time in seconds, as MATLAB writes tables with times.
_DURATION = re.compile(r"(-?\d+\.?\d*(?:e[-+]?\d+)?) sec", re.IGNORECASE)
# Decimal digits of the seconds in a time of day.
_SECOND_FRACTION = re.compile(r"(?::\d\d[.,]|^-?\d+\.(?=\d+ sec))(\d+)")
# Units of the times that functions of microcontrollers return.
_UNITS_OF_NAMES = {"millis": "ms", "micros": "us"}
# A date or time of day is read to microseconds.
_MAX_FRACTION_DIGITS = 6


class Layout(NamedTuple):
    """The layout of a text table."""

    encoding: str
    delimiter: str | None  # None: any number of blanks
    decimal_comma: bool
    heading_lines: int  # number of lines before the first line of numbers
    names: list[str]
    units: list[str]
    cells: tuple[int, ...] | None = None  # positions of the cells of a line that are read; None: all
    stop: int | None = None  # number of lines in the file before the end of the table; None: all
    has_complex: bool = False  # whether cells contain complex numbers, which are read as two columns each
    rate: float | None = None  # sample rate that the heading states [Hz]


def read_beginning(path: Path) -> tuple[list[str], str]:
    """Return the first lines of a table (at least one), and its encoding."""
    with path.open("rb") as binary:
        head = binary.read(1 << 18)
    encoding = _utf16_encoding(head) or "utf-8-sig"
    if b"\0" in head and encoding == "utf-8-sig":
        raise RecordingError(f"{path}: this type of file cannot be read. Export the data as CSV, TDMS or UFF.")
    try:
        text = head.decode(encoding)
    except UnicodeDecodeError as error:
        # The last character may be truncated.
        encoding = encoding if error.start > len(head) - 4 else "cp1252"
        text = head.decode(encoding, errors="replace")
    return text.splitlines()[:_MAX_HEADING_LINES] or [""], encoding


def _utf16_encoding(head: bytes) -> str:
    """Return the encoding of a text of two bytes a character, with or without a byte order mark; empty for others.

    >>> _utf16_encoding("1,2".encode("utf-16-le")), _utf16_encoding(b"1,2"), _utf16_encoding(bytes(8))
    ('utf-16-le', '', '')
    """
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    # The upper byte of nearly all characters of a table is 0, and the lower byte of none.
    for low, encoding in ((head[::2], "utf-16-le"), (head[1::2], "utf-16-be")):
        if head and b"\0" not in low and 2 * head.count(b"\0") > len(low):
            return encoding
    return ""


def detect_layout(path: Path, lines: list[str], encoding: str) -> Layout:
    """Return the layout of a table from its first lines; raise `RecordingError` if no line has only numbers."""
    for number, line in enumerate(lines):
        for delimiter in ("\t", ";", ",", None):
            cells = _split_pairs(line, delimiter)
            if len(cells) < (1 if delimiter is None else 2):
                continue
            parts = [complex_parts(cell) for cell in cells]
            numbers = [*chain(*parts)]
            decimal_comma = any("," in part for part in numbers) or (
                _are_numbers(numbers, decimal_comma=False) and _has_decimal_comma(lines[number:], delimiter)
            )
            layout = Layout(encoding, delimiter, decimal_comma, number, [], [])
            if _are_numbers(numbers, decimal_comma):
                if number:
                    _require_heading(path, number, lines[number - 1 : number + 2], layout, len(cells))
                if any(map(_SCALE.fullmatch, lines[:number])) and all(map(_INTEGER.fullmatch, cells[1:])):
                    warn(
                        f"{path} contains integers. They are not multiplied by the scale factor of its heading. "
                        + GIVE_VALUE_OF_COUNT
                    )
                _require_other_delimiter(path, lines[max(number - 1, 0) : number + _MAX_EXAMINED_ROWS], layout)
                layout = _with_columns(path, layout, lines, cells)
                return _with_complex_columns(path, layout, parts) if len(numbers) > len(cells) else layout
            if delimiter is not None and (positions := _number_positions(lines[number:], layout)):
                plain_cells = [cell if k in positions else "" for k, cell in enumerate(cells)]
                return _without_texts(path, _with_columns(path, layout, lines, plain_cells), cells, positions)
    raise RecordingError(
        f"{path}: no line of numbers among the first {len(lines)} lines. Export the data as a table of numbers."
    )


def _has_decimal_comma(lines: Sequence[str], delimiter: str | None) -> bool:
    """Return whether the first number with a decimal mark, below a line of whole numbers, has a comma.

    >>> _has_decimal_comma(["1;0", "2;0,5", "3;0.5"], ";"), _has_decimal_comma(["1;0.5", "2;0,5"], ";")
    (True, False)
    """
    numbers = (
        part
        for line in lines[:_MAX_EXAMINED_ROWS]
        for cell in _split_pairs(line, delimiter)
        for part in complex_parts(cell)
        if ("," in part or "." in part) and parse_number(part, decimal_comma="," in part) is not None
    )
    return "," in next(numbers, "")


def _require_heading(path: Path, number: int, lines: Sequence[str], layout: Layout, count: int) -> None:
    """Raise `RecordingError` if the line above the first line of numbers is a row with a text.

    `lines` are this line and the next two. A row begins with a number that continues the times below, or with a number
    before other numbers.
    """
    cells, *below = (split_cells(line, layout.delimiter) for line in lines)
    texts = [cell for k, cell in enumerate(cells) if _number_or_time(cell, k, layout.decimal_comma) is None]
    if len(cells) != count or count < 2 or cells[0] in ("", *texts[:1]):
        return
    values = (_number_or_time(row[0], 0, layout.decimal_comma) for row in (cells, *below) if row)
    first, *times = (math.nan if value is None else value for value in values)
    is_row = sum(map(bool, cells)) > len(texts) + 1 or (
        len(times) == 2 and times[1] > times[0] and math.isclose(times[0] - first, times[1] - times[0], rel_tol=0.1)
    )
    if is_row and texts:
        raise RecordingError(
            f"{path}, line {number}: {texts[0]!r:.40} is not a number. Correct the cell, or remove the line."
        )


def _require_other_delimiter(path: Path, lines: Sequence[str], layout: Layout) -> None:
    """Raise `RecordingError` if commas separate the columns and are decimal marks, too; `lines[0]` may be names."""
    names, *rows = ([cell.strip() for cell in line.split(",")] for line in lines)
    if layout.delimiter != "," or not all(_INTEGER.fullmatch(cell) for row in rows for cell in row):
        return
    count = sum(map(bool, rows[0])) if rows else 0
    # A line such as ``Sample rate,51200 Hz`` contains no names.
    has_names = not any(_SETTING.fullmatch(cell) for cell in names[:2])
    # Decimals have leading zeros; if the numbers in the first column have zeros, too, all numbers have a fixed width.
    zeros = {k for row in rows for k, cell in enumerate(row) if re.match(r"0\d", cell)}
    has_zeros = bool(zeros) and 0 not in zeros
    # If there is one more cell than names, a decimal comma divides a number of a column that is no count, such as a
    # time.
    has_decimals = has_names and 1 < len(names) < count and (count == 2 * len(names) or "(" in names[0] + names[1])
    if has_decimals or (has_zeros and (len(names) != count or not has_names)):
        raise RecordingError(
            f"{path}: commas separate its columns, and seem to be decimal marks, too. Export it with semicolons."
        )


def _number_positions(lines: Sequence[str], layout: Layout) -> set[int]:
    """Return the positions of the numbers in lines that contain texts, too; empty for other lines.

    The numbers of all lines, those to the left of the first texts, or the last numbers next to each other have the same
    positions. Oscilloscopes write their settings to the left or right of the first samples.

    >>> layout = Layout("utf-8", ",", False, 0, [], [])
    >>> _number_positions(["0.0,1.5,started", "0.1,1.6,"], layout)
    {0, 1}
    >>> _number_positions(["0.0,1.5,,Serial,17", "0.1,1.6"], layout), _number_positions(["0.0,OL", "0.1,1.5"], layout)
    ({0, 1}, set())
    >>> sorted(_number_positions(["Length,300,,0.0,1.5", ",,,0.1,1.6"], layout))
    [3, 4]
    """
    candidates: list[set[int]] = []
    for line in filter(str.strip, lines):
        row = split_cells(line, layout.delimiter)
        numbers = {
            k for k, cell in enumerate(row) if cell and _number_or_time(cell, k, layout.decimal_comma) is not None
        }
        first_text = next((k for k, cell in enumerate(row) if cell and k not in numbers), len(row))
        last = max(numbers, default=0)
        adjacent = set(takewhile(numbers.__contains__, range(last, -1, -1)))
        left = {k for k in numbers if k < first_text}
        # A setting has a name and a value; a date may precede the time of day.
        starts = {0, *(k for k in adjacent if k > 1 or ":" in row[k])}
        found = [each for each in (numbers, left, adjacent) if len(each) > 1 and min(each) in starts]
        candidates = [each for each in candidates or found if each in found]
        if not candidates:
            break
    return candidates[0] if candidates and len(lines) > 1 else set()


def _number_or_time(cell: str, position: int, decimal_comma: bool) -> float | None:
    """Return a number, NaN for an empty cell, or a time of day [s] in one of the first two positions; else None."""
    number = parse_number(cell, decimal_comma)
    return stamp_seconds(cell) if number is None and position < 2 else number


def _without_texts(path: Path, layout: Layout, cells: Sequence[str], numbers: Container[int]) -> Layout:
    """Remove the columns of texts from a layout, with a warning, and empty columns without a name."""
    columns = list(zip(layout.names, layout.units, layout.cells or range(len(cells)), strict=True))
    kept = [(name, unit, k) for name, unit, k in columns if k in numbers or not (cells[k] or name.startswith(_NO_NAME))]
    texts = [name for name, _, k in columns if k not in numbers and cells[k]]
    warn(f"{path}: columns with texts are not imported: {', '.join(texts)}")
    names, units, positions = map(list, zip(*kept, strict=True))
    names = [UNNAMED.format(k) if name.startswith(_NO_NAME) else name for k, name in enumerate(names, 1)]
    return layout._replace(names=names, units=units, cells=tuple(positions))


def complex_parts(cell: str) -> list[str]:
    """Split a complex number into its real and imaginary parts; another cell is returned alone.

    >>> complex_parts("(1.2+3.4j)"), complex_parts("1.2E-1 -3 i"), complex_parts("1.2+-3j"), complex_parts("1.5")
    (['1.2', '3.4'], ['1.2E-1', '-3'], ['1.2', '-3'], ['1.5'])
    """
    match = _COMPLEX_CELL.fullmatch(cell)
    return [match[1], match[2].replace("+", "") + match[3]] if match else [cell]


def _split_pairs(line: str, delimiter: str | None) -> list[str]:
    """Split a line that may contain complex numbers as pairs ``(1.2,3.4)``; the pairs become ``1.2+3.4j``."""
    return split_cells(_COMPLEX_PAIR.sub(r"\1+\2j", line) if "(" in line else line, delimiter)


def expand_complex(line: str, delimiter: str | None) -> str:
    """Return a line with two cells for each complex number."""
    parts = chain(*map(complex_parts, _split_pairs(line, delimiter)))
    return (delimiter or " ").join(parts) + line[len(line.rstrip("\r\n")) :]


def _with_complex_columns(path: Path, layout: Layout, parts: Sequence[Sequence[str]]) -> Layout:
    """Replace each column of complex numbers by two: the real and imaginary parts."""
    included = layout.cells or tuple(range(len(parts)))
    if len(parts[included[0]]) > 1:
        raise RecordingError(
            f"{path} contains complex numbers without frequencies. Add their frequencies as the first column, and read "
            "the file with `analysis frf`."
        )
    starts = [0, *accumulate(map(len, parts))]
    names, units, cells = list[str](), list[str](), list[int]()
    for number, (name, unit, position) in enumerate(zip(layout.names, layout.units, included, strict=True), 1):
        is_complex = len(parts[position]) > 1
        if name == UNNAMED.format(number):
            names += [UNNAMED.format(len(names) + k) for k in range(1, 2 + is_complex)]
        else:
            names += [f"{name} real", f"{name} imag"] if is_complex else [name]
        units += [unit] * (1 + is_complex)
        cells += range(starts[position], starts[position + 1])
    return layout._replace(names=names, units=units, cells=tuple(cells) if layout.cells else None, has_complex=True)


def _are_numbers(cells: Sequence[str], decimal_comma: bool) -> bool:
    """Return whether cells are numbers or empty; one of the first two of several cells may be a time of day."""
    last = len(cells) - 1
    values = [_number_or_time(cell, k if k < last else 2, decimal_comma) for k, cell in enumerate(cells)]
    # Empty cells are NaN; a line of empty cells alone has no numbers.
    return None not in values and any(value == value for value in values)


def _with_columns(path: Path, layout: Layout, first_lines: Sequence[str], cells: Sequence[str]) -> Layout:
    """Add names, units and positions of the columns to a layout, from the heading and the first lines of numbers."""
    heading = [line for line in first_lines[: layout.heading_lines] if not _UNITS_FOLLOW.fullmatch(line)]
    lines = [line.lstrip("#%").strip() if line[:1] in "#%" else line for line in heading if line.strip()]
    rows_above = [split_cells(line, layout.delimiter) for line in lines]
    if layout.delimiter is None and lines and len(rows_above[-1]) > len(cells):
        # A single blank separates a name from its unit.
        rows_above[-1] = re.split(r"\s{2,}", lines[-1].strip())
    rows_above, interval = _without_interval(rows_above)
    stop = len(cells)
    if stop > 2 and not cells[-1] and rows_above and not "".join(rows_above[-1][stop - 1 :]):
        # Each line ends with a delimiter.
        stop -= 1
        rows_above = [row[:stop] for row in rows_above]
    names, units = _names_and_units(rows_above, stop)
    keyed_lines = [" ".join(dict.fromkeys(cell for cell in row if cell)) for row in rows_above]
    rate = rate_of_interval(interval) if interval else _stated_rate([*heading, *keyed_lines], layout.decimal_comma)
    layout = layout._replace(rate=rate)
    first_cell = int(not interval and _has_line_numbers(layout, first_lines, names, units))
    is_confirmed = first_cell and (_is_abscissa(names[1], units[1]) or (layout.rate and names[0] != UNNAMED.format(1)))
    names, units = names[first_cell:], units[first_cell:]
    if not any(units[1:]) and (keyed := keyed_heading(rows_above, len(names))) is not None:
        if any(units):
            # A line of names states the unit of the abscissa only.
            units = [units[0], *keyed[1][1:]]
        else:
            names, units = [name or other for name, other in zip(keyed[0], names, strict=True)], keyed[1]
    elif first_cell and not is_confirmed:
        names = [UNNAMED.format(k) if name.startswith(_NO_NAME) else name for k, name in enumerate(names, 1)]
        warn(
            f"{path}: its first column contains line numbers, and is omitted. If it is a signal, give it a name "
            "that is not one of line numbers."
        )
    # The column of times is empty if the heading states the sample interval.
    is_empty = len(names) > 2 and not cells[first_cell] and _is_abscissa(names[0], units[0])
    if len(names) > 1 and (interval or is_empty):
        first_cell, names, units = first_cell + 1, names[1:], units[1:]
    if len(names) > 2 and _COMMENTS.fullmatch(names[-1]):
        stop, names, units = stop - 1, names[:-1], units[:-1]
    positions = None if (first_cell, stop) == (0, len(cells)) else tuple(range(first_cell, stop))
    return layout._replace(names=names, units=units, cells=positions)


def _has_line_numbers(layout: Layout, first_lines: Sequence[str], names: Sequence[str], units: Sequence[str]) -> bool:
    """Return whether the first column contains line numbers, by its name and values, or by the abscissa next to it."""
    is_named = _LINE_NUMBER.fullmatch(names[0]) is not None
    if not (is_named or names[0] == UNNAMED.format(1)) or _is_abscissa(names[0], units[0]):
        return False
    if len(names) > 2 and _is_abscissa(names[1], units[1]):
        return True
    # A force in N has such a name, too. The last line may be truncated.
    lines_of_numbers = filter(str.strip, first_lines[layout.heading_lines : -1])
    rows = [[*split_cells(line, layout.delimiter), ""] for line in lines_of_numbers] or [["", ""]]
    first, second = (np.array([parse_number(row[k], layout.decimal_comma) or 0.0 for row in rows]) for k in (0, 1))
    if len(names) < 2 or (np.diff(first) != 1.0).any():
        return False
    is_even = looks_like_times(second, second[-1], second.size) or (np.diff(second) == 1.0).all()
    # PULSE numbers the lines below such a heading.
    is_numbered = first_lines[0].startswith("Header Size") and (np.diff(second) > 0.0).all()
    # Two signals next to a column of integers may be even, too; the times of vibration have shorter steps.
    is_even &= is_named or len(names) > 3 or np.diff(second[:2]).max(initial=0.0) < _MAX_TIME_INTERVAL
    is_even &= len(rows) >= _MIN_NUMBERED_LINES
    return (layout.rate is not None and is_named) or (len(names) > 2 and bool(is_even or is_numbered))


def _without_interval(rows_above: list[list[str]]) -> tuple[list[list[str]], float | None]:
    """Remove the cells of an oscilloscope's start and sample interval [s] from a heading; return the interval.

    >>> _without_interval([["X", "CH1", "Start", "Increment"], ["Sequence", "Volt", "-0.1", "1e-3"]])
    ([['X', 'CH1'], ['', 'Volt']], 0.001)
    """
    names, units = ([], [], *rows_above)[-2:]
    count = len(names) - names[::-1].index(_START_AND_INTERVAL[1]) - 1 if _START_AND_INTERVAL[1] in names else 0
    interval = parse_number(units[count], decimal_comma=False) if 0 < count < len(units) else None
    if not interval or names[count - 1] != _START_AND_INTERVAL[0]:
        return rows_above, None
    return [*rows_above[:-2], names[: count - 1], ["", *units[1 : count - 1]]], interval


def _stated_rate(heading: Sequence[str], decimal_comma: bool) -> float | None:
    r"""Return the sample rate that a line of a heading states [Hz].

    >>> _stated_rate(["Sample rate: 51,2 kHz"], True), _stated_rate(["Sampling frequency [Hz]\t51200"], False)
    (51200.0, 51200.0)
    >>> _stated_rate(["Delta T (ms):;0.5"], False)
    2000.0
    >>> _stated_rate(["Sample interval: 20 us"], False), _stated_rate(["Sample rate: 1 MS/s"], False)
    (50000.0, 1000000.0)
    >>> _stated_rate(["Sample rate: 10,000 Hz"], False), _stated_rate(["Abtastrate: 10.000 Hz"], True)
    (10000.0, 10000.0)
    >>> _stated_rate(["Abtastrate: 51.200 kHz"], True)
    51200.0
    >>> _stated_rate(["Time period: 60 s", "Time interval: 0.3 s", "Time interval: 2 ms"], False)
    500.0
    """
    for pattern in (_STATED_RATE, _STATED_INTERVAL):
        for match in filter(None, map(pattern.fullmatch, heading)):
            grouped = _GROUPED_RATE.fullmatch(match[2])
            unit = match[1] or match[3] or ""
            prefix = "M" if unit[:1] == "M" and pattern is _STATED_RATE else unit[:1].lower()
            # The decimal mark of the table does not separate thousands, and kilohertz have no thousands.
            if grouped and (grouped[1] == (",." if decimal_comma else ".,")[0] or prefix in ("k", "M")):
                grouped = None
            text = match[2] if grouped is None else match[2].replace(grouped[1], "")
            if number := parse_number(text, decimal_comma):
                number *= {"M": 1e6, "k": 1e3, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}.get(prefix, 1.0)
                if pattern is _STATED_RATE:
                    return number
                if "time" not in match[0].lower() or number < _MAX_TIME_INTERVAL:
                    return rate_of_interval(number)
    return None


def _names_and_units(rows_above: list[list[str]], column_count: int) -> tuple[list[str], list[str]]:
    """Return names and units of the columns, from the lowest line above the numbers that states units.

    Programs write comments, such as types of sensors, between the units and the numbers.
    """
    adjacent = takewhile(lambda row: len(row) == column_count, reversed(rows_above))
    rows = [_spaced_slashes([unescape_cell(cell.strip(" ,;")) for cell in row]) for row in adjacent]
    # Texts in the first cell alone are no names, and the lines above them may be other settings: ``Data:``.
    is_named = [column_count == 1 or any(row[1:]) or _is_abscissa(*name_and_unit(row[0])) for row in rows]
    names = rows[0] if rows and is_named[0] else [""] * column_count
    units = [""] * column_count
    for number, row in enumerate(rows):
        row_names, row_units = map(list, zip(*map(name_and_unit, row), strict=True))
        above = rows[number + 1] if number + 1 < len(rows) else None
        if above is not None and _are_units(row, above):
            row_names, row_units = above, [without_brackets(cell) for cell in row]
        # Comments above the names may contain brackets, too.
        if any(row_units) and ((number == 0 and is_named[0]) or _is_abscissa(row_names[0], row_units[0])):
            names, units = row_names, row_units
            break
    return [name or UNNAMED.format(k) for k, name in enumerate(names, 1)], units


def _spaced_slashes(row: list[str]) -> list[str]:
    """Insert blanks around the slashes before the units of a line that writes them without.

    >>> _spaced_slashes(["Time/s", "Tip/(m/s^2)"]), _spaced_slashes(["Time", "AI 1/Tip"])
    (['Time / s', 'Tip / m/s^2'], ['Time', 'AI 1/Tip'])
    """
    if not _ABSCISSA_WITH_SLASH.fullmatch(row[0]):
        return row
    pairs = (cell.partition("/") for cell in row)
    return [f"{name} / {without_brackets(unit)}" if unit else name for name, _, unit in pairs]


def _are_units(row: Sequence[str], above: Sequence[str]) -> bool:
    """Return whether a line of a heading contains the units of the names in the line above."""
    units = [without_brackets(cell) for cell in row]
    has_units, above_has_units = (any(map(is_unit, filter(None, cells[1:]))) for cells in (units, above))
    is_time = units[0] in _ABSCISSA_UNITS or (
        has_units and any(names.fullmatch(above[0]) for names in (TIME_NAMES, _LINE_NUMBER))
    )
    # A table without times has a unit of a channel in each cell; names may be symbols of other units: ``A``, ``T``.
    is_time |= all(quantity_of(unit, KINDS) for unit in units) and all(above) and not any(map(is_unit, above))
    if not is_time or max(map(len, units)) > _MAX_UNIT_LENGTH or (above_has_units and not has_units):
        return False
    in_brackets = all(unit != cell for unit, cell in zip(units, row, strict=True))
    return in_brackets or not any(map(_UNIT_IN_BRACKETS.fullmatch, above))


def name_and_unit(cell: str) -> tuple[str, str]:
    """Split a name with a unit; the unit is empty if the name states none.

    >>> name_and_unit("tip (m/s²)"), name_and_unit("force / N"), name_and_unit("left / right")
    (('tip', 'm/s²'), ('force', 'N'), ('left / right', ''))
    """
    for pattern in (_UNIT_IN_BRACKETS, _UNIT_AFTER_UNDERSCORE, _UNIT_AFTER_SLASH):
        if match := pattern.fullmatch(cell):
            unit = match[2].strip()
            is_known = pattern is not _UNIT_AFTER_SLASH or _ANGLE_OR_DECIBEL.fullmatch(unit) or is_unit(unit)
            return ((match[1] or "").rstrip("/ "), unit) if is_known else (cell, "")
    return cell, _UNITS_OF_NAMES.get(cell.lower(), "")


def _is_abscissa(name: str, unit: str) -> bool:
    return TIME_NAMES.fullmatch(name) is not None or unit in _ABSCISSA_UNITS[1:]


def without_brackets(cell: str) -> str:
    """Return a unit without brackets around all of it.

    >>> without_brackets("[ m/s / N ]"), without_brackets("(m/s²)/N")
    ('m/s / N', '(m/s²)/N')
    """
    match = re.fullmatch(r"\[([^\[\]]*)\]|\(((?:[^()]|\([^()]*\))*)\)", cell)
    return cell if match is None else (match[1] or match[2] or "").strip()


def split_cells(line: str, delimiter: str | None) -> list[str]:
    """Split a line into cells."""
    if delimiter is None:
        return line.split()
    try:
        (row,) = list(csv.reader([line.rstrip("\r\n")], delimiter=delimiter, skipinitialspace=True)) or [[]]
    except csv.Error:
        # The csv module rejects cells of more than a hundred thousand characters.
        return [line]
    return [cell.strip() for cell in row]


def parse_number(cell: str, decimal_comma: bool) -> float | None:
    """Read a cell: a number, NaN if it is empty, None if it is something else.

    >>> parse_number("-1.234,5", decimal_comma=True), parse_number("1.5,2", decimal_comma=True)
    (-1234.5, None)
    >>> parse_number("0.125D-02", decimal_comma=False)
    0.00125
    """
    if not cell:
        return float("nan")
    if decimal_comma and _GROUPED_NUMBER.fullmatch(cell):
        cell = cell.replace(".", "")
    cell = _FORTRAN_EXPONENT.sub("E", cell)
    try:
        # Oscilloscopes write ∞ for values beyond their range.
        return float((cell.replace(",", ".") if decimal_comma else cell).replace("∞", "inf"))
    except ValueError:
        return None


def stamp_seconds(cell: str) -> float | None:
    """Return a time of day, with or without a date, in s since 1970; None if the cell is something else.

    A time without a zone is taken as UTC, because only differences of times are used.

    >>> stamp_seconds("1970-01-02 00:00:00.25"), stamp_seconds("1970-01-01T00:00:01Z"), stamp_seconds("1.5")
    (86400.25, 1.0, None)
    >>> stamp_seconds("1970/01/02 00:00:01")
    86401.0
    >>> stamp_seconds("00:01:00.5"), stamp_seconds("02.01.1970 0:00:01,5"), stamp_seconds("1/2/1970 12:00:01 AM")
    (60.5, 86401.5, 86401.0)
    >>> stamp_seconds("0.25 sec")
    0.25
    """
    if duration := _DURATION.fullmatch(cell):
        return float(duration[1])
    if ":" not in cell:
        return None
    if dated := _DATED_TIME.fullmatch(cell):
        day, month = (dated[3], dated[1]) if dated[2] == "/" and int(dated[1]) <= 12 else (dated[1], dated[3])
        cell = f"{dated[4]}-{month:0>2}-{day:0>2} {dated[5]}"
    if twelve := _TWELVE_HOURS.fullmatch(cell):
        cell = f"{twelve[1]}{int(twelve[2]) % 12 + 12 * (twelve[4] in 'Pp'):02}{twelve[3]}"
    cell = re.sub(r"^(\d{4})/(\d\d)/(?=\d\d )", r"\1-\2-", cell)
    date_and_time = cell if re.match(r"\d{4}-?\d\d", cell) else f"1970-01-01T{cell}"
    try:
        stamp = datetime.fromisoformat(re.sub(r"(?<=[ T])(?=\d:)", "0", date_and_time))
    except ValueError:
        return None
    return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()


def stamp_resolution(cell: str) -> float:
    """Return the size of the last digit of a time of day [s].

    >>> stamp_resolution("2024-05-01 10:00:00"), stamp_resolution("2024-05-01 10:00:00.0625")
    (1.0, 0.0001)
    """
    fraction = _SECOND_FRACTION.search(cell)
    return float(f"1e-{min(len(fraction[1]), _MAX_FRACTION_DIGITS)}") if fraction else 1.0


def significant_digits(cell: str) -> int:
    """Count the significant digits of a number as it is written.

    >>> significant_digits("0.0125"), significant_digits("1.250E-2"), significant_digits("-12")
    (3, 4, 2)
    """
    mantissa = re.split("[eEdD]", cell)[0]
    return len(re.sub(r"\D", "", mantissa).lstrip("0"))
