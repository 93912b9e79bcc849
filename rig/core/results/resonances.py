"""Resonance peaks of a response, refined between its lines, with the number of lines that resolve them."""

from dataclasses import dataclass

import numpy as np

from rig.core.base.arrays import Array
from rig.core.results.interpolation import interpolate_curve
from rig.core.results.response import Response
from rig.core.results.uncertainty import UncertaintyBudget

# Number of frequencies between two lines at which a peak is sought, in each of two passes: to 1/3600 of the distance.
_STEPS = 60
# Smallest depth of the minima on both sides of a peak, relative to it; smaller ripples are not resonances.
_MIN_DEPTH = 0.05
# Relative rounding error of an interpolated value.
_ROUNDING = 1e-6
# Number of lines on either side of a peak within which its half-power width is measured; others belong to other modes.
_FLANK_LINES = 4
#: Minimum number of lines within the half-power width of a resolved peak.
MIN_LINES = 3
# The recommended number of lines within the half-power width.
_RECOMMENDED_LINES = 4.0


@dataclass(frozen=True)
class Resonance:
    """A resonance peak of a curve, by local rational interpolation."""

    line: int  # index of the highest line, in the order of the curve
    frequency: float  # frequency of the peak [Hz]
    value: float  # magnitude at the peak, in the unit of the curve
    expanded: float  # expanded uncertainty of the value
    lines: int  # number of lines within the half-power width, at most `MIN_LINES` counted
    is_interpolated: bool  # whether the lines resolve the peak well enough for its interpolation
    needed_spacing: float  # spacing of lines that would resolve the peak [Hz]; infinite if the lines resolve it

    @property
    def is_resolved(self) -> bool:
        """Whether enough lines are within the half-power width, and determine the curve between them."""
        return self.lines >= MIN_LINES and bool(np.isinf(self.needed_spacing))


def find_resonances(frf: Response) -> list[Resonance]:
    """Locate and refine the local maxima of a curve that exceed the minima on both sides by more than noise."""
    order = np.argsort(frf.frequency, kind="stable")
    order = order[np.isfinite(frf.value[order])]
    ordered = frf.at(order)
    maxima = _significant_maxima(np.abs(ordered.value), np.nan_to_num(ordered.random_bound(), nan=np.inf))
    refined = [_refine(ordered, k) for k in maxima]
    return [Resonance(int(order[k]), *peak) for k, peak in zip(maxima, refined, strict=True) if peak is not None]


def _significant_maxima(magnitude: Array, noise: Array) -> list[int]:
    """Return the indices of interior local maxima that exceed the minima on both sides by more than the noise."""
    maxima = [k for k in range(1, magnitude.size - 1) if magnitude[k - 1] <= magnitude[k] > magnitude[k + 1]]
    significant = []
    for k in maxima:
        # The minimum on a side is sought up to the next point that is higher than the maximum.
        higher = np.flatnonzero(magnitude > magnitude[k])
        first = higher[higher < k].max(initial=-1) + 1
        stop = higher[higher > k].min(initial=magnitude.size)
        minima = first + int(np.argmin(magnitude[first : k + 1])), k + int(np.argmin(magnitude[k:stop]))
        if all((1.0 - _MIN_DEPTH) * magnitude[k] - magnitude[m] > noise[k] + noise[m] for m in minima):
            significant.append(k)
    return significant


def _refine(frf: Response, k: int) -> tuple[float, float, float, int, bool, float] | None:
    """Return the fields of a `Resonance` after `line`; None if the curve has too few lines."""
    f = frf.frequency
    low, high = max(k - _FLANK_LINES, 0), min(k + _FLANK_LINES, f.size - 1)
    grid = np.concatenate(
        [np.linspace(a, b, _STEPS, endpoint=False) for a, b in zip(f[low:high], f[low + 1 : high + 1], strict=True)]
    )
    coarse = interpolate_curve(f, frf.value, UncertaintyBudget(), grid)
    if coarse is None:
        return None
    magnitude = np.where((grid >= f[k - 1]) & (grid <= f[k + 1]), np.nan_to_num(abs(coarse.value)), 0.0)
    highest = int(np.argmax(magnitude))
    fine = np.linspace(grid[max(highest - 1, 0)], grid[min(highest + 1, grid.size - 1)], _STEPS)
    refined = interpolate_curve(f, frf.value, frf.uncertainty, fine)
    assert refined is not None
    top = int(np.argmax(np.nan_to_num(abs(refined.value))))
    value, frequency = float(abs(refined.value[top])), float(fine[top])
    below = abs(coarse.value) < value / np.sqrt(2.0)
    left = grid[:highest][below[:highest]].max(initial=-np.inf)
    right = grid[highest:][below[highest:]].min(initial=np.inf)
    is_below = np.abs(frf.value) < value / np.sqrt(2.0)
    outside = np.flatnonzero(is_below)
    lines = int(outside[outside > k].min(initial=f.size) - outside[outside < k].max(initial=-1)) - 1
    lines -= int(is_below[k])
    needed = float(refined.needed_spacing[top])
    # With degenerate data, a rational function may not pass through a line (unattainable point).
    is_interpolated = np.isinf(needed) and value >= (1.0 - _ROUNDING) * abs(frf.value[k])
    if not is_interpolated:
        frequency, value = float(f[k]), float(abs(frf.value[k]))
    if lines < MIN_LINES:
        needed = min(needed, (right - left) / _RECOMMENDED_LINES)
    expanded = float(np.broadcast_to(refined.uncertainty.expanded(), fine.shape)[top])
    return frequency, value, expanded, min(lines, MIN_LINES), bool(is_interpolated), float(needed)
