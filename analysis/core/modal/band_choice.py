"""Contribution of the choice of lines to the uncertainty of modes, for curves without stated uncertainty.

Errors of the curves act like additional poles, which depend on the choice of lines. Statistics of the residual do not
show their effect. The modes are therefore identified again without the lines at either end, and from every second line.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.modal.order_selection import half_width
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError

# Fraction of the band that a part omits at one of its ends.
_OMITTED_SHARE = 0.2
# A mode is not expected in a part if its distance from an end of the part is below this fraction of the part.
_MARGIN = 0.1
# Two modes have the same frequency if their distance is at most this multiple of the half-width, or of the spacing of
# the lines if this is larger.
_SAME_HALF_WIDTHS = 1.0
# The half of the lines (every second line) resolves a pole if its half-power width contains at least this number of
# these lines.
_MIN_RESOLVING_LINES = 2.0
# Ratio of the standard uncertainty to the root mean square of four differences. If only one difference is not zero, a
# ratio of 1 would give an expanded uncertainty equal to this difference; 1.2 adds a margin of 20 %.
_MEAN_SQUARE_RATIO = 1.2
# Minimum number of lines of a part.
_MIN_LINES = 16


class BandChoice(NamedTuple):
    """Variation of poles between parts of a band, each of shape (poles,)."""

    # Whether both parts without an end, and one of the halves if they resolve the pole, contain it. If both halves were
    # required, dense lines could reject a pole that every second line, whose halves do not resolve it, confirms.
    confirmed: NDArray[np.bool_]
    frequency_error: Array  # standard uncertainty, Hz
    damping_error: Array  # standard uncertainty


def parts_of_band(frequency: Array) -> Iterator[tuple[NDArray[np.intp], int]]:
    """Yield the lines of each part of a band, and the spacing of these lines, Hz; `frequency`: ascending, Hz."""
    low, high = frequency[0], frequency[-1]
    for lines, step in (
        (np.flatnonzero(frequency >= low + _OMITTED_SHARE * (high - low)), 1),
        (np.flatnonzero(frequency <= high - _OMITTED_SHARE * (high - low)), 1),
        (np.arange(0, frequency.size, 2), 2),
        (np.arange(1, frequency.size, 2), 2),
    ):
        if _MIN_LINES <= lines.size < frequency.size:
            yield lines, step


def band_choice(
    frequency: Array, poles: ComplexArray, identify: Callable[[NDArray[np.intp]], ComplexArray]
) -> BandChoice:
    """Compare the poles of a band with those identified from parts of the band, which `identify` returns.

    The standard uncertainty due to the choice of lines is 1.2 times the root mean square of the differences (type A).
    """
    natural, damping, width = abs(poles) / (2 * np.pi), -poles.real / abs(poles), half_width(poles)
    spacing = float(np.median(np.diff(frequency)))
    confirmed = np.ones(poles.size, dtype=bool)
    missing_in_halves = np.zeros(poles.size, dtype=int)
    differences: list[list[tuple[float, float]]] = [[] for _ in poles]
    for lines, step in parts_of_band(frequency):
        try:
            others = identify(lines)
        except RecordingError:
            others = np.zeros(0, dtype=complex)
        low, high = frequency[lines[0]], frequency[lines[-1]]
        margin = _MARGIN * (high - low)
        bandwidth_lines = 2.0 * width / (step * spacing)
        is_inside = (natural > low + margin) & (natural < high - margin)
        for k in np.flatnonzero(is_inside & ((step == 1) | (bandwidth_lines > 1.0))).tolist():
            # A pole of the part is assigned to the nearest pole only.
            own = others[abs(abs(others[:, None]) / (2 * np.pi) - natural).argmin(axis=1) == k]
            distance = abs(abs(own) / (2 * np.pi) - natural[k])
            if distance.min(initial=np.inf) < _SAME_HALF_WIDTHS * max(width[k], spacing):
                nearest = own[distance.argmin()]
                other_damping = -nearest.real / abs(nearest)
                differences[k].append((float(distance.min()), float(abs(other_damping - damping[k]))))
            elif step == 1:
                confirmed[k] = False
            elif bandwidth_lines[k] >= _MIN_RESOLVING_LINES:
                missing_in_halves[k] += 1
    mean_squares = [np.mean(np.square(each), axis=0) if each else np.zeros(2) for each in differences]
    frequency_error, damping_error = _MEAN_SQUARE_RATIO * np.sqrt(np.reshape(mean_squares, (-1, 2)).T)
    return BandChoice(confirmed & (missing_in_halves < 2), frequency_error, damping_error)
