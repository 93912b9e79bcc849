"""The columns of a text table, separated by commas, semicolons, tabs or blanks, with or without a heading."""

import re
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import islice, pairwise, takewhile
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np

from daq.extras.importing.clock import (
    TIME_NAMES,
    Clock,
    blocks,
    clock_of_times,
    looks_like_times,
    time_scale,
    warn,
    warn_used_as_times,
)
from daq.extras.importing.labview_heading import (
    LABVIEW_BEGIN,
    LABVIEW_END,
    LABVIEW_SEGMENT_BEGINS,
    LabviewHeading,
    read_labview_heading,
)
from daq.extras.importing.signal import GAP, Signal, are_repetitions, join
from daq.extras.importing.text_layout import (
    TIME_UNITS,
    UNNAMED,
    Layout,
    detect_layout,
    expand_complex,
    parse_number,
    read_beginning,
    significant_digits,
    split_cells,
    stamp_resolution,
    stamp_seconds,
)
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError
from rig.core.numerics.memory import require_memory_with_program

# Name of a further column of times: ``Time 2``, ``Time_B``.
_FURTHER_TIMES = re.compile(r"(time|zeit|x_value)(stamp)?[\W_]*[\dA-Z]?", re.IGNORECASE)
# Maximum number of characters in a line; longer lines are not read, because a binary file has no line ends.
_MAX_LINE = 1 << 20
# The rounding error of a sample rate is reported above this fraction of the rate, the tolerance of a usual sample
# clock.
_MAX_RATE_UNCERTAINTY = 2e-5
# Maximum number of first lines that are examined for the digits of times; the digits do not change later.
_MAX_EXAMINED_LINES = 50
# The usual length of the last number in a line is determined from at least this number of lines: trailing zeros shorten
# single numbers.
_MIN_LINES = 10
# Maximum number of segments of a LabVIEW file, each of which is read with an open file.
_MAX_SEGMENTS = 200
# Maximum deviation of the times of a segment without a gap from those of consecutive samples [samples].
_MAX_DEVIATION = 0.5
# Number of lines in a block, to limit the memory.
BLOCK_LINES = 1 << 16
# Measured memory for text and numbers, bytes per byte of a block.
_MEMORY_PER_BYTE = 4


def text_signals(path: Path, _stack: ExitStack) -> list[Signal]:
    """List the columns of a text table as signals.

    If the first column contains times, they determine the clock. Names and units are those of the heading:
    ``acc1 [m/s^2]``, ``acc1 (g)``, or a line of names above a line of units.
    """
    lines, encoding = read_beginning(path)
    if lines[0].startswith(LABVIEW_BEGIN):
        return _labview_segments(path, lines, encoding)
    layout = detect_layout(path, lines, encoding)
    table = _Table(path, layout)
    columns = list(zip(layout.names, layout.units, strict=True))
    clock, first_data_column = Clock(None), 0
    are_named_times = TIME_NAMES.fullmatch(layout.names[0]) is not None or layout.units[0] in TIME_UNITS
    if len(columns) > 1 and (are_named_times or table.has_times_of_day or table.first_column_can_only_be_times()):
        clock, first_data_column = table.estimate_clock(layout.units[0]), 1 + table.has_milliseconds
    elif layout.rate:
        clock = Clock(layout.rate)
        warn(f"{path}: the table has no times; the sample rate of its heading, {layout.rate:.6g} Hz, is used")
    if 1 < table.rows < len(columns) and layout.names[-1] == UNNAMED.format(len(columns)):
        raise RecordingError(
            f"{path} has {len(columns)} unnamed columns of {table.rows} numbers. Export a column for each channel."
        )
    numbered = list(enumerate(columns))[first_data_column:]
    if first_data_column:
        numbered = [(k, (name, unit)) for k, (name, unit) in numbered if not table.repeats_times(k, name)]
    return [
        Signal.from_array(path, position, name, unit, table.values[:, column], clock)
        for position, (column, (name, unit)) in enumerate(numbered, 1)
    ]


def _labview_segments(path: Path, lines: list[str], encoding: str) -> list[Signal]:
    """List the channels of a LabVIEW file; samples are lost between segments unless their times are consecutive."""
    first = read_labview_heading(lines, str(path))
    file_heading = list(takewhile(lambda line: not line.startswith(LABVIEW_END), lines))
    headings, stops, rows, open_heading = [first], [], [0], list[str]()
    with path.open(encoding=encoding, errors="replace", newline="") as file:
        for number, line in enumerate(file):
            if number < first.lines:
                continue
            if not open_heading and not line.startswith(LABVIEW_SEGMENT_BEGINS):
                rows[-1] += bool(line.strip())
                continue
            if not open_heading:
                stops.append(number)
            open_heading.append(line.rstrip("\r\n"))
            if len(open_heading) > 1 and open_heading[-2].startswith(LABVIEW_END):
                heading = read_labview_heading([*file_heading, LABVIEW_END, *open_heading], f"{path}, line {number}")
                headings.append(heading._replace(lines=number + 1))
                rows, open_heading = [*rows, 0], []
    # Keys begin with a letter, the end of a heading with an asterisk, and rows with a number or a separator.
    if any(line.strip() and not (line[0].isalpha() or line[0] == "*") for line in open_heading):
        raise RecordingError(
            f"{path}, line {stops[-1] + 1}: the heading of segment {len(headings) + 1} has no end; expected a line "
            f"{LABVIEW_END}. Remove the lines of this segment, or export the file again."
        )
    if len(headings) > _MAX_SEGMENTS:
        raise RecordingError(f"{path} has {len(headings)} segments; expected at most {_MAX_SEGMENTS}. Log to TDMS.")
    parts = [part for part in zip(headings, [*stops, None], rows, strict=False) if part[2]] or [(first, None, 0)]
    if n_empty := len(headings) + bool(open_heading) - len(parts):
        warn(f"{path}: {n_empty} of its {n_empty + len(parts)} segments contain no samples, and are not imported")
    segments = [_labview_signals(path, heading, stop, encoding) for heading, stop, _ in parts]
    if len(segments) == 1:
        return segments[0]
    if not are_repetitions(segments):
        raise RecordingError(f"{path}: the channels of its segments differ. Split the file before each segment.")
    gaps = [_lost_samples(before[0], after[0]) for before, after in pairwise(segments)]
    warn(f"{path}: its {len(segments)} segments are joined; samples are lost between {np.count_nonzero(gaps)} of them")
    return [join(signals, gaps) for signals in zip(*segments, strict=True)]


def _lost_samples(before: Signal, after: Signal) -> int:
    """Return 0 if a segment begins one sample interval after the end of the segment before, otherwise `GAP`."""
    starts = [signal.start_ns * 1e-9 + signal.start_s for signal in (before, after)]
    deviation = starts[1] - starts[0] - before.samples / (before.rate or np.inf)
    return 0 if before.rate and abs(deviation) * before.rate < _MAX_DEVIATION else GAP


def _labview_signals(path: Path, heading: LabviewHeading, stop: int | None, encoding: str) -> list[Signal]:
    """List the channels of a segment as signals; a column of times overrides the heading, unless the rates differ.

    `stop`: number of lines in the file before the next segment; None for the last segment.
    """
    channels, has_times = heading.channels, heading.has_times
    layout = Layout(
        encoding,
        heading.separator,
        heading.decimal_comma,
        heading.lines,
        [*(["time"] if has_times else []), *(channel.name for channel in channels)],
        [""] * (len(channels) + has_times),
        (*([0] if has_times else []), *(channel.cell for channel in channels)),
        stop=stop,
    )
    table = _Table(path, layout)
    clock = table.estimate_clock("s") if has_times else None
    # The times are those of the longest channel. A channel with another rate has fewer rows.
    longest = max(channels, key=lambda channel: channel.samples)
    stated_samples = longest.samples
    if stated_samples > table.rows:
        warn(
            f"{path}: the heading states {stated_samples} samples, but the table has only {table.rows}. Check that the "
            "file is complete."
        )
    if 0 < stated_samples < table.rows and not has_times:
        warn(
            f"{path}: the heading states {stated_samples} samples, but the table has {table.rows}, which are imported "
            "without a gap. If the measurement was paused, import the parts one by one with `from_s` and `to_s`."
        )
    uncertain = [each for each in channels if each.rate and each.rate_error > _MAX_RATE_UNCERTAINTY * each.rate]
    if uncertain and not has_times:
        rate, error = uncertain[0].rate or 0.0, uncertain[0].rate_error
        warn(
            f"{path}: its sample interval has so few digits that the rate may be {rate - error:.6g} to "
            f"{rate + error:.6g} Hz; {rate:.6g} Hz is used. If this rate is wrong, give rate: in the channel table."
        )
    return [
        Signal.from_array(
            path,
            position,
            channel.name,
            channel.unit,
            # Programs append lines without updating the counts in the header. The count of a channel is therefore used
            # only if another channel has a larger count.
            table.values[: table.rows if channel.samples in (-1, stated_samples) else channel.samples, column],
            clock if clock and channel.rate in (None, longest.rate) else Clock(channel.rate, channel.start_s),
            channel.start_ns,
        )
        for position, (column, channel) in enumerate(enumerate(channels, int(has_times)), 1)
    ]


class _InvalidLine(RecordingError):
    """An invalid line; `fault`: the message without the remedy, for the warning if the last line is omitted."""

    def __init__(self, fault: str, remedy: str) -> None:
        super().__init__(f"{fault}. {remedy}")
        self.fault = fault


class _Table:
    """The numbers of a text table; `values` has the shape (lines, columns), and lies in a temporary file."""

    def __init__(self, path: Path, layout: Layout) -> None:
        self._path, self._layout = path, layout
        self._examined_lines: list[str] = []  # the first lines, and the last line
        self.rows = 0
        # A table may be larger than the memory. The map of the temporary file remains valid when the file is closed.
        with path.open(encoding=layout.encoding, errors="replace", newline="") as file, TemporaryFile() as store:
            lines = self._lines(file)
            following = list(islice(lines, BLOCK_LINES))
            self._examined_lines = [line for _, line in following[:_MAX_EXAMINED_LINES]]
            while block := following:
                following = list(islice(lines, BLOCK_LINES))
                if not following:
                    block = self._without_footer(block)
                n_bytes = sum(len(line) for _, line in block)
                require_memory_with_program(_MEMORY_PER_BYTE * n_bytes, f"{path}: importing it")
                lines_before = self._examined_lines[: self.rows + len(block) - 1]
                if not following and lines_before and (reason := self._truncation_reason(*block[-1], lines_before)):
                    warn(f"{path}: the last line is invalid or truncated, and is not imported ({reason})")
                    if not (block := block[:-1]):
                        break
                store.write(self._parse_lines(block).tobytes())
                self.rows += len(block)
                last_line = block[-1][1]
            store.flush()
            shape = self.rows, len(layout.names)
            self.values: Array = np.memmap(store, np.float64, "r", shape=shape) if self.rows else np.empty(shape)
        if self.rows:
            self._examined_lines = [*self._examined_lines[: self.rows], last_line]

    def _without_footer(self, lines: list[tuple[int, str]]) -> list[tuple[int, str]]:
        """Omit lines of text below the table, with a warning."""
        n_texts = len(list(takewhile(self._is_text, (line for _, line in reversed(lines[1:])))))
        # The single last line is examined for truncation.
        if n_texts < 2:
            return lines
        warn(f"{self._path}: the last {n_texts} lines are texts, and are not imported")
        return lines[:-n_texts]

    def _is_text(self, line: str) -> bool:
        """Return whether a line does not begin with a number or a time."""
        first = self._layout.cells[0] if self._layout.cells else 0
        cells = split_cells(line, self._layout.delimiter)[first:][:1]
        return any(parse_number(cell, self._layout.decimal_comma) is stamp_seconds(cell) is None for cell in cells)

    def _truncation_reason(self, line_number: int, line: str, lines_before: list[str]) -> str:
        """Return the reason why the last line is certainly truncated; an empty string if it may be complete."""
        try:
            self._parse_line(line_number, line)
        except _InvalidLine as error:
            return error.fault
        last_cells = [split_cells(each, self._layout.delimiter)[-1] for each in (*lines_before, line)]
        # Only the digits after the decimal mark are compared; the digits before it depend on the value.
        lengths = [len(re.split("[.,]", cell, maxsplit=1)[-1]) if re.search("[.,]", cell) else 0 for cell in last_cells]
        if not line.endswith(("\n", "\r")) and len(lengths) > _MIN_LINES and lengths[-1] < min(lengths[:-1]):
            return f"line {line_number}: {last_cells[-1]!r:.40} is shorter than in other lines, and the line has no end"
        return ""

    def _first_cells(self, column: int = 0) -> list[str]:
        """Return the cells of a column in the examined lines."""
        position = self._layout.cells[column] if self._layout.cells else column
        return [split_cells(line, self._layout.delimiter)[position] for line in self._examined_lines]

    @property
    def has_times_of_day(self) -> bool:
        """Whether the first column contains times of day, with or without dates."""
        return any(stamp_seconds(cell) is not None for cell in self._first_cells()[:1])

    @property
    def has_milliseconds(self) -> bool:
        """Whether the second column contains the milliseconds of the times of day in the first column."""
        return self.has_times_of_day and self._layout.names[1:2] == ["ms"]

    def first_column_can_only_be_times(self) -> bool:
        """Return whether the first column of a table without heading can only be times; warn if so."""
        if self._layout.names[0] != UNNAMED.format(1) or self._layout.units[0] or self.rows < 2:
            return False
        first_times, last_time = self.values[:_MAX_EXAMINED_LINES, 0], float(self.values[-1, 0])
        if not looks_like_times(first_times, last_time, self.rows):
            return False
        warn_used_as_times(f"{self._path} has no heading; its first column", first_times[1] - first_times[0])
        return True

    def repeats_times(self, column: int, name: str) -> bool:
        """Return whether a column contains the times of the first column; raise an error if it has other times."""
        if not _FURTHER_TIMES.fullmatch(name):
            return False
        if not all(np.array_equal(*self.values[block][:, [column, 0]].T) for block in blocks(self.rows)):
            raise RecordingError(
                f"{self._path}: the times of column {self._layout.names[column]!r} differ from those of the first "
                "column. Export signals with different times to separate files."
            )
        return True

    def estimate_clock(self, unit: str) -> Clock:
        """Estimate the clock from the first column, which contains times in `unit`."""
        where = f"{self._path}: the times in its first column"
        scale = time_scale("" if self.has_times_of_day else unit, where)
        times, milliseconds = self.values[:, 0], np.empty(0)
        if self.has_times_of_day:
            resolution = min(map(stamp_resolution, self._first_cells()))
            if self.has_milliseconds and resolution < 1.0:
                warn(f"{where} have fractions of a second; its column 'ms' is not imported")
            elif self.has_milliseconds:
                milliseconds = self.values[:, 1]
                resolution = min(1e-3 * 10.0 ** -len(re.split("[.,]", f"{cell}.")[1]) for cell in self._first_cells(1))
                if np.fmax.reduce(milliseconds, initial=0.0) >= 1000.0:
                    # The milliseconds are counted from the first time of day on.
                    times = np.broadcast_to(times[0], self.rows)
        else:
            largest = float(abs(scale * times[[0, -1]]).max(initial=1e-300)) if self.rows else 1.0
            digits = max(map(significant_digits, self._first_cells()), default=1)
            resolution = 10.0 ** (np.floor(np.log10(largest)) + 1 - digits)
        with TemporaryFile() as store:
            for block in blocks(self.rows):
                added = 1e-3 * milliseconds[block] if milliseconds.size else 0.0
                store.write((times[block] * scale + added).tobytes())
            store.flush()
            seconds: Array = np.memmap(store, np.float64, "r") if self.rows else np.empty(0)
        return clock_of_times(seconds, resolution, where)

    def _lines(self, file: IO[str]) -> Iterator[tuple[int, str]]:
        """Yield the lines of numbers, each with its line number in the file, from 1."""
        line_number = 0
        while line := file.readline(_MAX_LINE):
            line_number += 1
            if line_number > (self._layout.stop or line_number):
                return
            if line_number <= self._layout.heading_lines or not line.strip():
                continue
            if self._layout.has_complex:
                line = expand_complex(line, self._layout.delimiter)
            yield line_number, line

    def _parse_lines(self, lines: list[tuple[int, str]]) -> Array:
        if (numbers := self._parse_numbers(lines)) is not None:
            return numbers
        # Lines with empty cells, times of day or errors are read cell by cell.
        return np.array([self._parse_line(*each) for each in lines])

    def _parse_numbers(self, lines: list[tuple[int, str]]) -> Array | None:
        """Return the numbers of lines of plain numbers, shape (lines, columns); None for other lines."""
        import pyarrow
        import pyarrow.csv

        delimiter, decimal_comma, cells = self._layout.delimiter, self._layout.decimal_comma, self._layout.cells
        if delimiter == "," and decimal_comma:
            return None
        texts = [line for _, line in lines]
        if delimiter is None:
            texts, delimiter = [" ".join(line.split()) + "\n" for line in texts], " "
        # LabVIEW files may have a column of comments.
        text, count = "".join(texts), texts[0].count(delimiter) + 1
        columns = [str(column) for column in range(count)]
        included = columns if cells is None else [str(cell) for cell in cells]
        try:
            table = pyarrow.csv.read_csv(
                pyarrow.BufferReader((text.replace(",", ".") if decimal_comma else text).encode()),
                pyarrow.csv.ReadOptions(use_threads=False, column_names=columns),
                pyarrow.csv.ParseOptions(delimiter=delimiter, quote_char=False),
                pyarrow.csv.ConvertOptions(
                    column_types=dict.fromkeys(columns, pyarrow.float64()), include_columns=included, null_values=[""]
                ),
            )
        except (pyarrow.ArrowInvalid, pyarrow.ArrowKeyError):
            return None
        is_complete = table.shape == (len(lines), len(self._layout.names))
        return np.stack([column.to_numpy() for column in table.columns], axis=1) if is_complete else None

    def _parse_line(self, line_number: int, line: str) -> list[float]:
        """Return the numbers of a line, NaN for empty cells; raise `RecordingError` with line and column otherwise."""
        layout = self._layout
        row, where = split_cells(line, layout.delimiter), f"{self._path}, line {line_number}"
        if layout.cells is not None and len(row) > layout.cells[-1]:
            row = [row[position] for position in layout.cells]
        if len(row) != len(layout.names):
            raise _InvalidLine(
                f"{where}: {len(row)} columns; expected {len(layout.names)}, as in the first line of numbers",
                "Correct or remove the line. If a second table begins there, export it to its own file.",
            )
        values = []
        for column, cell in enumerate(row, 1):
            value = parse_number(cell, layout.decimal_comma)
            if value is None and column == 1:
                value = stamp_seconds(cell)
            if value is None:
                raise _InvalidLine(
                    f"{where}, column {column}: {cell!r:.40} is not a number", "Correct the cell, or remove the line."
                )
            values.append(value)
        return values
