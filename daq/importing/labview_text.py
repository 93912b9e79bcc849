"""The heading that LabVIEW writes above its text tables (.lvm): names, units, clocks, and which columns hold times.

Facts: NI, "Specification for the LabVIEW Measurement File (.lvm)", 2022. Line by line a key and, behind it, a cell for
each channel; two ends of heading, the file's and the first segment's; then the names of the columns and the numbers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from daq.importing.clock import rate_of_interval
from rig.errors import RecordingError

BEGIN, END = "LabVIEW Measurement", "***End_of_Header***"
#: Beginnings of the lines of a further segment.
SEGMENT = ("Channels", "Notes", "X_Value", END)
_CLOCK = re.compile(r"(\d{4})/(\d\d)/(\d\d) (\d\d):(\d\d):(\d\d)(\.\d+)?")


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
    ends = [number for number, line in enumerate(lines) if line.startswith(END)]
    if len(ends) < 2 or len(lines) <= ends[1] + 1:
        raise RecordingError(
            f"{where}: its LabVIEW heading does not end; expected {END} twice, names, and numbers"
        )
    separator = "," if _keys(lines[: ends[0]], r"[\t,]").get("Separator", ["Tab"])[0] == "Comma" else "\t"
    whole, segment = _keys(lines[: ends[0]], separator), _keys(lines[ends[0] + 1 : ends[1]], separator)
    names = [cell.strip() for cell in lines[ends[1] + 1].rstrip("\r\n").split(separator)]
    columns = whole.get("X_Columns", ["One"])[0]
    # Old versions do not state the decimal separator.
    numbers = [*whole.get("Decimal_Separator", []), *segment.get("Delta_X", [])]
    comma = separator != "," and "," in "".join(numbers)
    step = 2 if columns == "Multi" else 1
    try:
        count = int(segment.get("Channels", ["0"])[0])
        if not 0 < step * count < len(names) + step - 1:
            raise ValueError(f"{count} channels under {len(names)} names")
        channels = [_channel(segment, names[1 + step * k], step * k, comma) for k in range(count)]
    except ValueError as error:
        raise RecordingError(
            f"{where}: its LabVIEW heading contradicts itself: {error}. Export it again."
        ) from None
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
        whole = datetime(*map(int, clock.groups()[:6]), tzinfo=UTC)  # type: ignore[arg-type,misc]
    except ValueError:
        return 0
    return max(0, int(whole.timestamp()) * 10**9 + int(float(clock[7] or 0.0) * 1e9))
