"""Signals of a text table: columns between commas, semicolons, tabs or blanks, under a heading or none."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from daq.importing import labview_text
from daq.importing.labview_text import LabviewHeading
from daq.importing.signal import (
    TIME_NAMES,
    Array,
    Signal,
    even,
    looks_like_times,
    note,
    tell_times,
)
from daq.importing.time_gaps import Missing, missing_rows, numbers_of_rows, rate_with_gaps, with_missing
from daq.importing.time_stamps import resolution_of_stamp, seconds_of_stamp
from rig.errors import RecordingError
from rig.numerics.memory import need_beside_program
from rig.scene.quantities import TIME, parse

# Lines in which the first line of numbers has to come.
_LONGEST_HEADING = 200
_LONGEST_LINE = 1 << 20
_UNIT_BEHIND = re.compile(r"(.*?)\s*[\[(]([^\[\]()]*(?:\([^\[\]()]*\)[^\[\]()]*)?)[\])]\s*")
# A unit behind an underscore, as our own tables have it.
_SUFFIX = re.compile(r"(.+)_(m/s\^2|m/s²|m/s|m|N|V|g|s|ms)")
# A rate that is uncertain by more than this share is reported.
_ROUGH = 2e-5
# What a column is called that has no name.
UNNAMED = "column {}"
# Lines from which the digits of times are determined.
_SAMPLED = 50
# Fewer lines do not show how many digits their numbers have.
_FEW = 10
# Lines that are read at a time, and memory that a byte of them takes, bytes, measured: text and numbers.
PIECE, _READ_BYTES = 1 << 16, 4


class Layout(NamedTuple):
    """How a table is written."""

    encoding: str
    delimiter: str | None
    """None: blanks, any number of them."""
    decimal_comma: bool
    heading: int
    """Lines in front of the first line of numbers."""
    names: list[str]
    units: list[str]
    cells: tuple[int, ...] | None = None
    """Which cells of a line are read, where there are others beside them; None: all, and there are no others."""


def text_signals(path: Path, stack: ExitStack) -> list[Signal]:
    """List the columns of a text table; it is read line by line, once for each time its samples are wanted.

    A first column of times gives the clock. Names and units are those of the heading: ``acc1 [m/s^2]``,
    ``acc1 (g)``, or a line of names above a line of units.
    """
    lines, encoding = _beginning(path)
    if lines[0].startswith(labview_text.BEGIN):
        return _labview_signals(path, labview_text.labview_heading(lines, str(path)), encoding, stack)
    layout = _layout(path, lines, encoding)
    table = _Table(path, layout, stack)
    columns = list(zip(layout.names, layout.units, strict=True))
    rate, start = None, 0.0
    first = 0
    named = TIME_NAMES.fullmatch(columns[0][0]) is not None
    if len(columns) > 1 and (named or table.has_stamps() or table.begins_with_times()):
        first = 1
        rate, start = table.take_clock(columns[0][1])
    if not table.rows:
        raise RecordingError(f"{path} holds no line of numbers")
    return [
        with_missing(
            Signal(path.name, number, name, unit, table.rows, rate, table.column(first + number - 1), start),
            table.missing,
        )
        for number, (name, unit) in enumerate(columns[first:], 1)
    ]


def _labview_signals(path: Path, heading: LabviewHeading, encoding: str, stack: ExitStack) -> list[Signal]:
    """Do the same with the names, units and clocks of LabVIEW's heading; a column of times goes before its clock."""
    channels = heading.channels
    layout = Layout(
        encoding,
        heading.separator,
        heading.decimal_comma,
        heading.lines,
        [*(["time"] if heading.times else []), *(channel.name for channel in channels)],
        [""] * (len(channels) + heading.times),
        (*([0] if heading.times else []), *(channel.cell for channel in channels)),
    )
    table = _Table(path, layout, stack)
    clock = table.take_clock("s") if heading.times else None
    longest = max(channel.samples for channel in channels)
    if longest > table.rows:
        note(f"{path}: its heading states {longest} samples, its table has {table.rows}; these are taken")
    if 0 < longest < table.rows and not heading.times:
        note(
            f"{path}: its heading states segments of {longest} samples, its table has {table.rows} lines: they are "
            "taken one after the other as if nothing lay between them; import one by one with --from and --to"
        )
    rough = [one for one in channels if one.rate and one.rate_error > _ROUGH * one.rate and not heading.times]
    if rough:
        rate, error = rough[0].rate or 0.0, rough[0].rate_error
        note(
            f"{path}: its sample interval has so few digits that the rate may be {rate - error:.6g} to "
            f"{rate + error:.6g} Hz; {rate:.6g} Hz is taken: say rate: in the table if it was another"
        )
    return [
        with_missing(
            Signal(
                path.name,
                number,
                channel.name,
                channel.unit,
                # Lines are added to a file without a word in its heading; only a shorter channel follows from it.
                table.rows if channel.samples in (-1, longest) else min(channel.samples, table.rows),
                clock[0] if clock else channel.rate,
                table.column(number - 1 + heading.times),
                clock[1] if clock else channel.start_s,
                channel.start_ns,
            ),
            table.missing,
        )
        for number, channel in enumerate(channels, 1)
    ]


class _Table:
    """A table that is read from its beginning to its end, in pieces that all columns share."""

    def __init__(self, path: Path, layout: Layout, stack: ExitStack) -> None:
        self._path, self._layout = path, layout
        self._file: IO[str] = stack.enter_context(
            path.open(encoding=layout.encoding, errors="replace", newline="")
        )
        self._clock: tuple[float, float, float, float] | None = None
        self._ends: list[str] = []
        self.rows = 0
        self.missing: list[Missing] = []
        before, last = "", (0, "")
        for each in self._lines():
            if self.rows < _SAMPLED:
                self._ends.append(each[1])
            before, last = last[1], each
            self.rows += 1
        if self.rows > 1 and (why := self._torn(*last)):
            note(f"{path}: its last line is cut off and is left out ({why})")
            self.rows -= 1
            self._ends = self._ends[: self.rows]
            last = (0, before)
        if self.rows:
            self._ends.append(last[1])
            piece = min(1.0, PIECE / self.rows) * path.stat().st_size
            need_beside_program(_READ_BYTES * piece, f"{path}: importing it")
        self._reading = self._lines()
        self._position = 0
        self._held: tuple[int, int, Array] = (-1, -1, np.empty((0, 0)))

    def _torn(self, number: int, line: str) -> str:
        """Say why the last line cannot be whole; empty if it can: who writes may be cut off anywhere."""
        try:
            self._row(number, line)
        except RecordingError as error:
            return str(error)
        cells = [_cells(each, self._layout.delimiter)[-1] for each in (*self._ends[:-1], line)]
        lengths = [len(cell.lstrip("+-")) for cell in cells]
        if not line.endswith(("\n", "\r")) and len(lengths) > _FEW and lengths[-1] < min(lengths[:-1]):
            return f"line {number}: {cells[-1]!r:.40} is shorter than in other lines, and the line has no end"
        return ""

    def has_stamps(self) -> bool:
        """Whether the first column holds dates with times of day."""
        return bool(self._ends) and seconds_of_stamp(self._first_cell(self._ends[0])) is not None

    def begins_with_times(self) -> bool:
        """Whether the first column of a table without heading can only be times; this is reported."""
        if self._layout.names[0] != UNNAMED.format(1) or self.rows < 2:
            return False
        begin = np.array([self._row(0, line)[0] for line in self._ends[:-1]])
        if not looks_like_times(begin, self._row(0, self._ends[-1])[0], self.rows):
            return False
        tell_times(f"{self._path} has no heading; its first column", begin[1] - begin[0])
        return True

    def take_clock(self, unit: str) -> tuple[float, float]:
        """Take the first column for times in a unit; give the rate in Hz and the first time in s."""
        where = f"{self._path}: the times in its first column"
        stamps = self.has_stamps()
        try:
            scale = parse(f"1 {unit}", TIME) if unit and not stamps else 1.0
        except ValueError as error:
            raise RecordingError(f"{where}: {error}; expected a unit of time such as s or ms") from None
        if self.rows < 2:
            raise RecordingError(f"{where}: {self.rows} line of numbers; expected at least 2")
        rows = [self._row(0, line) for line in (self._ends[0], self._ends[-1])]
        begin, end = (float(row[0]) * scale for row in rows)
        cells = [self._first_cell(line) for line in self._ends]
        if stamps:
            resolution = min(map(resolution_of_stamp, cells))
        else:
            largest = max(abs(begin), abs(end), 1e-300)
            resolution = 10.0 ** (np.floor(np.log10(largest)) + 1 - max(map(_digits, cells)))
        self.missing = missing_rows(self._times(scale), resolution)
        rate = rate_with_gaps(begin, end, self.rows, self.missing, resolution, where)
        self._clock = begin, rate, resolution, scale
        return rate, begin

    def _first_cell(self, line: str) -> str:
        return _cells(line, self._layout.delimiter)[0]

    def _times(self, scale: float) -> Iterator[Array]:
        """Yield the first column in pieces, s."""
        lines = islice(self._lines(), self.rows)
        while piece := list(islice(lines, PIECE)):
            yield np.array([self._time(number, line) for number, line in piece]) * scale

    def _time(self, number: int, line: str) -> float:
        cell = (
            self._first_cell(line)
            if self._layout.delimiter is None
            else line.split(self._layout.delimiter, 1)[0]
        )
        value = _value(cell.strip(' "\r\n'), self._layout.decimal_comma)
        return self._row(number, line)[0] if value is None else value

    def column(self, index: int) -> Callable[[int, int], Array]:
        """Give the reader of a column."""
        return lambda start, stop: self.read(start, stop)[:, index]

    def read(self, start: int, stop: int) -> Array:
        """Read lines of numbers from one to another, shape (lines, columns)."""
        if self._held[:2] == (start, stop):
            return self._held[2]
        if start < self._position:
            self._reading, self._position = self._lines(), 0
        for _ in islice(self._reading, start - self._position):
            pass
        lines = list(islice(self._reading, stop - start))
        self._position = start + len(lines)
        values = self._parsed(lines)
        if self._clock is not None:
            begin, rate, resolution, scale = self._clock
            even(
                values[:, 0] * scale,
                numbers_of_rows(np.arange(start, start + len(values)), self.missing),
                begin,
                rate,
                resolution,
                f"{self._path}: the times in its first column",
            )
        self._held = start, stop, values
        return values

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Yield the lines of numbers with their numbers in the file, from 1."""
        self._file.seek(0)
        number = 0
        while line := self._file.readline(_LONGEST_LINE):
            number += 1
            if number <= self._layout.heading or not line.strip():
                continue
            if self._layout.cells is not None and line.startswith(labview_text.SEGMENT):
                raise RecordingError(
                    f"{self._path}, line {number}: another segment of measurement begins; expected one: split the "
                    "file, or log to TDMS"
                )
            yield number, line

    def _parsed(self, lines: list[tuple[int, str]]) -> Array:
        texts = [line.replace(",", ".") if self._layout.decimal_comma else line for _, line in lines]
        width = len(self._layout.names)
        try:
            values = np.loadtxt(
                texts, delimiter=self._layout.delimiter, comments=None, ndmin=2, usecols=self._layout.cells
            )
            if values.shape == (len(lines), width):
                return values
        except ValueError:
            pass
        return np.array([self._row(number, line) for number, line in lines]).reshape(-1, width)

    def _row(self, number: int, line: str) -> list[float]:
        """Read a line, a cell without anything in it as NaN; the message of a bad one says where."""
        cells = _cells(line, self._layout.delimiter)
        width = len(self._layout.names)
        where = f"{self._path}, line {number}" if number else f"{self._path}, its first or last line"
        if self._layout.cells is not None and len(cells) > self._layout.cells[-1]:
            cells = [cells[place] for place in self._layout.cells]
        if len(cells) != width:
            raise RecordingError(
                f"{where}: {len(cells)} columns; expected {width}, as in the first line of numbers"
            )
        row = []
        for column, cell in enumerate(cells, 1):
            value = _value(cell, self._layout.decimal_comma)
            if value is None and column == 1:
                value = seconds_of_stamp(cell)
            if value is None:
                raise RecordingError(f"{where}, column {column}: {cell!r:.40} is no number")
            row.append(value)
        return row


def _beginning(path: Path) -> tuple[list[str], str]:
    """Give the first lines of a table, at least one, and its encoding."""
    with path.open("rb") as binary:
        begin = binary.read(1 << 18)
    if b"\0" in begin and not begin.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise RecordingError(f"{path} is no text; expected a table of numbers")
    encoding = "utf-16" if begin.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    try:
        text = begin.decode(encoding)
    except UnicodeDecodeError as error:
        # The end may be within a character.
        encoding = encoding if error.start > len(begin) - 4 else "cp1252"
        text = begin.decode(encoding, errors="replace")
    return text.splitlines()[:_LONGEST_HEADING] or [""], encoding


def _layout(path: Path, lines: list[str], encoding: str) -> Layout:
    """Find out how a table is written from its beginning."""
    for heading, line in enumerate(lines):
        for delimiter in ("\t", ";", ",", None):
            cells = _cells(line, delimiter)
            comma = delimiter != "," and "," in line
            values = [_value(cell, comma) for cell in cells]
            if len(values) > 1 and values[0] is None:
                values[0] = seconds_of_stamp(cells[0])
            # A comma between blanks may part columns or decimals; where it parts columns, all cells are numbers, too.
            if len(cells) >= (1 if delimiter is None else 2) and _are_numbers(values):
                above = _above(lines[:heading], delimiter)
                width = len(cells)
                if width > 2 and not cells[-1] and above and len(above[-1]) == width - 1:
                    # A delimiter behind each line's last number parts it from nothing.
                    names, units = _heading(above, width - 1)
                    return Layout(encoding, delimiter, comma, heading, names, units, tuple(range(width - 1)))
                return Layout(encoding, delimiter, comma, heading, *_heading(above, width))
    raise RecordingError(
        f"{path}: no line of numbers among its first {len(lines)} lines; expected a table of numbers"
    )


def _are_numbers(values: list[float | None]) -> bool:
    return None not in values and any(value == value for value in values)


def _above(lines: list[str], delimiter: str | None) -> list[list[str]]:
    """Give the cells of the lines above the numbers."""
    return [
        _cells(line.lstrip("#%").strip() if line[:1] in "#%" else line, delimiter)
        for line in lines
        if line.strip()
    ]


def _heading(above: list[list[str]], width: int) -> tuple[list[str], list[str]]:
    """Take names and units from the lines above the numbers."""
    rows = [[cell.strip(" ,;") for cell in row] for row in above[-2:] if len(row) == width]
    if not rows or len(above[-1]) != width:
        return [UNNAMED.format(number) for number in range(1, width + 1)], [""] * width
    if (
        len(rows) == 2
        and all(_UNIT_BEHIND.fullmatch(cell) is None for cell in rows[0])
        and _are_units(rows[1])
    ):
        return [cell or UNNAMED.format(k) for k, cell in enumerate(rows[0], 1)], [
            cell.strip("[]()") for cell in rows[1]
        ]
    names, units = [], []
    for number, cell in enumerate(rows[-1], 1):
        found = _UNIT_BEHIND.fullmatch(cell) or _SUFFIX.fullmatch(cell)
        names.append((found[1] if found else cell) or UNNAMED.format(number))
        units.append(found[2].strip() if found else "")
    return names, units


def _are_units(cells: list[str]) -> bool:
    """Whether a line can be one of units: nothing in it is longer than a unit, and it says seconds or several."""
    return all(len(cell) <= 12 for cell in cells) and cells[0].strip("[]()") in (
        "s",
        "ms",
        "us",
        "sec",
        "Seconds",
        "",
    )


def _cells(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    try:
        (row,) = list(csv.reader([line.rstrip("\r\n")], delimiter=delimiter)) or [[]]
    except csv.Error:
        # A cell of more than a hundred thousand letters is no part of a table.
        return [line]
    return [cell.strip() for cell in row]


def _value(cell: str, decimal_comma: bool) -> float | None:
    """Read a cell: a number, NaN for nothing; None if it is neither."""
    if not cell:
        return float("nan")
    try:
        return float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return None


def _digits(cell: str) -> int:
    """Count the digits that a number is written with, without zeros in front.

    >>> _digits("0.0125"), _digits("1.250E-2"), _digits("-12")
    (3, 4, 2)
    """
    mantissa = re.split("[eE]", cell)[0]
    return len(re.sub(r"\D", "", mantissa).lstrip("0"))
