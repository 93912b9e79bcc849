"""Effect of the choice of lines: confirmation of poles by parts of the lines, and a contribution to the uncertainty.

Errors of curves without stated uncertainty act like additional poles, which depend on the choice of lines. Statistics
of the residual do not show their effect. The modes are therefore identified again without the lines at either end, and
from the even and the odd lines alone. A pole that one of these parts lacks may represent an error of the curves, such
as a spike of a single line.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.modal_models.order_selection import half_width
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError

# Fraction of the band that a part omits at one of its ends.
_OMITTED_SHARE = 0.2
# Smallest distance of an expected mode from an end of a part of a window, relative to the part.
_MARGIN = 0.1
# Ratio of the standard uncertainty to the root mean square of four differences. If only one difference is not zero, a
# ratio of 1 would give an expanded uncertainty equal to this difference; 1.2 adds a margin of 20 %.
_MEAN_SQUARE_RATIO = 1.2
# Minimum number of lines of a part.
_MIN_LINES = 16


class Part(NamedTuple):
    """Poles that a part of the lines contains."""

    name: str
    poles: ComplexArray  # rad/s
    low: float  # Hz: poles are expected from here
    high: float  # Hz: to here
    spacing: float  # Hz, of the lines


class BandChoice(NamedTuple):
    """Variation of poles between parts of the lines."""

    missing: tuple[tuple[str, ...], ...]  # names of the parts that lack each pole
    frequency_std: Array  # standard uncertainty [Hz], shape (poles,)
    damping_std: Array  # standard uncertainty, shape (poles,)


def end_parts(frequency: Array, identify: Callable[[NDArray[np.intp]], ComplexArray]) -> Iterator[Part]:
    """Yield the lines of a window without the lowest fifth, and without the highest fifth.

    `frequency`: ascending [Hz]; `identify`: returns the poles of some lines [rad/s]. Modes next to an end of a part are
    not expected there.
    """
    low, high = frequency[0], frequency[-1]
    omitted, margin = _OMITTED_SHARE * (high - low), _MARGIN * (1.0 - _OMITTED_SHARE) * (high - low)
    for name, first, last in (
        ("without the lowest fifth of its window", low + omitted, high),
        ("without the highest fifth of its window", low, high - omitted),
    ):
        lines = np.flatnonzero((frequency >= first) & (frequency <= last))
        if lines.size >= _MIN_LINES:
            yield Part(name, _poles(identify, lines), first + margin, last - margin, _spacing(frequency))


def half_parts(frequency: Array, identify: Callable[[NDArray[np.intp]], ComplexArray]) -> Iterator[Part]:
    """Yield the even lines and the odd lines of a band; arguments as in `end_parts`."""
    for name, first in (("from the even lines", 0), ("from the odd lines", 1)):
        lines = np.arange(first, frequency.size, 2)
        if lines.size >= _MIN_LINES:
            yield Part(name, _poles(identify, lines), frequency[0], frequency[-1], 2.0 * _spacing(frequency))


def _spacing(frequency: Array) -> float:
    return float(np.median(np.diff(frequency)))


def _poles(identify: Callable[[NDArray[np.intp]], ComplexArray], lines: NDArray[np.intp]) -> ComplexArray:
    try:
        return identify(lines)
    except RecordingError:
        return np.zeros(0, dtype=complex)


def band_choice(poles: ComplexArray, parts: Sequence[Part]) -> BandChoice:
    """Compare poles [rad/s] with those of parts of their lines; their scatter is an uncertainty of type A."""
    # The standard uncertainty is 1.2 times the root mean square of the differences.
    natural, damping, width = abs(poles) / (2 * np.pi), -poles.real / abs(poles), half_width(poles)
    missing: list[list[str]] = [[] for _ in poles]
    differences: list[list[tuple[float, float]]] = [[] for _ in poles]
    for part in parts:
        for k in np.flatnonzero((natural > part.low) & (natural < part.high)).tolist():
            # A pole of the part is assigned to the nearest pole only.
            own = part.poles[abs(abs(part.poles[:, None]) / (2 * np.pi) - natural).argmin(axis=1) == k]
            distance = abs(abs(own) / (2 * np.pi) - natural[k])
            # Poles are the same up to a half-width, or up to the spacing of the lines if this is larger.
            if distance.min(initial=np.inf) < max(width[k], part.spacing):
                nearest = own[distance.argmin()]
                other_damping = -nearest.real / abs(nearest)
                differences[k].append((float(distance.min()), float(abs(other_damping - damping[k]))))
            else:
                missing[k].append(part.name)
    mean_squares = [np.mean(np.square(each), axis=0) if each else np.zeros(2) for each in differences]
    frequency_std, damping_std = _MEAN_SQUARE_RATIO * np.sqrt(np.reshape(mean_squares, (-1, 2)).T)
    return BandChoice(tuple(map(tuple, missing)), frequency_std, damping_std)
