"""Detection of clipping in the samples of a signal, which files do not record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rig.arrays import Array
from rig.numerics.runs import runs_of

# Minimum number of equal samples at the largest value: a smooth peak has fewer.
_MIN_FLAT_SAMPLES = 3
# Counts by which the signal must rise to them: a slow signal in coarse steps also has flat peaks.
_MIN_RISE_COUNTS = 4.0
# Ratio to the stated range from which a reading is clipped.
_CLIPPED_RATIO = 0.9999
# Ratio to the stated range above which readings show that the signal has another range.
_WRONG_LIMIT_RATIO = 1.05
# Maximum number of stored segments.
_MAX_STORED = 100_000


class Rail:
    """The flat tops of one side of a signal, block by block."""

    def __init__(self, sign: int) -> None:
        self._sign = sign
        self.top = self._last = -np.inf
        # First and last sample of each run at the top, and how far the samples next to it are below.
        self._runs: list[tuple[int, int, float]] = []
        # First sample of a run that continues, and the value before it.
        self._open: tuple[int, float] | None = None

    def add(self, first: int, samples: Array) -> None:
        """Add the next samples of the signal; the first has the number `first`."""
        values = self._sign * samples
        top = float(np.fmax.reduce(values, initial=-np.inf))
        if top > self.top:
            self.top, self._runs, self._open = top, [], None
        spans = runs_of(values == self.top)
        if self._open is not None and not (spans and spans[0][0] == 0):
            self._end(first, float(values[0]))
        for begin, end in spans:
            if begin > 0 or self._open is None:
                self._open = first + begin, float(values[begin - 1]) if begin else self._last
            if end < values.size:
                self._end(first + end, float(values[end]))
        self._last = float(values[-1])

    def _end(self, stop: int, next_value: float) -> None:
        assert self._open is not None
        start, previous_value = self._open
        if len(self._runs) < _MAX_STORED:
            self._runs.append((start, stop, self.top - float(np.fmin(previous_value, next_value))))
        self._open = None

    @property
    def at(self) -> int | None:
        """First sample of the largest value."""
        if self._runs:
            return self._runs[0][0]
        return None if self._open is None else self._open[0]

    def runs(self, stop: int, min_length: int, drop: float) -> list[tuple[int, int]]:
        """Return the segments [first, stop) of at least `min_length` samples at the largest value.

        They differ by at least `drop` from the samples next to them; `stop` is the number of all samples.
        """
        if self._open is not None:
            self._end(stop, np.nan)
        return [(a, b) for a, b, run_drop in self._runs if b - a >= min_length and run_drop > drop]


class Overloads:
    """Detects clipping of one signal; `limit` is the converter's largest reading, where known."""

    def __init__(self, limit: float | None) -> None:
        self.limit = limit
        self._rails = Rail(1), Rail(-1)
        self._count = np.inf
        self._samples = 0
        self._over: list[tuple[int, int]] = []

    @property
    def peak(self) -> float:
        """Largest magnitude so far."""
        return max(rail.top for rail in self._rails)

    @property
    def peak_at(self) -> int | None:
        """First sample of the largest magnitude; None before the first number."""
        return max(self._rails, key=lambda rail: rail.top).at

    @property
    def span(self) -> float:
        """Difference between the largest and the smallest value so far."""
        return self._rails[0].top + self._rails[1].top

    @property
    def beyond_limit(self) -> bool:
        """Whether readings exceed the limit so far that the limit must be wrong."""
        return self.limit is not None and self.peak > _WRONG_LIMIT_RATIO * self.limit

    def add(self, first: int, samples: Array) -> None:
        """Add the next samples; the first has the number `first`."""
        self._samples = first + samples.size
        steps = abs(np.diff(samples))
        self._count = min(self._count, float(np.nanmin(np.where(steps > 0, steps, np.inf), initial=np.inf)))
        for rail in self._rails:
            rail.add(first, samples)
        if self.limit is not None and len(self._over) < _MAX_STORED:
            self._over += [(first + a, first + b) for a, b in runs_of(abs(samples) >= _CLIPPED_RATIO * self.limit)]

    def spans(self) -> list[tuple[int, int]]:
        """Return the segments [first, stop) in which the signal was clipped, in order."""
        flat = [
            run
            for rail in self._rails
            # Rest at zero, such as a force between hits, is not a top.
            if rail.top > 0.5 * self.peak
            for run in rail.runs(self._samples, _MIN_FLAT_SAMPLES, _MIN_RISE_COUNTS * self._count)
        ]
        return joined([*flat, *([] if self.beyond_limit else self._over)])


def joined(spans: Sequence[tuple[int, int]], pause: int = 0) -> list[tuple[int, int]]:
    """Join spans [first, stop) that overlap or lie within a pause of each other.

    >>> joined([(5, 7), (0, 2), (2, 3)])
    [(0, 3), (5, 7)]
    """
    merged: list[tuple[int, int]] = []
    for first, stop in sorted(spans):
        if merged and first <= merged[-1][1] + pause:
            merged[-1] = merged[-1][0], max(merged[-1][1], stop)
        else:
            merged.append((first, stop))
    return merged
