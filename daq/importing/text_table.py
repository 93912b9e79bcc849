"""Signals of a text table: columns between commas, semicolons, tabs or blanks, under a heading or none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np

from daq.importing.clock import (
    TIME_NAMES,
    Clock,
    looks_like_times,
    missing_rows,
    rate_with_gaps,
    require_even,
    sample_numbers,
    warn_of_times,
)
from daq.importing.signal import Signal, warn
from daq.importing.text_layout import (
    LABVIEW_BEGIN,
    LABVIEW_SEGMENT,
    UNNAMED,
    LabviewHeading,
    Layout,
    beginning,
    cells,
    detect_layout,
    labview_heading,
    number,
    resolution_of_stamp,
    seconds_of_stamp,
    significant_digits,
)
from rig.arrays import Array
from rig.errors import RecordingError
from rig.numerics.memory import require_memory_with_program
from rig.scene.quantities import TIME, parse

_MAX_LINE = 1 << 20
# Relative uncertainty of a rate from which it is reported.
_UNCERTAIN_RATE = 2e-5
# Maximum number of lines from which the digits of times are determined.
_MAX_SAMPLED_LINES = 50
# Minimum number of lines that show the usual number of digits.
_MIN_LINES = 10
# Lines that are read at a time.
PIECE = 1 << 16
# Memory that a byte of these lines takes, measured: text and numbers.
_READ_BYTES = 4


def text_signals(path: Path, stack: ExitStack) -> list[Signal]:
    """List the columns of a text table; it is read line by line, once for each pass through its samples.

    A first column of times gives the clock. Names and units are those of the heading: ``acc1 [m/s^2]``,
    ``acc1 (g)``, or a line of names above a line of units.
    """
    lines, encoding = beginning(path)
    if lines[0].startswith(LABVIEW_BEGIN):
        return _labview_signals(path, labview_heading(lines, str(path)), encoding, stack)
    layout = detect_layout(path, lines, encoding)
    table = _Table(path, layout, stack)
    columns = list(zip(layout.names, layout.units, strict=True))
    clock, first = Clock(None), 0
    named = TIME_NAMES.fullmatch(layout.names[0]) is not None
    if len(columns) > 1 and (named or table.has_stamps or table.begins_with_times()):
        clock, first = table.take_clock(layout.units[0]), 1
    if not table.rows:
        raise RecordingError(f"{path} contains no line of numbers. Export time histories as columns of numbers.")
    return [
        table.signal(place, name, unit, first + place - 1, clock)
        for place, (name, unit) in enumerate(columns[first:], 1)
    ]


def _labview_signals(path: Path, heading: LabviewHeading, encoding: str, stack: ExitStack) -> list[Signal]:
    """List the channels of LabVIEW's heading; a column of times overrides the heading's clock."""
    channels, times = heading.channels, heading.times
    layout = Layout(
        encoding,
        heading.separator,
        heading.decimal_comma,
        heading.lines,
        [*(["time"] if times else []), *(channel.name for channel in channels)],
        [""] * (len(channels) + times),
        (*([0] if times else []), *(channel.cell for channel in channels)),
    )
    table = _Table(path, layout, stack)
    clock = table.take_clock("s") if times else None
    longest = max(channel.samples for channel in channels)
    if longest > table.rows:
        warn(
            f"{path}: the header states {longest} samples, the table has {table.rows}. Check that the file is complete."
        )
    if 0 < longest < table.rows and not times:
        warn(
            f"{path}: its heading states segments of {longest} samples, its table has {table.rows} lines: they are "
            "joined without a gap. Import the segments one by one with --from and --to if there was one."
        )
    uncertain = [each for each in channels if each.rate and each.rate_error > _UNCERTAIN_RATE * each.rate]
    if uncertain and not times:
        rate, error = uncertain[0].rate or 0.0, uncertain[0].rate_error
        warn(
            f"{path}: its sample interval has so few digits that the rate may be {rate - error:.6g} to "
            f"{rate + error:.6g} Hz; {rate:.6g} Hz is used. State rate: in the table if it was another."
        )
    signals = []
    for place, channel in enumerate(channels, 1):
        signal = table.signal(
            place,
            channel.name,
            channel.unit,
            place - 1 + times,
            clock or Clock(channel.rate, channel.start_s),
            # Programs append lines without a change of the heading; only a shorter channel is taken from it.
            table.rows if channel.samples in (-1, longest) else min(channel.samples, table.rows),
        )
        signals.append(replace(signal, start_ns=channel.start_ns))
    return signals


class _Table:
    """A table that is read from its beginning to its end, in pieces that all columns share."""

    def __init__(self, path: Path, layout: Layout, stack: ExitStack) -> None:
        self._path, self._layout = path, layout
        self._file: IO[str] = stack.enter_context(path.open(encoding=layout.encoding, errors="replace", newline=""))
        self._grid: tuple[Clock, float, float] | None = None  # Clock, resolution and unit of the times, s
        self._samples: list[str] = []  # first lines, and the last line
        self.rows = 0
        previous_line, last = "", (0, "")
        for numbered_line in self._lines():
            if self.rows < _MAX_SAMPLED_LINES:
                self._samples.append(numbered_line[1])
            previous_line, last = last[1], numbered_line
            self.rows += 1
        if self.rows > 1 and (reason := self._truncation(*last)):
            warn(f"{path}: its last line is cut off and is omitted ({reason})")
            self.rows -= 1
            self._samples = self._samples[: self.rows]
            last = (0, previous_line)
        if self.rows:
            self._samples.append(last[1])
            piece_bytes = min(1.0, PIECE / self.rows) * path.stat().st_size
            require_memory_with_program(_READ_BYTES * piece_bytes, f"{path}: importing it")
        self._reading = self._lines()
        self._position = 0
        self._last_piece: tuple[int, int, Array] = (-1, -1, np.empty((0, 0)))

    def _truncation(self, line_number: int, line: str) -> str:
        """Return the reason why the last line is cut off; empty if it may be complete."""
        try:
            self._row(line_number, line)
        except RecordingError as error:
            return str(error)
        last = [cells(each, self._layout.delimiter)[-1] for each in (*self._samples[:-1], line)]
        lengths = [len(cell.lstrip("+-")) for cell in last]
        if not line.endswith(("\n", "\r")) and len(lengths) > _MIN_LINES and lengths[-1] < min(lengths[:-1]):
            return f"line {line_number}: {last[-1]!r:.40} is shorter than in other lines, and the line has no end"
        return ""

    @property
    def has_stamps(self) -> bool:
        """Whether the first column holds dates with times of day."""
        return bool(self._samples) and seconds_of_stamp(self._first_cell(self._samples[0])) is not None

    def begins_with_times(self) -> bool:
        """Return whether the first column of a table without heading can only be times, with a warning."""
        if self._layout.names[0] != UNNAMED.format(1) or self.rows < 2:
            return False
        begin = np.array([self._row(0, line)[0] for line in self._samples[:-1]])
        if not looks_like_times(begin, self._row(0, self._samples[-1])[0], self.rows):
            return False
        warn_of_times(f"{self._path} has no heading; its first column", begin[1] - begin[0])
        return True

    def take_clock(self, unit: str) -> Clock:
        """Estimate the clock from the first column: times in a unit."""
        where = f"{self._path}: the times in its first column"
        try:
            scale = parse(f"1 {unit}", TIME) if unit and not self.has_stamps else 1.0
        except ValueError as error:
            raise RecordingError(f"{where}: {error}; expected a unit of time such as s or ms") from None
        if self.rows < 2:
            raise RecordingError(f"{where}: {self.rows} line of numbers; expected at least 2")
        first, last = (self._row(0, self._samples[end])[0] * scale for end in (0, -1))
        written = [self._first_cell(line) for line in self._samples]
        if self.has_stamps:
            resolution = min(map(resolution_of_stamp, written))
        else:
            largest = max(abs(first), abs(last), 1e-300)
            resolution = 10.0 ** (np.floor(np.log10(largest)) + 1 - max(map(significant_digits, written)))
        missing = missing_rows(self._times(scale), resolution)
        rate = rate_with_gaps(first, last, self.rows, missing, resolution, where)
        clock = Clock(rate, first, missing)
        self._grid = clock, resolution, scale
        return clock

    def _first_cell(self, line: str) -> str:
        return cells(line, self._layout.delimiter)[0]

    def _times(self, scale: float) -> Iterator[Array]:
        """Yield the first column in pieces, s."""
        lines = islice(self._lines(), self.rows)
        while block := list(islice(lines, PIECE)):
            yield np.array([self._time(*each) for each in block]) * scale

    def _time(self, line_number: int, line: str) -> float:
        delimiter = self._layout.delimiter
        cell = self._first_cell(line) if delimiter is None else line.split(delimiter, 1)[0]
        value = number(cell.strip(' "\r\n'), self._layout.decimal_comma)
        return self._row(line_number, line)[0] if value is None else value

    def signal(self, place: int, name: str, unit: str, column: int, clock: Clock, samples: int | None = None) -> Signal:
        """Make a signal of a column."""

        def read(start: int, stop: int) -> Array:
            return self._read(start, stop)[:, column]

        rows = self.rows if samples is None else samples
        signal = Signal(self._path.name, place, name, unit, rows, clock.rate, read, clock.start_s)
        return signal.with_gaps(clock)

    def _read(self, start: int, stop: int) -> Array:
        """Read lines of numbers, shape (lines, columns); the last piece is stored for the other columns."""
        if self._last_piece[:2] == (start, stop):
            return self._last_piece[2]
        if start < self._position:
            self._reading, self._position = self._lines(), 0
        for _ in islice(self._reading, start - self._position):
            pass
        lines = list(islice(self._reading, stop - start))
        self._position = start + len(lines)
        values = self._parsed(lines)
        if self._grid is not None:
            (rate, first, missing), resolution, scale = self._grid
            numbers = sample_numbers(np.arange(start, start + len(values)), missing)
            where = f"{self._path}: the times in its first column"
            require_even(values[:, 0] * scale, numbers, first, rate or 0.0, resolution, where)
        self._last_piece = start, stop, values
        return values

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Yield the lines of numbers with their numbers in the file, from 1."""
        self._file.seek(0)
        line_number = 0
        while line := self._file.readline(_MAX_LINE):
            line_number += 1
            if line_number <= self._layout.heading or not line.strip():
                continue
            if self._layout.cells is not None and line.startswith(LABVIEW_SEGMENT):
                raise RecordingError(
                    f"{self._path}, line {line_number}: a second segment of measurement begins. Split the file, or "
                    "log to TDMS."
                )
            yield line_number, line

    def _parsed(self, lines: list[tuple[int, str]]) -> Array:
        layout = self._layout
        texts = [line.replace(",", ".") if layout.decimal_comma else line for _, line in lines]
        shape = len(lines), len(layout.names)
        try:
            values = np.loadtxt(texts, delimiter=layout.delimiter, comments=None, ndmin=2, usecols=layout.cells)
            if values.shape == shape:
                return values
        except ValueError:
            # Empty cells and stamps are read one by one, and errors located.
            pass
        return np.array([self._row(*each) for each in lines]).reshape(shape)

    def _row(self, line_number: int, line: str) -> list[float]:
        """Read a line, empty cells as NaN; raise `RecordingError` with the place of a bad one."""
        layout = self._layout
        row = cells(line, layout.delimiter)
        where = f"{self._path}, " + (f"line {line_number}" if line_number else "its first or last line")
        if layout.cells is not None and len(row) > layout.cells[-1]:
            row = [row[place] for place in layout.cells]
        if len(row) != len(layout.names):
            raise RecordingError(
                f"{where}: {len(row)} columns; expected {len(layout.names)}, as in the first line of numbers"
            )
        values = []
        for column, cell in enumerate(row, 1):
            value = number(cell, layout.decimal_comma)
            if value is None and column == 1:
                value = seconds_of_stamp(cell)
            if value is None:
                raise RecordingError(f"{where}, column {column}: {cell!r:.40} is not a number. Correct or remove it.")
            values.append(value)
        return values
