"""Peaks of a live response with their half-power damping: a quick view.

The interval of a damping ratio contains the scatter of H1 at the peak and at both half-power points, and the spacing of
the lines as the limit of error of the half-power width: the window widens a peak by less. The scatter of n averages is
var |H| = |H|² (1 - γ²) / (2 n γ²) (Bendat and Piersol, Random Data, 9.1).
"""

from typing import NamedTuple

import numpy as np
import scipy

from daq.extras.bench_page.live_frf import RELATIONS, LiveCurves
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.uncertainty import COVERAGE_FACTOR

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
# Through the half-power width of a resonance, the phase of each channel and of all channels together decreases by 90°;
# with less than this, a maximum is not a mode [rad]. Damper impacts cause other maxima: in the scene
# fig10b-three-dampers, the smaller of both decreases is at most 58° at these, and at least 134° at modes. In sweeps and
# random tests of fig8-three-dampers, it is at least 80° at modes.
_MIN_PHASE_DROP = np.radians(70.0)
# Peaks below this fraction of the highest are not listed: damper impacts leave ripple there, which all impacts repeat.
_SMALLEST_RATIO = 1e-3
# Peaks with a coherence below its limit must exceed this fraction of the highest: noise has many smaller ones.
_SMALLEST_UNCERTAIN_RATIO = 0.1
# Peaks belong to one resonance if their frequencies differ by less than this fraction; dampers split its peak. A tone
# at this distance has not passed the resonance, whose highest peak may still follow.
_SAME_PEAK = 0.08


class LivePeak(NamedTuple):
    """A peak of a live response."""

    frequency: float  # Hz
    value: float  # magnitude
    damping: float | None  # half-power damping ratio; None if the width is not resolved, clipped or incoherent
    expanded: float  # half of the 95 % interval of the damping ratio
    name: str = ""  # channel
    relation: str = ""  # one of `RELATIONS`


def largest_peaks(curves: LiveCurves, count: int, tone: float | None = None) -> list[LivePeak]:
    """Return the highest peaks, each of the channel with the highest peak; a single average has no peaks.

    Peaks near the present frequency of a moving `tone` [Hz] are omitted. A peak with a coherence below its limit has no
    damping.
    """
    candidates, limit, highest = [], curves.coherence_limit, np.nanmax(np.abs(curves.value), initial=0.0)
    for name, response, coherence, relation in zip(
        curves.names, curves.value, curves.coherence, curves.relation, strict=True
    ):
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.sqrt((1.0 - coherence) / (2.0 * curves.count * coherence))
        for peak in live_peaks(curves.frequency, response, error, curves.value):
            k = np.searchsorted(curves.frequency, peak.frequency)
            if coherence[k] < limit[k] and peak.value < _SMALLEST_UNCERTAIN_RATIO * highest:
                continue
            if np.isfinite(coherence[k]) and (tone is None or abs(peak.frequency / tone - 1.0) > _SAME_PEAK):
                if relation[k] or coherence[k] < limit[k] or not np.isfinite(peak.expanded):
                    peak = peak._replace(damping=None, expanded=0.0)
                candidates.append(peak._replace(name=name, relation=RELATIONS[relation[k]]))
    largest: list[LivePeak] = []
    for peak in sorted(candidates, key=lambda peak: -peak.value):
        if all(abs(peak.frequency / other.frequency - 1.0) > _SAME_PEAK for other in largest):
            largest.append(peak)
    return sorted(peak for peak in largest[:count] if peak.value > _SMALLEST_RATIO * largest[0].value)


def live_peaks(
    frequency: Array, response: ComplexArray, error: Array, responses: ComplexArray | None = None
) -> list[LivePeak]:
    """Return the peaks of a curve, which may have gaps (NaN); `error`: relative standard uncertainty of each line.

    A peak is listed if the phase of this curve and that of the `responses` of all channels (channels, lines; by default
    this curve) pass a resonance: the inner product from line to line weights each channel with its power. The damping
    ratio is the half-power width over twice the frequency (Ewins, Modal Testing, 4.2); None if the width is not
    resolved or not measured on both sides.

    >>> f = np.linspace(1.0, 20.0, 1901)
    >>> [peak] = live_peaks(f, 1.0 / (100.0 - f**2 + 2j * 0.01 * 10.0 * f), np.full(f.size, 0.01))
    >>> round(peak.frequency, 2), round(peak.value, 3), round(peak.damping, 4), round(peak.expanded, 4)
    (10.0, 0.5, 0.01, 0.0008)
    """
    peaks = []
    magnitude, scatter = np.abs(response), _scatter(response)
    curves = [response[None], response[None] if responses is None else responses]
    drops = np.array([np.angle(np.nansum(each[:, :-1] * each[:, 1:].conj(), axis=0)) for each in curves])
    bounded = np.where(np.isfinite(magnitude), magnitude, -np.inf)
    is_maximum = (bounded[1:-1] > bounded[:-2]) & (bounded[1:-1] >= bounded[2:])
    for k in (np.flatnonzero(is_maximum & np.isfinite(bounded[:-2]) & np.isfinite(bounded[2:])) + 1).tolist():
        left, right = _crossing(magnitude, k, -1), _crossing(magnitude, k, 1)
        if not _is_prominent(bounded, k, min(bounded[k] / _MIN_RATIO, bounded[k] - _MIN_SCATTERS * scatter[k])):
            continue
        if left is not None and right is not None:
            drop = drops[:, int(left) : int(np.ceil(right))].sum(axis=1).min()
            if drop < _MIN_PHASE_DROP:
                continue
        damping, expanded = None, 0.0
        if left is not None and right is not None and right - left >= _MIN_WIDTH_LINES:
            (low, high), spacing = np.interp([left, right], np.arange(frequency.size), frequency), np.diff(frequency)[k]
            damping = float((high - low) / (2.0 * frequency[k]))
            # Change of each half-power frequency per relative change of the magnitude there, or of the peak.
            flanks = [int(left), int(right)]
            shift = spacing * magnitude[k] / np.sqrt(2.0) / np.abs(np.diff(magnitude)[flanks])
            standard = np.hypot(np.linalg.norm(shift * error[flanks]), shift.sum() * error[k])
            standard = np.hypot(standard, spacing / np.sqrt(3.0))
            expanded = float(COVERAGE_FACTOR * standard / (2.0 * frequency[k]))
        peaks.append(LivePeak(float(frequency[k]), float(magnitude[k]), damping, expanded))
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
