"""Rows that a table of samples lacks, by its times: a program that could not keep up leaves them out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from daq.importing.signal import Array, Signal, clock_of_times, even, note, rate_between, rate_of_interval
from rig.errors import RecordingError

# A step of the times is a gap from so many sample intervals on; the other steps may differ from the usual one, and a
# gap from a whole number of intervals, by this part of it.
_GAP, _SAME = 1.5, 0.25
# Beyond so many gaps the times are no clock.
_MOST = 10_000

#: Row before which samples are missing, and how many.
Missing = tuple[int, int]


def missing_rows(times: Iterable[Array], resolution: float) -> list[Missing]:
    """Find rows that are missing in otherwise evenly spaced times.

    Parameters
    ----------
    times : iterable of ndarray
        The times in pieces, s; the first of at least two.
    resolution : float
        Of the times as they are written, s.

    Returns
    -------
    list of (int, int)
        In order; empty where the times have no gaps, or are not even otherwise: then no gap can be measured.

    Examples
    --------
    >>> missing_rows([np.array([0.0, 0.1, 0.2, 0.5, 0.6])], 0.0)
    [(3, 2)]
    """
    step, rows, even_time, even_steps = 0.0, 0, 0.0, 0
    before = np.empty(0)
    jumps: list[tuple[int, float]] = []
    for piece in times:
        steps = np.diff(np.concatenate([before, piece]))
        if not rows:
            step = float(np.median(steps))
            if not (step > 0.0 and resolution <= _SAME * step):
                return []
        wide = steps > _GAP * step
        regular = steps[~wide]
        if not (abs(regular - step) <= _SAME * step + 2.0 * resolution).all():
            return []
        # The step to the first row of a further piece begins in the piece before.
        first = rows if before.size else 1
        jumps += [(first + int(at), float(steps[at])) for at in np.flatnonzero(wide)]
        if len(jumps) > _MOST:
            return []
        even_time, even_steps = even_time + float(regular.sum()), even_steps + regular.size
        rows, before = rows + piece.size, piece[-1:]
    if not jumps or not even_steps:
        return []
    try:
        rate = rate_of_interval(even_time / even_steps, 2.0 * resolution * (len(jumps) + 1) / even_steps)
    except RecordingError:
        return []
    lost = [round(jump * rate) - 1 for _, jump in jumps]
    off = [abs(jump * rate - count - 1) for (_, jump), count in zip(jumps, lost, strict=True)]
    if max(off) > _SAME + 2.0 * resolution * rate or sum(lost) > rows:
        return []
    return [(row, count) for (row, _), count in zip(jumps, lost, strict=True)]


def numbers_of_rows(rows: NDArray[np.int64], missing: list[Missing]) -> NDArray[np.int64]:
    """Give the sample numbers of rows.

    >>> numbers_of_rows(np.arange(5), [(3, 2)])
    array([0, 1, 2, 5, 6])
    """
    before = np.array([row for row, _ in missing], np.int64)
    lost = np.cumsum([0, *(count for _, count in missing)])
    return rows + lost[np.searchsorted(before, rows, side="right")]


def with_missing(signal: Signal, missing: list[Missing]) -> Signal:
    """Give a signal whose rows are samples of their own numbers; those that are missing are NaN."""
    missing = [(row, count) for row, count in missing if row < signal.samples]
    if not missing:
        return signal
    before = np.array([row for row, _ in missing])
    lost = np.cumsum([0, *(count for _, count in missing)])
    resumes = before + lost[1:]

    def row_at(number: int) -> int:
        """Give the first row whose sample number is at least that."""
        passed = int(np.searchsorted(resumes, number, side="right"))
        row = number - int(lost[passed])
        return min(row, int(before[passed])) if passed < before.size else row

    def read(start: int, stop: int) -> Array:
        first, last = row_at(start), row_at(stop)
        values = np.full(stop - start, np.nan)
        if last > first:
            values[numbers_of_rows(np.arange(first, last), missing) - start] = signal.read(first, last)
        return values

    return replace(signal, samples=signal.samples + int(lost[-1]), read=read)


def clock_with_gaps(times: Array, resolution: float, where: str) -> tuple[float, float, list[Missing]]:
    """Find the sample rate in Hz of stated times, the first time in s, and the rows that are missing.

    Parameters and errors as `daq.importing.signal.clock_of_times`. It warns where rows are missing.
    """
    missing = missing_rows([times], resolution)
    if not missing:
        return (*clock_of_times(times, resolution, where), [])
    rate = rate_with_gaps(float(times[0]), float(times[-1]), times.size, missing, resolution, where)
    even(times, numbers_of_rows(np.arange(times.size), missing), float(times[0]), rate, resolution, where)
    return rate, float(times[0]), missing


def rate_with_gaps(
    first: float, last: float, rows: int, missing: list[Missing], resolution: float, where: str
) -> float:
    """Find the rate in Hz from the first and the last time, s; warn where rows are missing."""
    lost = sum(count for _, count in missing)
    rate = rate_between(first, last, rows + lost, resolution, where)
    if missing:
        places = "one place" if len(missing) == 1 else f"{len(missing)} places"
        note(
            f"{where} have gaps in {places}, the first before line {missing[0][0] + 1} of the numbers: {lost} samples "
            f"are missing at {rate:.6g} Hz and are imported as lost"
        )
    return rate
