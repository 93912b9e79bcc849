"""Selection of lines of a frequency response for drawing: above noise and uncertainty, with a smooth phase."""

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.results.response import Response

# Number of points over which the median roughness of a curve is computed: enough that one resonance does not determine
# it.
_ROUGHNESS_POINTS = 25
# A point with a smaller coherence is drawn as noise: more than half of its power does not depend on the force.
_MIN_COHERENCE = 0.5
#: Largest standard uncertainty of a point, relative to its magnitude: beyond it, the 95 % interval includes zero.
MAX_ERROR_RATIO = 0.5
# A point of a curve without stated uncertainty is drawn as noise if its roughness exceeds this fraction of its
# magnitude.
_MAX_ROUGHNESS = 0.35
# Largest upper quartile of the phase steps between drawn points [rad]: beyond it, the line would show noise.
_MAX_PHASE_STEP = 0.3
# A line is undetermined if less than this fraction of the lines around it is determined.
_MIN_DETERMINED = 0.75
# A gap of fewer undetermined lines does not end a determined range; it is an antiresonance.
_ANTIRESONANCE_LINES = 5
#: Strips that mark undetermined lines are joined if at most this part of the lines, 1/100, lies between them: many
#: short strips distract.
LINES_PER_GAP = 100
#: Curves with more spectral lines than this are drawn continuous, with some of their points: symbols would touch.
MAX_MARKED = 160
#: Curves with more spectral lines than this are drawn without points, which would hide each other.
MAX_POINTS = 600


def determined_band(frfs: Sequence[Response]) -> tuple[float, float]:
    """Return the band of curves [Hz]; for spectra with many lines, only of their determined ranges."""
    columns = [column for frf in frfs for column in (frf.frequency, frf.omitted)]
    lines = [frf.frequency[is_determined(frf)] for frf in frfs if frf.frequency.size > MAX_POINTS]
    if len(lines) == len(frfs) and any(line.size for line in lines):
        columns = lines
    frequencies = np.concatenate(columns)
    return float(frequencies.min()), float(frequencies.max())


def is_determined(frf: Response) -> NDArray[np.bool_]:
    """Return whether each point exceeds its noise and its expanded uncertainty.

    Isolated points are excluded, because noise exceeds both by chance.
    """
    is_measured = np.isfinite(frf.value)
    if not is_measured.all() and is_measured.any():
        # Gaps have no uncertainty, and must not affect the lines around them.
        is_measured[is_measured] = is_determined(frf.at(is_measured))
        return is_measured
    known = exceeds_noise(frf) & ~(frf.expanded() >= abs(frf.value))
    if known.size < _ROUGHNESS_POINTS:
        return known
    known &= scipy.ndimage.median_filter(known, 3, mode="nearest")
    if known.size <= MAX_POINTS:
        return known
    # A few lines between gaps exceed the noise by chance. A gap of few lines is an antiresonance.
    nearby = scipy.ndimage.uniform_filter1d(known.astype(float), 2 * _ROUGHNESS_POINTS + 1, mode="reflect")
    without_gaps = scipy.ndimage.binary_closing(known, np.ones(_ANTIRESONANCE_LINES)) | known
    is_long = scipy.ndimage.binary_opening(without_gaps & (nearby >= _MIN_DETERMINED), np.ones(2 * _ROUGHNESS_POINTS))
    return np.asarray(known & is_long)


def is_smooth(frf: Response) -> NDArray[np.bool_]:
    """Return whether the phase of an ordered curve changes little from point to point, apart from single steps."""
    if frf.frequency.size < 2 * _ROUGHNESS_POINTS:
        return np.ones(frf.frequency.size, dtype=bool)
    with np.errstate(invalid="ignore"):
        step = np.nan_to_num(abs(np.angle(frf.value[1:] * frf.value[:-1].conj())))
    step = np.append(step, step[-1])
    smooth = scipy.ndimage.percentile_filter(step, 75, 2 * _ROUGHNESS_POINTS, mode="nearest") < _MAX_PHASE_STEP
    if smooth.size <= MAX_POINTS:
        return np.asarray(smooth)
    # A few successive lines of noise have a smooth phase by chance.
    return np.asarray(scipy.ndimage.binary_opening(smooth, np.ones(2 * _ROUGHNESS_POINTS)))


def exceeds_noise(frf: Response) -> NDArray[np.bool_]:
    """Return whether each point exceeds its noise, so its phase is determined.

    The criterion is the standard uncertainty and the coherence if the curve has both, otherwise the roughness of the
    curve from point to point.
    """
    magnitude = np.maximum(abs(frf.value), 1e-300)
    if np.isfinite(frf.error).all():
        return np.asarray((frf.error < MAX_ERROR_RATIO * magnitude) & ~(frf.coherence <= _MIN_COHERENCE))
    if magnitude.size < 2 * _ROUGHNESS_POINTS:
        return np.ones(magnitude.size, dtype=bool)
    # The second difference of white noise has 1 + 4 + 1 = 6 times the variance of the noise.
    roughness = abs(np.diff(frf.value, 2, prepend=frf.value[0], append=frf.value[-1])) / np.sqrt(6.0)
    local_roughness = scipy.ndimage.median_filter(roughness / magnitude, _ROUGHNESS_POINTS, mode="nearest")
    return np.asarray(local_roughness < _MAX_ROUGHNESS)


def has_scatter(frf: Response) -> bool:
    """Return whether a curve has a type A uncertainty: from several averages, or stated in its file."""
    return bool(np.any((frf.degrees_of_freedom > 0) | (np.isfinite(frf.error) & (frf.error > 0))))


def folds_back(frequency: Array) -> bool:
    """Return whether the frequency of a sweep reverses, so there are several responses at one frequency."""
    steps = np.diff(frequency)
    return bool((steps > 0).any() and (steps < 0).any())
