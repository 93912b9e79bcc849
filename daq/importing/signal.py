"""A signal in another program's file: its name, unit and clock as the file states them, and its samples."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.errors import RecordingError, RunWarning

Array = NDArray[np.float64]

# What programs call a row of times.
TIME_NAMES = re.compile(r"(time|zeit|t|x_value)(stamp)?", re.IGNORECASE)

# A rate stated in full differs from the one that was meant by rounding only.
_ROUNDING = 1e-12
# Times may be off the even grid by this part of a sample; beyond, samples are missing or the clock is none.
_OFF_GRID = 0.5
# Deviations of times beyond rounding and this share of a sample are reported.
_JITTERY = 0.02


@dataclass(frozen=True)
class Signal:
    """One row of samples of a file.

    Attributes
    ----------
    file : str
        Name of the file.
    number : int
        Which signal of the file, from 1.
    name : str
        As the file has it.
    unit : str
        As the file has it; empty where it says none.
    samples : int
        How many.
    rate : float or None
        Samples per second, Hz; None where the file says none.
    read : callable
        ``read(start, stop)`` gives samples in the file's unit; called with rising, adjoining ranges, or from 0 again.
    start_s : float
        Time of the first sample after the file's own zero, s.
    start_ns : int
        That zero in nanoseconds since 1970; 0 where the file has no date.
    full_scale : float or None
        Where the numbers end, in the file's unit; None where that is not known.
    """

    file: str
    number: int
    name: str
    unit: str
    samples: int
    rate: float | None
    read: Callable[[int, int], Array]
    start_s: float = 0.0
    start_ns: int = 0
    full_scale: float | None = None

    def __str__(self) -> str:
        rate = "no sample rate" if self.rate is None else f"{self.rate:.10g} Hz"
        return f"{self.name!r}, {self.samples} samples, {rate}, unit {self.unit or 'not stated'}"


def rate_of_interval(interval: float, resolution: float = 0.0) -> float:
    """Find the rate that was meant by a sample interval, which programs round.

    Parameters
    ----------
    interval : float
        Time from sample to sample, s.
    resolution : float
        How far it may be off for its rounding, s.

    Returns
    -------
    float
        Of the rates that the rounding leaves open the one with the fewest digits; as stated where the interval has
        fewer still.

    Examples
    --------
    >>> rate_of_interval(1.52588e-05, 5e-11), rate_of_interval(1.95312e-05, 5e-11)
    (65536.0, 51200.0)
    >>> rate_of_interval(1.9999999999999998e-05), rate_of_interval(1e-4, 5e-10)
    (50000.0, 10000.0)
    >>> rate_of_interval(1e-4, 1e305)
    Traceback (most recent call last):
    rig.errors.RecordingError: a sample interval of 0.0001 s that may be off by 1e+305 s determines no rate
    """
    if not (math.isfinite(interval) and 1e-9 < interval < 1e7):
        raise RecordingError(f"a sample interval of {interval!r} s; expected a time above 0")
    if resolution >= interval:
        raise RecordingError(
            f"a sample interval of {interval!r} s that may be off by {resolution!r} s determines no rate"
        )
    off = max(resolution / interval, _ROUNDING)
    stated = 1.0 / interval
    low, high = stated * (1.0 - off), stated * (1.0 + off)
    rate, digits = _roundest(low, high)
    # An interval of few digits, 39 µs, was meant as it stands.
    _, shorter = _roundest(interval * (1.0 - _ROUNDING), interval * (1.0 + _ROUNDING))
    return rate if digits <= shorter else stated


def _roundest(low: float, high: float) -> tuple[float, int]:
    """Find the number with the fewest decimal digits between two, and how many it has."""
    highest = math.floor(math.log10(high))
    for digits in range(1, 17):
        step = Fraction(10) ** (highest - digits + 1)
        number = float(round(Fraction((low + high) / 2) / step) * step)
        if low <= number <= high:
            return number, digits
    return (low + high) / 2, 17


def clock_of_times(times: Array, resolution: float, where: str) -> tuple[float, float]:
    """Find the sample rate of stated times, and the first time.

    Parameters
    ----------
    times : ndarray, shape (samples,)
        s, of all samples.
    resolution : float
        Of the times as they are written, s.
    where : str
        What they are, for messages.

    Raises
    ------
    RecordingError
        If they are not evenly spaced.
    """
    if times.size < 2:
        raise RecordingError(f"{where}: {times.size} samples; expected at least 2")
    first, last = float(times[0]), float(times[-1])
    # Their deviation from an even grid shows to how many digits they were rounded.
    off = float(abs(times - np.linspace(first, last, times.size)).max())
    if last > first and off * (times.size - 1) > (last - first) * _JITTERY + resolution * (times.size - 1):
        rate, first, off = _clock_of_jittery(times, where)
        note(
            f"{where} are off an even grid by up to {off * rate:.0%} of a sample: taken for jitter of the writing, "
            "not of the sampling"
        )
    else:
        rate = rate_between(first, last, times.size, max(resolution, 2.0 * off), where)
    even(times, np.arange(times.size), first, rate, resolution, where)
    return rate, first


def _clock_of_jittery(times: Array, where: str) -> tuple[float, float, float]:
    """Find the rate and the first time of an even grid through times by least squares, and how far they are off it."""
    number = np.arange(times.size) - (times.size - 1) / 2.0
    spread = float(number @ number)
    interval, middle = float(number @ times) / spread, float(times.mean())
    left = times - middle - interval * number
    # Four standard errors of the slope.
    error = 4.0 * float(np.std(left)) / math.sqrt(spread)
    try:
        rate = rate_of_interval(interval, error)
    except RecordingError as wrong:
        raise RecordingError(f"{where}: {wrong}") from None
    return rate, middle + float(number[0]) / rate, float(abs(left).max())


def looks_like_times(begin: Array, last: float, samples: int) -> bool:
    """Whether unnamed numbers can only be times: they rise evenly, and are no count.

    Parameters
    ----------
    begin : ndarray
        The first ones, at least two.
    last : float
        The last one.
    samples : int
        How many there are in all.

    Examples
    --------
    >>> looks_like_times(np.array([0.0, 0.01, 0.02]), 0.09, 10), looks_like_times(np.array([1.0, 2.0]), 10.0, 10)
    (True, False)
    """
    step = (last - begin[0]) / max(samples - 1, 1)
    if not (np.isfinite(step) and step > 0.0) or step == 1.0:
        return False
    return bool((abs(begin - begin[0] - step * np.arange(begin.size)) < 0.1 * step).all())


def note(text: str) -> None:
    """Warn of what is doubtful in a file."""
    warnings.warn(text, RunWarning, stacklevel=3)


def tell_times(what: str, step: float) -> None:
    """Warn that numbers which nobody named are taken for times."""
    note(f"{what} rises evenly, by {step:.6g}: taken for times in s")


def rate_between(first: float, last: float, samples: int, resolution: float, where: str) -> float:
    """Find the rate of evenly spaced times from the first and the last one, as in `clock_of_times`."""
    if not last > first:
        raise RecordingError(f"{where} do not rise: from {first!r} s to {last!r} s")
    return rate_of_interval((last - first) / (samples - 1), resolution / (samples - 1))


def even(
    times: Array, numbers: NDArray[np.int64], start: float, rate: float, resolution: float, where: str
) -> None:
    """Refuse times, in s, that are not those of samples of the given numbers."""
    off = abs(times - start - numbers / rate)
    wrong = np.flatnonzero(~(off * rate <= _OFF_GRID + resolution * rate))
    if wrong.size:
        at = int(wrong[0])
        raise RecordingError(
            f"{where} are not evenly spaced: sample {numbers[at] + 1} is at {float(times[at]):.9g} s, where "
            f"{rate:.6g} Hz from {start:.6g} s on would have it at {start + numbers[at] / rate:.9g} s; samples are "
            "missing there, or the clock is none: resample the file, or import the stretches on either side"
        )


def held(samples: NDArray[np.generic], file: str, number: int, name: str) -> NDArray[Any]:
    """Give back a row of real numbers; raise `RecordingError` if it is something else."""
    if samples.ndim != 1 or samples.dtype.kind not in "fiub":
        what = "complex numbers" if samples.dtype.kind == "c" else f"{samples.dtype} of shape {samples.shape}"
        raise RecordingError(
            f"{file}: {name!r} (number {number}) holds {what}; expected a row of real numbers"
        )
    return samples
