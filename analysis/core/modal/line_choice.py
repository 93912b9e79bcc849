"""Selection of spectral lines for a modal fit, and estimation of their scatter if a file does not state it."""

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response

# Maximum number of lines that are all fitted; of more, the lines around peaks and about half this number evenly spaced.
MAX_LINES = 2000
# All lines around this number of the highest peaks are selected: twice the largest number of modes.
_MAX_PEAKS = 24
# Number of adjacent lines selected around each peak, and at equal distances between its ends.
_LINES_PER_PEAK = 41
# The sides of a peak end where the magnitude is this fraction of the peak.
_FLANK_RATIO = 0.1
# A peak exceeds the magnitude of its neighborhood by at least this factor.
_MIN_PEAK_RATIO = 2.0
# A frequency step is a gap if it is at least this multiple of the larger of the steps on either side.
_GAP_RATIO = 5.0
# The scatter is estimated over this number of lines.
_SCATTER_LINES = 31


def reduce_lines(curves: Sequence[Response]) -> list[Response]:
    """Remove most lines of `curves` (common, ascending frequencies) far from peaks, and within wide peaks."""
    count = curves[0].frequency.size
    if count <= MAX_LINES or any(curve.frequency.size != count for curve in curves):
        return list(curves)
    magnitudes = np.nan_to_num(np.stack([abs(curve.value) for curve in curves]))
    # Each curve is divided by its median, so all have equal weight.
    normalized = magnitudes / np.median(magnitudes, axis=1, keepdims=True).clip(1e-300)
    magnitude = np.sqrt(np.mean(normalized**2, axis=0))
    log_magnitude = np.log(np.maximum(magnitude, 1e-12 * magnitude.max()))
    peaks, _ = scipy.signal.find_peaks(log_magnitude, prominence=np.log(_MIN_PEAK_RATIO))
    highest = peaks[np.argsort(scipy.signal.peak_prominences(log_magnitude, peaks)[0])[::-1][:_MAX_PEAKS]]
    selected = np.zeros(count, dtype=bool)
    selected[:: -(-2 * count // MAX_LINES)] = True  # rounded up
    for peak in highest:
        below = np.flatnonzero(magnitude < _FLANK_RATIO * magnitude[peak])
        first = below[below < peak].max(initial=0)
        last = below[below > peak].min(initial=count - 1)
        selected[np.unique(np.linspace(first, last, _LINES_PER_PEAK).astype(int))] = True
        selected[max(peak - _LINES_PER_PEAK // 2, 0) : peak + _LINES_PER_PEAK // 2 + 1] = True
    return [curve.at(selected) for curve in curves]


def scatter(value: ComplexArray) -> Array:
    """Estimate the standard deviation of the real and of the imaginary part of each line from third differences.

    The median over many lines is insensitive to the few lines of a narrow peak.

    >>> random = np.random.default_rng(1)
    >>> noise = random.standard_normal(2000) + 1j * random.standard_normal(2000)
    >>> bool(abs(np.median(scatter(noise)) - 1.0) < 0.1)
    True
    """
    if value.size < 8:
        return np.full(value.size, 0.01 * float(np.nanmedian(abs(value))))
    filled = np.where(np.isfinite(value), value, 0.0)
    # Third differences of noise have 20 times its variance. The median of a Rayleigh distribution is 1.177.
    deviation = abs(np.convolve(filled, [1.0, -3.0, 3.0, -1.0], "same")) / np.sqrt(20.0) / 1.177
    deviation[:2], deviation[-2:] = deviation[2], deviation[-3]
    return np.asarray(scipy.ndimage.median_filter(deviation, min(_SCATTER_LINES, value.size), mode="nearest"))


def are_in_gaps(frequency: Array, poles: ComplexArray) -> NDArray[np.bool_]:
    """Return whether poles [rad/s] lie in gaps between lines and no line is within their half-power widths.

    The sides of a peak determine its pole only for an isolated mode and a complete model of all other modes.

    >>> lines = np.r_[10.0:12.0:0.1, 15.0:20.0:0.1]
    >>> are_in_gaps(lines, 2 * np.pi * np.array([-0.1 + 11.05j, -0.1 + 13.0j, -2.0 + 13.0j, -0.1 + 30.0j]))
    array([False,  True, False, False])
    """
    steps = np.diff(frequency)
    neighboring_steps = np.maximum(np.append(0.0, steps[:-1]), np.append(steps[1:], 0.0))
    natural: Array = np.asarray(abs(poles) / (2 * np.pi), dtype=float)
    above = np.searchsorted(frequency, natural)
    in_band = (above > 0) & (above < frequency.size)
    step = np.clip(above - 1, 0, steps.size - 1)
    nearest = np.minimum(abs(natural - frequency[step]), abs(frequency[step + 1] - natural))
    is_gap = steps[step] > _GAP_RATIO * neighboring_steps[step]
    return np.asarray(in_band & is_gap & (nearest > -poles.real / (2 * np.pi)))


def is_peak(magnitude: Array, line: int) -> bool:
    """Return whether the magnitude at a line is at least `_MIN_PEAK_RATIO` times the median of its neighborhood."""
    neighborhood = magnitude[max(line - _SCATTER_LINES // 2, 0) : line + _SCATTER_LINES // 2 + 1]
    return bool(magnitude[line] > _MIN_PEAK_RATIO * np.median(neighborhood))
