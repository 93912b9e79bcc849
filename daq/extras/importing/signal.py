"""A signal in files of another program: name, unit and sample clock as stated in the file, and its samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.extras.importing.clock import Clock
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError

#: Number of lost samples between two files, or between two segments of a file, if the time between them is unknown.
GAP = 16


@dataclass(frozen=True)
class Signal:
    """The samples of one channel in a file."""

    file: str
    number: int  # Position of the signal in the file, from 1
    name: str
    unit: str  # Unit; empty if the file states none
    samples: int
    rate: float | None  # Sample rate [Hz]; None if the file states none
    # (start, stop) -> samples [start, stop) in the unit of the file.
    read: Callable[[int, int], Array]
    start_s: float = 0.0  # Time of the first sample relative to the time zero of the file [s]
    start_ns: int = 0  # Time zero of the file, ns since 1970; 0 if the file has no date
    full_scale: float | None = None  # Largest value that the file can represent, in its unit; None if not known
    separators: tuple[tuple[int, int], ...] = ()  # Ranges [start, stop) without samples, between joined files

    @classmethod
    def from_array(
        cls, path: Path, number: int, name: str, unit: str, values: NDArray[Any], clock: Clock, start_ns: int = 0
    ) -> Signal:
        """Return a signal of samples in memory; raise `RecordingError` unless they are a row of real numbers."""
        if values.ndim != 1 or values.dtype.kind not in "fiub":
            content = "complex numbers" if values.dtype.kind == "c" else f"{values.dtype} of shape {values.shape}"
            raise RecordingError(
                f"{path}: {name!r} (number {number}) contains {content}; expected a row of real numbers. Export it as "
                "real samples."
            )

        def read(first: int, stop: int) -> Array:
            return values[first:stop].astype(np.float64)

        signal = cls(path.name, number, name, unit, values.size, clock.rate, read, clock.start_s, start_ns)
        return signal.with_gaps(clock)

    def with_gaps(self, clock: Clock) -> Signal:
        """Return the signal with NaN for the samples of missing rows."""
        missing = [(row, count) for row, count in clock.missing if row < self.samples]
        limits = [0, *(row for row, _ in missing), self.samples]
        parts = [self.part(*rows) for rows in pairwise(limits)]
        return replace(join(parts, [count for _, count in missing]), separators=()) if missing else self

    def part(self, first: int, stop: int) -> Signal:
        """Return the samples [first, stop) as a signal with the same time zero."""
        return replace(self, samples=stop - first, read=lambda start, end: self.read(first + start, first + end))

    def __str__(self) -> str:
        rate = "no sample rate" if self.rate is None else f"{self.rate:.10g} Hz"
        return f"{self.name!r}, {self.samples} samples, {rate}, unit {self.unit or 'not stated'}"


def are_repetitions(files: Sequence[Sequence[Signal]]) -> bool:
    """Return whether several files contain signals of the same names, in the same order."""
    names = [[signal.name for signal in signals] for signals in files]
    return len(files) > 1 and all(other == names[0] for other in names[1:])


def join(signals: Sequence[Signal], gaps: Sequence[int]) -> Signal:
    """Join signals of one name; `gaps`: numbers of lost samples between them.

    Raises `RecordingError` if the signals differ in sample rate or unit.
    """
    first = signals[0]
    for other in signals[1:]:
        for what, expected, stated in (("rate", first.rate, other.rate), ("unit", first.unit, other.unit)):
            if stated != expected:
                raise RecordingError(
                    f"{other.file}: the {what} of {other.name!r} is {stated or 'not stated'}, but {first.file} has "
                    f"{expected or 'none'}. Import files with a different {what} separately."
                )
    sizes = np.array([signal.samples for signal in signals])
    starts = np.cumsum([0, *(sizes[:-1] + gaps)])
    ends = starts + sizes

    def read(start: int, stop: int) -> Array:
        values = np.full(stop - start, np.nan)
        for index in range(int(np.searchsorted(ends, start, "right")), int(np.searchsorted(starts, stop))):
            position = int(starts[index])
            begin, end = max(start, position), min(stop, int(ends[index]))
            values[begin - start : end - start] = signals[index].read(begin - position, end - position)
        return values

    return replace(
        first,
        file=", ".join(dict.fromkeys(signal.file for signal in signals)),
        samples=int(ends[-1]),
        read=read,
        full_scale=first.full_scale if len({signal.full_scale for signal in signals}) == 1 else None,
        separators=tuple(zip(ends[:-1].tolist(), starts[1:].tolist(), strict=True)),
    )
