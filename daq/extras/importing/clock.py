"""The sample clock of an imported file: its rate, and where rows are missing.

Programs round the sample interval and the times that they write. The rate is the number with the fewest digits that
agrees with these rounded values.
"""

import math
import re
import warnings
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, RunWarning
from rig.core.results import format_percent
from rig.core.settings.quantities import TIME, parse

# Names of a column of times.
TIME_NAMES = re.compile(
    r"((date|datum|unix|posix|epoch)[ _/&]?)?(time|zeit|t|x_value|seconds?)(stamp)?|epoch|unix", re.IGNORECASE
)

# Relative rounding error of a number with all its digits.
_RATE_ROUNDING = 1e-12
# Largest deviation of a time from evenly spaced times [samples]. At a larger deviation, samples are missing or the
# times are not those of a clock.
_MAX_DEVIATION = 0.5
# Jitter is reported if times deviate from even spacing by more than this plus the rounding error [samples].
_MAX_UNREPORTED_JITTER = 0.02
# If two successive times are farther apart than this number of sample intervals, rows are missing: a jitter of half an
# interval is still regular.
_MAX_REGULAR_INTERVALS = 1.5
# Largest deviation of an interval from one sample interval, and of a gap from a whole number of sample intervals, in
# sample intervals.
_INTERVAL_TOLERANCE = 0.25
# Largest relative rounding error of a time with three digits: 0.5 of its last digit.
_ROUNDING = 0.005
# Dates from 1954 to 2119, in days since 1900 (spreadsheets) and since the year 0 (MATLAB).
_DATES_IN_DAYS = ((20e3, 80e3), (713e3, 774e3))
_SECONDS_PER_DAY = 86400.0
# Dates in days have more than this number of samples per second. The rates of times in s of the day, such as 8640 Hz,
# would be less if these times were days.
_MIN_RATE = 0.99
# Largest date in s since 1970: the year 5138. Dates since 1973 in ms exceed it.
_MAX_DATE = 1e11
# Relative deviation of a rate from a number of two digits, or a power of two, that still is this number.
_ROUNDNESS = 1e-4
# Maximum number of gaps in the times of a clock; a file with more gaps has no clock.
_MAX_GAPS = 10_000

# Number of times in a block, to limit the memory.
_BLOCK_TIMES = 1 << 18
#: Row before which rows are missing, and their number.
MissingRows = tuple[int, int]


class Clock(NamedTuple):
    """The clock of a signal: rate in Hz (None: not stated), time of the first sample in s, missing rows."""

    rate: float | None
    start_s: float = 0.0
    missing: Sequence[MissingRows] = ()


def time_scale(unit: str, where: str) -> float:
    """Return a unit of time in s, and 1 without a unit; raise `RecordingError` if it is not a unit of time.

    The unit may precede a date, as netCDF files write it, or a comment.

    >>> time_scale("msec", "a"), time_scale("", "a"), time_scale("s (relative)", "a")
    (0.001, 1.0, 1.0)
    >>> time_scale("days since 2026-11-30", "a")
    86400.0
    """
    name = re.sub(r"(?<=\w)\s*\(.*|\s+since\s.*", "", unit.strip(" []").lower())
    text = "24 h" if name in ("d", "day", "days") else f"1 {re.sub('sec$', 's', name)}"
    try:
        return parse(text, TIME) if name else 1.0
    except ValueError as error:
        raise RecordingError(f"{where}: {error}; expected a unit of time such as s or ms") from None


def rate_of_interval(interval: float, max_error: float = 0.0, where: str = "") -> float:
    """Return the rate [Hz] with the fewest digits that agrees with a sample interval [s] within `max_error` [s].

    If the interval has fewer digits than this rate, the interval is exact, and the rate is 1 / interval. `where` begins
    the message of the `RecordingError` for an impossible interval.

    >>> rate_of_interval(1.52588e-05, 5e-11), rate_of_interval(1.95312e-05, 5e-11)
    (65536.0, 51200.0)
    >>> rate_of_interval(1.9999999999999998e-05), rate_of_interval(1e-4, 5e-10)
    (50000.0, 10000.0)
    >>> rate_of_interval(1e-4, 1.0)
    Traceback (most recent call last):
    rig.core.base.errors.RecordingError: the sample interval 0.0001 s ± 1 s has too few digits. Export it with more.
    """
    prefix = f"{where}: " if where else ""
    if not (math.isfinite(interval) and 1e-9 < interval < 1e7):
        raise RecordingError(
            f"{prefix}the sample interval is {interval!r} s; expected 1e-9 s to 1e7 s. Correct the file."
        )
    if max_error >= interval:
        raise RecordingError(
            f"{prefix}the sample interval {interval:.6g} s ± {max_error:.2g} s has too few digits. Export it with more."
        )
    relative_error = max(max_error / interval, _RATE_ROUNDING)
    reciprocal = 1.0 / interval
    rate, digits = _shortest_number(reciprocal * (1.0 - relative_error), reciprocal * (1.0 + relative_error))
    # An interval with few digits, such as 39 µs, is assumed to be exact.
    _, digits_of_interval = _shortest_number(interval * (1.0 - _RATE_ROUNDING), interval * (1.0 + _RATE_ROUNDING))
    return rate if digits <= digits_of_interval else reciprocal


def _shortest_number(low: float, high: float) -> tuple[float, int]:
    """Return the number with the fewest decimal digits in [low, high], and its number of digits."""
    highest = math.floor(math.log10(high))
    for digits in range(1, 17):
        step = Fraction(10) ** (highest - digits + 1)
        number = float(round(Fraction((low + high) / 2) / step) * step)
        if low <= number <= high:
            return number, digits
    return (low + high) / 2, 17


def blocks(size: int) -> Iterator[slice]:
    """Yield the blocks of `size` times, which need not fit into memory together."""
    return (slice(start, min(start + _BLOCK_TIMES, size)) for start in range(0, size, _BLOCK_TIMES))


def _numbered_blocks(times: Array) -> Iterator[tuple[NDArray[np.int64], Array]]:
    """Yield the blocks of times [s], each with the row of each time."""
    return ((np.arange(block.start, block.stop), times[block]) for block in blocks(times.size))


def clock_of_times(times: Array, resolution: float, where: str) -> Clock:
    """Estimate the clock from times [s], rounded to `resolution` [s]; warn about missing rows and jitter.

    Raises `RecordingError` if the times are not evenly spaced. `where` names the times in messages.
    """
    missing = missing_rows(times, resolution)
    if times.size < 2:
        raise RecordingError(
            f"{where}: the number of time stamps is {times.size}; expected at least 2. Export more samples."
        )
    first, last = float(times[0]), float(times[-1])
    interval = (last - first) / (times.size - 1)
    # Deviations from evenly spaced times show the rounding.
    deviations = (abs(seconds - (rows * interval + first)).max() for rows, seconds in _numbered_blocks(times))
    deviation = 0.0 if missing else float(np.max(list(deviations)))
    if last > first and deviation > interval * _MAX_UNREPORTED_JITTER + resolution:
        # Evenly spaced times by least squares.
        middle, sum_of_squares, product, total = (times.size - 1) / 2.0, 0.0, 0.0, 0.0
        for rows, seconds in _numbered_blocks(times):
            sum_of_squares += float((rows - middle) @ (rows - middle))
            product += float((rows - middle) @ seconds)
            total += float(seconds.sum())
        interval, mean_time = product / sum_of_squares, total / times.size
        squares, deviation = 0.0, 0.0
        for rows, seconds in _numbered_blocks(times):
            residual = seconds - mean_time - interval * (rows - middle)
            squares, deviation = squares + float(residual @ residual), max(deviation, float(abs(residual).max()))
        # Four standard uncertainties of the slope.
        error = 4.0 * math.sqrt(squares / times.size / sum_of_squares)
        rate = rate_of_interval(interval, error, where)
        first = mean_time - middle / rate
        _require_even(times, missing, first, rate, resolution, where)
        warn(
            f"{where} deviate from even spacing by up to {format_percent(deviation * rate)} of the sample interval. "
            "The samples are imported as evenly spaced, because usually only the written times have jitter."
        )
        return Clock(rate, first)
    rate = _rate_with_gaps(first, last, times.size, missing, max(resolution, 2.0 * deviation), where)
    _require_even(times, missing, first, rate, resolution, where)
    return Clock(rate, first, missing)


def missing_rows(times: Array, resolution: float) -> list[MissingRows]:
    """Return (row, number of rows missing before it) for each gap in times [s], rounded to `resolution` [s].

    The list is empty if the other times are unevenly spaced (the size of a gap is then unknown), or if more rows are
    missing than present.

    >>> missing_rows(np.array([0.0, 0.1, 0.2, 0.5, 0.6]), 0.0)
    [(3, 2)]
    """
    gaps, rows, regular_time, regular_count = np.empty(0), np.empty(0, np.int64), 0.0, 0
    interval = float(np.median(np.diff(times[: _BLOCK_TIMES + 1]))) if times.size > 1 else 0.0
    if not (interval > 0.0 and resolution <= _INTERVAL_TOLERANCE * interval):
        return []
    for block in blocks(times.size - 1):
        intervals = np.diff(times[block.start : block.stop + 1])
        is_gap = intervals > _MAX_REGULAR_INTERVALS * interval
        regular = intervals[~is_gap]
        if not (abs(regular - interval) <= _INTERVAL_TOLERANCE * interval + 2.0 * resolution).all():
            return []
        gaps = np.append(gaps, intervals[is_gap])
        rows = np.append(rows, block.start + 1 + np.flatnonzero(is_gap))
        regular_time, regular_count = regular_time + float(regular.sum()), regular_count + regular.size
        if gaps.size > _MAX_GAPS:
            return []
    if not gaps.size:
        return []
    try:
        rate = rate_of_interval(regular_time / regular_count, 2.0 * resolution * (gaps.size + 1) / regular_count)
    except RecordingError:
        return []
    counts = np.round(gaps * rate) - 1
    largest_error = abs(gaps * rate - counts - 1).max()
    if largest_error > _INTERVAL_TOLERANCE + 2.0 * resolution * rate or counts.sum() > times.size:
        return []
    return list(zip(rows.tolist(), counts.astype(int).tolist(), strict=True))


def sample_numbers(rows: NDArray[np.int64], missing: Sequence[MissingRows]) -> NDArray[np.int64]:
    """Return the sample index of each row, counting the missing rows.

    >>> sample_numbers(np.arange(5), [(3, 2)])
    array([0, 1, 2, 5, 6])
    """
    gap_rows = np.array([row for row, _ in missing], np.int64)
    lost_counts = np.cumsum([0, *(count for _, count in missing)])
    return rows + lost_counts[np.searchsorted(gap_rows, rows, side="right")]


def _rate_with_gaps(
    first: float, last: float, rows: int, missing: Sequence[MissingRows], resolution: float, where: str
) -> float:
    """Estimate the rate [Hz] from the first and last time [s] and the missing rows; warn about the missing rows."""
    if not last > first:
        raise RecordingError(f"{where} do not increase: from {first!r} s to {last!r} s. Sort the rows by time.")
    lost_total = sum(count for _, count in missing)
    intervals = rows + lost_total - 1
    rate = rate_of_interval((last - first) / intervals, resolution / intervals, where)
    if missing:
        places = "one place" if len(missing) == 1 else f"{len(missing)} places"
        lost = "1 sample is" if lost_total == 1 else f"{lost_total} samples are"
        warn(
            f"{where} have gaps in {places}, the first before row {missing[0][0] + 1} of the data: {lost} missing at "
            f"{rate:.6g} Hz, and imported as lost."
        )
    return rate


def _require_even(
    times: Array, missing: Sequence[MissingRows], start: float, rate: float, resolution: float, where: str
) -> None:
    """Raise `RecordingError` if a time [s] differs from the time of its sample index by more than half an interval.

    Also raise it if the times are probably dates in other units than s. Dates in days have a round number of samples
    per second only if a day is taken for a second.
    """
    if start > _MAX_DATE:
        raise RecordingError(f"{where}: {start:.6g} is probably a date in ms, µs or ns. Save the times in s.")
    days = rate / _SECONDS_PER_DAY
    is_round = min(abs(float(f"{days:.1e}") / days - 1.0), abs(2.0 ** round(math.log2(days)) / days - 1.0)) < _ROUNDNESS
    if is_round and days > _MIN_RATE and any(low < start < high for low, high in _DATES_IN_DAYS):
        raise RecordingError(
            f"{where}: {start:.9g} is probably a date in days, as in spreadsheets and MATLAB. Save the times in s, or "
            "start at 0."
        )
    for rows, seconds in _numbered_blocks(times):
        numbers = sample_numbers(rows, missing)
        deviation = abs(seconds - start - numbers / rate)
        uneven = np.flatnonzero(~(deviation * rate <= _MAX_DEVIATION + resolution * rate))
        if uneven.size:
            index = int(uneven[0])
            raise RecordingError(
                f"{where} are not evenly spaced: sample {numbers[index] + 1} is at {float(seconds[index]):.9g} s "
                f"instead of {start + numbers[index] / rate:.9g} s ({rate:.6g} Hz from {start:.6g} s on). Resample the "
                "file, or import the segments before and after with `from_s` and `to_s`."
            )


def looks_like_times(first_times: Array, last: float, samples: int) -> bool:
    """Return whether the numbers of an unnamed column can only be times: they rise evenly, but not by 1.

    Spreadsheets write three digits.

    >>> looks_like_times(np.array([0.0, 0.01, 0.02]), 0.09, 10), looks_like_times(np.array([1.0, 2.0]), 10.0, 10)
    (True, False)
    """
    step = (last - first_times[0]) / max(samples - 1, 1)
    if not (np.isfinite(step) and step > 0.0) or step == 1.0:
        return False
    elapsed = step * np.arange(first_times.size)
    return bool((abs(first_times - first_times[0] - elapsed) < np.maximum(0.1 * step, _ROUNDING * elapsed)).all())


def warn_used_as_times(column: str, step: float) -> None:
    """Warn that the numbers of an unnamed column are used as times."""
    warn(f"{column} rises evenly, by {step:.6g}, and is used as times in s. If it is a signal, save it under a name.")


def warn(text: str) -> None:
    """Warn about an uncertain interpretation of a file."""
    warnings.warn(text, RunWarning, stacklevel=3)
