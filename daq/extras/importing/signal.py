"""A signal in a file of another program: name, unit and sample clock as stated in the file, and its samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.extras.importing.clock import Clock, sample_numbers
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError


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
        if not missing:
            return self
        rows_after_gaps = np.array([row for row, _ in missing])
        lost_before = np.cumsum([0, *(count for _, count in missing)])
        first_numbers_after_gaps = rows_after_gaps + lost_before[1:]

        def row_of_sample(number: int) -> int:
            """Return the first row whose sample number is at least `number`."""
            gaps_before = int(np.searchsorted(first_numbers_after_gaps, number, side="right"))
            row = number - int(lost_before[gaps_before])
            return min(row, int(rows_after_gaps[gaps_before])) if gaps_before < rows_after_gaps.size else row

        def read(start: int, stop: int) -> Array:
            first, last = row_of_sample(start), row_of_sample(stop)
            values = np.full(stop - start, np.nan)
            if last > first:
                values[sample_numbers(np.arange(first, last), missing) - start] = self.read(first, last)
            return values

        return replace(self, samples=self.samples + int(lost_before[-1]), read=read)

    def __str__(self) -> str:
        rate = "no sample rate" if self.rate is None else f"{self.rate:.10g} Hz"
        return f"{self.name!r}, {self.samples} samples, {rate}, unit {self.unit or 'not stated'}"
