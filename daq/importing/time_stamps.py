"""Times that programs write as date and time of day, in ISO 8601."""

from __future__ import annotations

import re
from datetime import UTC, datetime

# Digits of a second's fraction, behind the seconds.
_FRACTION = re.compile(r":\d\d[.,](\d+)")
# Between the times of two samples; what is read of a stamp ends at microseconds.
_FINEST = 6


def seconds_of_stamp(cell: str) -> float | None:
    """Read a time of day, behind a date or alone, as seconds since 1970; None if it is none.

    Without a zone it is taken as that of Greenwich: times are only held against each other.

    Examples
    --------
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
    """Give the size of a stamp's last digit, s; that of microseconds where it has more.

    >>> resolution_of_stamp("2024-05-01 10:00:00"), resolution_of_stamp("2024-05-01 10:00:00.0625")
    (1.0, 0.0001)
    """
    found = _FRACTION.search(cell)
    return float(f"1e-{min(len(found[1]), _FINEST)}") if found else 1.0
