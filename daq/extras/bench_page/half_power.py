"""Peaks of a live response with their half-power damping: a quick view without uncertainty."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from daq.extras.bench_page.live_frf import RELATIONS
from rig.core.base.arrays import Array, ComplexArray

if TYPE_CHECKING:
    from daq.extras.bench_page.live_frf import LiveCurves

# A peak must exceed the minima on both sides by at least this factor, so it has a half-power width, ...
_MIN_RATIO = 2.0**0.5
# ... and by this multiple of the scatter of its line. A flat response with noise then has 0.3 false peaks in 200 lines
# with 2 averages, and at most 0.1 from 4 averages (simulated: Hann window, coherence 0.1 to 0.9).
_MIN_SCATTERS = 20.0
# The scatter is this percentile over this number of lines, so the curvature of a resonance does not enlarge it.
_SCATTER_PERCENTILE = 25
_SCATTER_LINES = 25
# The half-power width must contain at least this number of lines; a smaller width is determined by the resolution.
_MIN_WIDTH_LINES = 3.0
# A peak with a smaller coherence has no damping: the sweep is too fast for it, or it is noise.
_MIN_COHERENCE = 0.7
# Peaks belong to one resonance if their frequencies differ by less than this fraction; dampers split its peak.
_SAME_PEAK = 0.08


def largest_peaks(curves: LiveCurves, count: int) -> list[tuple[str, float, float, float | None, str]]:
    """Return the highest peaks: channel with the highest peak, frequency (Hz), magnitude, damping, relation.

    A single average has no peaks. The relation is one of `RELATIONS`. A clipped peak has no damping.
    """
    candidates = []
    for name, response, coherence, relation in zip(
        curves.names, curves.value, curves.coherence, curves.relation, strict=True
    ):
        for frequency, value, damping in live_peaks(curves.frequency, response):
            k = np.searchsorted(curves.frequency, frequency)
            if np.isfinite(coherence[k]):
                damping = None if relation[k] or coherence[k] < _MIN_COHERENCE else damping
                candidates.append((name, frequency, value, damping, RELATIONS[relation[k]]))
    largest: list[tuple[str, float, float, float | None, str]] = []
    for peak in sorted(candidates, key=lambda peak: -peak[2]):
        if all(abs(peak[1] / other[1] - 1.0) > _SAME_PEAK for other in largest):
            largest.append(peak)
    return sorted(largest[:count], key=lambda peak: peak[1])


def live_peaks(frequency: Array, response: ComplexArray) -> list[tuple[float, float, float | None]]:
    """Return frequency (Hz), magnitude and damping ratio of the peaks of a curve, which may have gaps (NaN).

    The damping ratio is the half-power width over twice the frequency (Ewins, Modal Testing, 4.2); None if the width is
    not resolved or not measured on both sides.

    >>> f = np.linspace(1.0, 20.0, 1901)
    >>> [(f0, value, damping)] = live_peaks(f, 1.0 / (100.0 - f**2 + 2j * 0.01 * 10.0 * f))
    >>> round(f0, 2), round(value, 3), round(damping, 4)
    (10.0, 0.5, 0.01)
    """
    peaks = []
    magnitude, scatter = np.abs(response), _scatter(response)
    bounded = np.where(np.isfinite(magnitude), magnitude, -np.inf)
    is_maximum = (bounded[1:-1] > bounded[:-2]) & (bounded[1:-1] >= bounded[2:])
    for k in (np.flatnonzero(is_maximum & np.isfinite(bounded[:-2]) & np.isfinite(bounded[2:])) + 1).tolist():
        left, right = _crossing(magnitude, k, -1), _crossing(magnitude, k, 1)
        if not _is_prominent(bounded, k, min(bounded[k] / _MIN_RATIO, bounded[k] - _MIN_SCATTERS * scatter[k])):
            continue
        damping = None
        if left is not None and right is not None and right - left >= _MIN_WIDTH_LINES:
            low, high = np.interp([left, right], np.arange(frequency.size), frequency)
            damping = float((high - low) / (2.0 * frequency[k]))
        peaks.append((float(frequency[k]), float(magnitude[k]), damping))
    return peaks


def _crossing(magnitude: Array, k: int, step: int) -> float | None:
    """Return the interpolated index at which a curve falls below the half-power level; None at a gap or an end."""
    level = magnitude[k] / np.sqrt(2.0)
    j = k + step
    while 0 <= j < magnitude.size and np.isfinite(magnitude[j]):
        if magnitude[j] < level:
            return j - step * float((level - magnitude[j]) / (magnitude[j - step] - magnitude[j]))
        j += step
    return None


def _scatter(response: ComplexArray) -> Array:
    """Return the scatter around each line: a low percentile of the second differences of successive lines."""
    scatter, is_known = np.full(response.size, np.inf), np.isfinite(response)
    known = response[is_known]
    if known.size > 2:
        second = np.abs(np.diff(known, 2)) / np.sqrt(6.0)
        smooth = scipy.ndimage.percentile_filter(second, _SCATTER_PERCENTILE, _SCATTER_LINES, mode="nearest")
        scatter[is_known] = np.pad(smooth, 1, "edge")
    return scatter


def _is_prominent(bounded: Array, k: int, level: float) -> bool:
    """Return whether a curve falls below a level on both sides of a maximum before it rises above the maximum."""
    for side in (bounded[:k][::-1], bounded[k + 1 :]):
        higher = np.flatnonzero(side > bounded[k])
        part = side[: higher[0] if higher.size else side.size]
        if not (np.isfinite(part) & (part < level)).any():
            return False
    return True
