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
        # First sample of the run at the end of the last block, and the value before the run.
        self._open_run: tuple[int, float] | None = None

    def add(self, first: int, samples: Array) -> None:
        """Add the next samples of the signal; the first has the number `first`."""
        values = self._sign * samples
        top = float(np.fmax.reduce(values, initial=-np.inf))
        if top > self.top:
            self.top, self._runs, self._open_run = top, [], None
        new_runs = runs_of(values == self.top)
        if self._open_run is not None and not (new_runs and new_runs[0][0] == 0):
            self._close_run(first, float(values[0]))
        for begin, end in new_runs:
            if begin > 0 or self._open_run is None:
                self._open_run = first + begin, float(values[begin - 1]) if begin else self._last_value
            if end < values.size:
                self._close_run(first + end, float(values[end]))
        self._last_value = float(values[-1])

    def _close_run(self, stop: int, next_value: float) -> None:
        assert self._open_run is not None
        start, previous_value = self._open_run
        if len(self._runs) < _MAX_STORED:
            self._runs.append((start, stop, self.top - float(np.fmin(previous_value, next_value))))
        self._open_run = None

    @property
    def top_sample(self) -> int | None:
        """First sample with the largest value."""
        if self._runs:
            return self._runs[0][0]
        return None if self._open_run is None else self._open_run[0]

    def runs(self, stop: int, min_length: int, min_drop: float) -> list[tuple[int, int]]:
        """Return the runs [first, stop) of at least `min_length` samples at the largest value.

        A run is returned only if the sample before or after it is lower by more than `min_drop`. `stop`: number of all
        samples.
        """
        if self._open_run is not None:
            self._close_run(stop, np.nan)
        return [(a, b) for a, b, run_drop in self._runs if b - a >= min_length and run_drop > min_drop]


class ClippingDetector:
    """Detects clipping of one signal; `full_scale` is the largest magnitude of a sample, None if not known.

    `offset`: output of the converter for a signal of zero.
    """

    def __init__(self, full_scale: float | None, offset: float = 0.0) -> None:
        self.full_scale, self._offset = full_scale, offset
        self._extremes = _FlatTops(1), _FlatTops(-1)
        self._smallest_step = np.inf
        self._samples = 0
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
        self._samples = first + samples.size
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
            for run in extreme.runs(self._samples, _MIN_FLAT_SAMPLES, _MIN_RISE_COUNTS * self._smallest_step)
        ]
        return merge_spans([*flat_tops, *([] if self.full_scale_is_wrong else self._at_full_scale)])
