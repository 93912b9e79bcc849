"""What scripts pass to the instrument's calls, checked.

A value that cannot be is refused where it is passed, with the driver's code for it (-200077), by an error that
says what was expected.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from daq.instrument.errors import DaqError, DAQmxErrors

Choice = TypeVar("Choice", bound=Enum)


def _bad(message: str) -> DaqError:
    return DaqError(message, DAQmxErrors.INVALID_ATTRIBUTE_VALUE)


def choice(kind: type[Choice], value: Any, what: str) -> Choice:
    """Give the member of an enumeration, from itself or from its number.

    Examples
    --------
    >>> from daq.face.constants import Edge, Slope
    >>> choice(Slope, 10280, "slope")
    <Slope.RISING: 10280>
    >>> choice(Slope, Edge.RISING, "slope")
    Traceback (most recent call last):
    ...
    daq.errors.DaqError: slope is Edge.RISING: expected Slope.RISING or Slope.FALLING
    <BLANKLINE>
    Status Code: -200077
    """
    try:
        return kind(value)
    except ValueError:
        *others, last = map(str, kind)
        expected = f"{', '.join(others)} or {last}" if others else last
        raise _bad(f"{what} is {value}: expected {expected}") from None


def number(value: Any, what: str, expected: str = "a finite number") -> float:
    """Give a finite number."""
    try:
        found = float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise _bad(f"{what} is {value!r}: expected {expected}")
    return found


def whole(value: Any, what: str) -> int:
    """Give a whole number; what is behind the point is dropped."""
    return int(number(value, what))


def seconds(value: Any, what: str = "timeout") -> float:
    """Give a time to wait, s; negative for ever.

    Examples
    --------
    >>> seconds(2), seconds(-1.0), seconds(float("inf"))
    (2.0, -1.0, -1.0)
    """
    return -1.0 if value == math.inf else number(value, what, "seconds, or -1 to wait for ever")


def room(channels: int, samples: Any, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Make an array of zeros, shape (channels, samples)."""
    samples = whole(samples, "the number of samples per channel")
    if samples < 0:
        raise _bad(f"{samples} samples per channel: expected 0 at least, or READ_ALL_AVAILABLE (-1)")
    try:
        return np.zeros((channels, samples), dtype)
    except (MemoryError, OverflowError, ValueError):
        raise _bad(
            f"{samples} samples of {channels} channels do not fit into the memory of this machine: take fewer "
            "at a time, and use AcquisitionType.CONTINUOUS for an acquisition that goes on for long"
        ) from None


def table(value: Any, what: str) -> NDArray[np.float64]:
    """Give numbers as an array of two dimensions at most."""
    try:
        array = np.asarray(value)
        if not np.iscomplexobj(array) and array.ndim <= 2:
            return array.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        pass
    raise _bad(f"{what}: expected a number, samples of shape (n,), or (channels, n), all of them real")
