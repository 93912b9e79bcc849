"""Windows of lines around peaks. Modes are identified in each window independently of the rest of the band."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from analysis.core.modal.line_choice import scatter
from rig.core.base.arrays import Array, ComplexArray

# Difference of the logarithms of magnitudes between a peak and its half-power points.
_HALF_POWER = 0.5 * float(np.log(2.0))
# A peak exceeds its surroundings by at least this difference of logarithms.
_MIN_PROMINENCE = 0.5 * _HALF_POWER
# A peak exceeds the scatter of its lines by at least this factor in a curve, more than noise does by chance.
_MIN_SIGNAL_RATIO = 6.0
# Number of neighboring lines whose largest scatter is used: the estimate at one line is itself uncertain.
_NOISE_LINES = 31
# Distance of the ends of a window from its peaks, in half-widths of the peaks.
_WINDOW_HALF_WIDTHS = 6.0
# Smallest such distance, in lines.
_MIN_WINDOW_LINES = 20
# Neighboring peaks belong to the same group if their distance is at most this multiple of the smaller half-width.
# Residual terms represent the side of a wide peak in the window of a narrow peak.
_GROUP_HALF_WIDTHS = 6.0


class Window(NamedTuple):
    """A window of lines around a group of peaks; the modes between the valleys on either side belong to the group."""

    first: int  # first line
    stop: int  # line after the last
    low: float  # Hz, valley below the group, or 0
    high: float  # Hz, valley above the group, or infinity


def peak_windows(frequency: Array, values: Sequence[ComplexArray]) -> list[Window]:
    """Return the windows around the peaks of curves at equal frequencies [Hz] in ascending order."""
    # Peaks of the mean logarithm do not depend on the units, as peaks of a mean magnitude would.
    magnitude = np.abs(np.nan_to_num(np.stack(values))) * frequency**2
    log_magnitude = np.log(np.maximum(magnitude, 1e-12 * magnitude.max(axis=1, keepdims=True))).mean(axis=0)
    peaks, properties = scipy.signal.find_peaks(log_magnitude, prominence=_MIN_PROMINENCE)
    # Lines next to a limit of a noisy range have the scatter of the other side of the limit.
    noise = scipy.ndimage.maximum_filter1d(
        [scatter(np.nan_to_num(value) * frequency**2) for value in values], _NOISE_LINES, axis=1
    )
    ratio = np.max(magnitude[:, peaks] / np.maximum(noise[:, peaks], 1e-300), axis=0, initial=0.0)
    # Peaks of noise are prominent, too, but do not exceed the scatter of their lines by this factor.
    chosen = ratio > _MIN_SIGNAL_RATIO
    peaks, drops = peaks[chosen], np.minimum(0.9 * properties["prominences"][chosen], _HALF_POWER)
    if not peaks.size:
        return [Window(0, frequency.size, 0.0, np.inf)]
    half_widths = np.array(
        [_half_width(frequency, log_magnitude, int(peak), float(drop)) for peak, drop in zip(peaks, drops, strict=True)]
    )
    reach = _GROUP_HALF_WIDTHS * np.minimum(half_widths[1:], half_widths[:-1])
    splits = np.flatnonzero(np.diff(frequency[peaks]) > reach) + 1
    groups = np.split(np.arange(peaks.size), splits)
    valleys = [int(peaks[i] + np.argmin(log_magnitude[peaks[i] : peaks[i + 1]])) for i in splits - 1]
    spans = []
    for group in groups:
        distance = _WINDOW_HALF_WIDTHS * half_widths[group]
        first = int(np.searchsorted(frequency, np.min(frequency[peaks[group]] - distance)))
        stop = int(np.searchsorted(frequency, np.max(frequency[peaks[group]] + distance), side="right"))
        first = max(min(first, int(peaks[group[0]]) - _MIN_WINDOW_LINES), 0)
        stop = min(max(stop, int(peaks[group[-1]]) + _MIN_WINDOW_LINES + 1), frequency.size)
        spans.append((first, stop))
    # Where windows overlap, the lines of both contain the limit between their modes.
    limits = [
        float(frequency[int(np.clip(valley, min(first, stop), max(first, stop) - 1))])
        for valley, (first, _), (_, stop) in zip(valleys, spans[1:], spans, strict=False)
    ]
    return [Window(*span, low, high) for span, low, high in zip(spans, [0.0, *limits], [*limits, np.inf], strict=True)]


def _half_width(frequency: Array, log_magnitude: Array, peak: int, drop: float) -> float:
    """Return half of the half-power width of a peak [Hz] from its steeper side, where the logarithm has fallen."""
    # The peak of another mode raises the curve on one side.
    below = log_magnitude < log_magnitude[peak] - drop
    distances = [
        abs(frequency[peak + int(np.argmax(below[peak::step])) * step] - frequency[peak])
        for step in (-1, 1)
        if below[peak::step].any()
    ]
    # The magnitude of a resonance falls with sqrt(1 + x²) at a distance of x half-widths.
    return float(min(distances, default=0.0) / np.sqrt(np.expm1(2.0 * drop)))
