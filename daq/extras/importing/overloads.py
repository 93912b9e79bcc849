"""Detection of clipping in the samples of an imported signal: flat tops, and samples at the full scale.

Clipping is an overload of the converter; it is imported as a marker of kind `overload`.
"""

import numpy as np

from rig.core.base.arrays import Array
from rig.core.numerics.runs import merge_spans, runs_of

# A flat top has at least this number of equal samples; a smooth peak has fewer.
_MIN_FLAT_SAMPLES = 3
# The signal rises to a flat top by at least this number of quantization steps. Smaller rises do not indicate clipping:
# a slow, coarsely quantized signal also has flat peaks.
_MIN_RISE_COUNTS = 4.0
# A sample is clipped if it is at least this fraction of the full scale, because files round their values.
_CLIPPED_RATIO = 0.9999
# Samples above this multiple of the stated full scale indicate that the full scale is wrong; converters exceed their
# range by less.
_WRONG_SCALE_RATIO = 1.05
# Maximum number of stored runs, about 15 MB. A signal that clips more often is unusable.
_MAX_STORED = 100_000


class _FlatTops:
    """The runs of samples at the largest value of a signal, or at the smallest (`sign` -1), block by block."""

    def __init__(self, sign: int) -> None:
        self._sign = sign
        # Largest value so far of the signal times `sign`.
        self.top = self._last_value = -np.inf
        # First sample of each run, the sample after it, and the larger of the drops to its two neighbors.
        self._runs: list[tuple[int, int, float]] = []

    def add(self, first: int, samples: Array) -> None:
        """Add the next samples of the signal; the first has the number `first`."""
        values = self._sign * samples
        top = float(np.fmax.reduce(values, initial=-np.inf))
        if top > self.top:
            self.top, self._runs = top, []
        padded = np.concatenate([[self._last_value], values, [np.nan]])
        runs = [
            (first + begin, first + end, self.top - float(np.fmin(padded[begin], padded[end + 1])))
            for begin, end in runs_of(values == self.top)
        ]
        if self._runs and self._runs[-1][1] == first:
            # The run at the end of the last block continues, or the first of these samples is its neighbor.
            start, _, drop = self._runs.pop()
            _, stop, next_drop = runs.pop(0) if runs and runs[0][0] == first else (0, first, self.top - values[0])
            runs.insert(0, (start, stop, float(np.fmax(drop, next_drop))))
        if len(self._runs) < _MAX_STORED:
            self._runs += runs
        self._last_value = float(values[-1])

    @property
    def top_sample(self) -> int | None:
        """First sample with the largest value."""
        return self._runs[0][0] if self._runs else None

    def runs(self, min_length: int, min_drop: float) -> list[tuple[int, int]]:
        """Return the runs [first, stop) of at least `min_length` samples at the largest value.

        A run is returned only if the sample before or after it is lower by more than `min_drop`.
        """
        return [(a, b) for a, b, run_drop in self._runs if b - a >= min_length and run_drop > min_drop]


class ClippingDetector:
    """Detects clipping of one signal; `full_scale` is the largest magnitude of a sample, None if not known.

    `offset`: output of the converter for a signal of zero.
    """

    def __init__(self, full_scale: float | None, offset: float = 0.0) -> None:
        self.full_scale, self._offset = full_scale, offset
        self._extremes = _FlatTops(1), _FlatTops(-1)
        self._smallest_step = np.inf
        self._at_full_scale: list[tuple[int, int]] = []

    @property
    def peak(self) -> float:
        """Largest magnitude of the signal so far."""
        return max(extreme.top for extreme in self._extremes)

    @property
    def peak_sample(self) -> int | None:
        """First sample of the largest magnitude; None before the first finite sample."""
        return max(self._extremes, key=lambda extreme: extreme.top).top_sample

    @property
    def value_range(self) -> float:
        """Difference between the largest and the smallest value so far."""
        return self._extremes[0].top + self._extremes[1].top

    @property
    def converter_peak(self) -> float:
        """Largest magnitude of the converter's output so far, which includes the offset."""
        return max(extreme.top + sign * self._offset for sign, extreme in zip((1, -1), self._extremes, strict=True))

    @property
    def full_scale_is_wrong(self) -> bool:
        """Whether samples exceed the stated full scale by so much that it must be wrong."""
        return self.full_scale is not None and self.converter_peak > _WRONG_SCALE_RATIO * self.full_scale

    def add(self, first: int, samples: Array) -> None:
        """Add the next samples; the first has the number `first`."""
        steps = abs(np.diff(samples))
        self._smallest_step = min(
            self._smallest_step, float(np.nanmin(np.where(steps > 0, steps, np.inf), initial=np.inf))
        )
        for extreme in self._extremes:
            extreme.add(first, samples)
        if self.full_scale is not None and len(self._at_full_scale) < _MAX_STORED:
            is_clipped = abs(samples + self._offset) >= _CLIPPED_RATIO * self.full_scale
            self._at_full_scale += [(first + a, first + b) for a, b in runs_of(is_clipped)]

    def clipped_intervals(self) -> list[tuple[int, int]]:
        """Return the intervals [first, stop) in which the signal was clipped, in order."""
        flat_tops = [
            run
            for extreme in self._extremes
            # A constant near zero, such as a force between impacts, is not a flat top.
            if extreme.top > 0.5 * self.peak
            for run in extreme.runs(_MIN_FLAT_SAMPLES, _MIN_RISE_COUNTS * self._smallest_step)
        ]
        return merge_spans([*flat_tops, *([] if self.full_scale_is_wrong else self._at_full_scale)])
