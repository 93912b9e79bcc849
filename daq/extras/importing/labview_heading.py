"""Headings of LabVIEW's text tables (.lvm): names, units, clocks, and the columns that contain times.

Each line of a heading has a key, and a cell for each channel. The heading has two parts, for the file and for the first
segment; further segments have a heading of their own. The names of the columns and the numbers follow. Reference: NI,
"Specification for the LabVIEW Measurement File (.lvm)", 2022.
"""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from daq.extras.importing.clock import rate_of_interval
from rig.core.base.errors import RecordingError

# First words of a LabVIEW file.
LABVIEW_BEGIN = "LabVIEW Measurement"
#: Last line of each part of a heading.
LABVIEW_END = "***End_of_Header***"
# Names that Express VIs of LabVIEW give to spectra, whose headings state times.
_LABVIEW_SPECTRUM = re.compile(r"\((FFT|Power Spectrum|PSD)\b", re.IGNORECASE)
# First words of the lines that begin a further segment.
LABVIEW_SEGMENT_BEGINS = ("Channels", "Notes", "X_Value", LABVIEW_END)
_LABVIEW_TIME = re.compile(r"(\d{4})/(\d\d)/(\d\d) (\d\d):(\d\d):(\d\d)(\.\d+)?")


class LabviewChannel(NamedTuple):
    """A channel in the heading of a LabVIEW file."""

    name: str
    unit: str
    cell: int  # position of its cell in a line
    samples: int  # -1: not stated
    rate: float | None  # Hz
    rate_error: float  # largest error of the rate from the rounding of the sample interval [Hz]
    start_s: float
    start_ns: int


class LabviewHeading(NamedTuple):
    """The heading of a LabVIEW file; `lines` is its number of lines."""

    separator: str
    decimal_comma: bool
    lines: int
    has_times: bool  # whether the first cell of every line is its time
    channels: list[LabviewChannel]


def read_labview_heading(lines: Sequence[str], where: str) -> LabviewHeading:
    """Read the heading of a LabVIEW file; raise `RecordingError` if the file is truncated or contradicts itself."""
    ends = [number for number, line in enumerate(lines) if line.startswith(LABVIEW_END)]
    if len(ends) < 2 or len(lines) <= ends[1] + 1:
        raise RecordingError(
            f"{where}: its LabVIEW heading has no end; expected {LABVIEW_END} twice, then a line of names, then "
            "numbers. Export it again."
        )
    separator = "," if _cells_by_key(lines[: ends[0]], r"[\t,]").get("Separator", ["Tab"])[0] == "Comma" else "\t"
    file_keys = _cells_by_key(lines[: ends[0]], separator)
    segment = _cells_by_key(lines[ends[0] + 1 : ends[1]], separator)
    names = [cell.strip() for cell in lines[ends[1] + 1].rstrip("\r\n").split(separator)]
    columns = file_keys.get("X_Columns", ["One"])[0]
    # Old versions do not give the decimal separator.
    numbers = [*file_keys.get("Decimal_Separator", []), *segment.get("Delta_X", [])]
    decimal_comma = separator != "," and "," in "".join(numbers)
    cells_per_channel = 2 if columns == "Multi" else 1
    try:
        count = int(segment.get("Channels", ["0"])[0])
        # A column of times precedes all channels or, with separate times, each channel.
        if not 0 < cells_per_channel * count < len(names) + cells_per_channel - 1:
            raise ValueError(f"{count} channels, but {len(names)} names of columns")
        channels = [
            _labview_channel(segment, names[1 + cells_per_channel * k], cells_per_channel * k, decimal_comma)
            for k in range(count)
        ]
    except ValueError as error:
        raise RecordingError(
            f"{where}: its LabVIEW heading cannot be used ({error}). Export the signals again."
        ) from None
    return LabviewHeading(separator, decimal_comma, ends[1] + 2, columns == "One", channels)


def _cells_by_key(lines: Sequence[str], separator: str) -> dict[str, list[str]]:
    rows = [re.split(separator, line.strip("\r\n")) for line in lines]
    return {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows if len(row) > 1}


def _labview_channel(segment: dict[str, list[str]], name: str, position: int, decimal_comma: bool) -> LabviewChannel:
    def stated_value(key: str, default: str) -> str:
        cells = segment.get(key, [])
        text = (cells[position] if position < len(cells) else "") or default
        return text.replace(",", ".") if decimal_comma else text

    if _LABVIEW_SPECTRUM.search(name):
        raise ValueError(f"column {name!r} is a spectrum, not samples")
    interval = stated_value("Delta_X", "0")
    error = _rounding_error(interval)
    rate = rate_of_interval(float(interval), error) if float(interval) else None
    return LabviewChannel(
        name,
        stated_value("Y_Unit_Label", ""),
        position + 1,
        int(stated_value("Samples", "-1")),
        rate,
        rate**2 * error if rate else 0.0,
        float(stated_value("X0", "0")),
        _nanoseconds(f"{stated_value('Date', '')} {stated_value('Time', '').replace(',', '.')}"),
    )


def _rounding_error(number: str) -> float:
    """Return the largest rounding error of a number as it is written.

    >>> _rounding_error("0.000977"), _rounding_error("1.9531E-5")
    (5e-07, 5e-10)
    """
    mantissa, _, power = number.lower().partition("e")
    return float(f"0.5e{int(power or 0) - len(mantissa.partition('.')[2])}")


def _nanoseconds(stamp: str) -> int:
    """Return a local time without a zone in ns since 1970, as if it were UTC; 0 if it is not a time."""
    match = _LABVIEW_TIME.fullmatch(stamp)
    if match is None:
        return 0
    try:
        instant = datetime(*map(int, match.groups()[:6]), tzinfo=UTC)  # type: ignore[arg-type,misc]
    except ValueError:
        return 0
    return max(0, int(instant.timestamp()) * 10**9 + int(float(match[7] or 0.0) * 1e9))
