"""Contribution of the choice of band and lines to the uncertainty of modes, for curves that state no errors.

Statistics of the residual cannot show what an error of the curves does, because its poles depend on the band. The modes
are therefore identified again in parts of the band, and from parts of the lines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.modal.order_selection import half_width
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError

# Either limit of the band is moved inwards by this fraction.
_SHARE_OF_LIMIT = 0.2
# A mode closer to a limit than this fraction of its frequency may be missing in a part of the band.
_MARGIN = 0.03
# A mode has the same frequency as another up to this multiple of its half-width.
_SAME_HALF_WIDTHS = 1.0
# A mode that fewer parts of the band contain than this share of them is computational.
_MIN_SHARE_OF_PARTS = 0.4
# Ratio of a standard deviation to the median of absolute normal deviates.
_MEDIAN_RATIO = 1.4826
# Fewer lines are too few for modes.
_MIN_LINES = 16


class BandChoice(NamedTuple):
    """Variation of poles between parts of a band, each of shape (poles,)."""

    confirmed: NDArray[np.bool_]  # whether enough parts contain the pole
    frequency_error: Array  # standard uncertainty, Hz
    damping_error: Array  # standard uncertainty


def parts_of_band(frequency: Array) -> Iterator[tuple[NDArray[np.intp], int]]:
    """Yield the lines of each part of a band, and the distance of its lines; `frequency`: ascending, Hz."""
    low, high = frequency[0], frequency[-1]
    for lines, step in (
        (np.flatnonzero(frequency >= (1.0 + _SHARE_OF_LIMIT) * low), 1),
        (np.flatnonzero(frequency <= (1.0 - _SHARE_OF_LIMIT) * high), 1),
        (np.arange(0, frequency.size, 2), 2),
        (np.arange(1, frequency.size, 2), 2),
    ):
        if _MIN_LINES <= lines.size < frequency.size:
            yield lines, step


def band_choice(
    frequency: Array, poles: ComplexArray, identify: Callable[[NDArray[np.intp]], ComplexArray]
) -> BandChoice:
    """Compare poles with those that `identify` finds in parts of the band; `identify` takes the lines of a part.

    The standard uncertainty by the choice is 1.48 times the median of the differences (type A): a part in which two
    modes are merged, or one is split, does not determine it.
    """
    natural, damping, width = abs(poles) / (2 * np.pi), -poles.real / abs(poles), half_width(poles)
    spacing = float(np.median(np.diff(frequency)))
    expected = np.zeros(poles.size)
    differences: list[list[tuple[float, float]]] = [[] for _ in poles]
    for lines, step in parts_of_band(frequency):
        try:
            others = identify(lines)
        except RecordingError:
            others = np.zeros(0, dtype=complex)
        low, high = frequency[lines[0]], frequency[lines[-1]]
        should = (natural > (1.0 + _MARGIN) * low) & (natural < (1.0 - _MARGIN) * high)
        if step > 1:
            should &= 2.0 * width > step * spacing
        expected += should
        for k in np.flatnonzero(should).tolist():
            distance = abs(abs(others) / (2 * np.pi) - natural[k])
            nearest = int(np.argmin(distance)) if others.size else -1
            if nearest >= 0 and distance[nearest] < _SAME_HALF_WIDTHS * width[k]:
                other_damping = -others[nearest].real / abs(others[nearest])
                differences[k].append((float(distance[nearest]), float(abs(other_damping - damping[k]))))
    found = np.array([len(each) for each in differences])
    frequency_error, damping_error = (
        _MEDIAN_RATIO
        * np.array([np.median(each, axis=0) if each else (0.0, 0.0) for each in differences]).reshape(-1, 2).T
    )
    return BandChoice(found >= _MIN_SHARE_OF_PARTS * expected, frequency_error, damping_error)
