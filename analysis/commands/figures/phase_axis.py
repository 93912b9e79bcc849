"""Phases of responses on an axis of 360°: where they wrap, and the ticks."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from analysis.commands.figures.determined_lines import folds_back, is_determined, is_smooth
from analysis.commands.figures.peak_marks import DrawnResponse
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response

# Upper ends of the phase axis [degrees], the preferred first: compliances of a driven body are from 0° to -180°, also
# with scatter. A phase that rotates by 360° wraps beside a resonance, where it changes slowly, not at the resonance.
_PHASE_TOPS = (30.0, 120.0, 210.0)
# Margin of the phase axis, in which a phase that exceeds the end for a short time is not wrapped [degrees].
_WRAP_MARGIN = 15.0
# A piece of a phase curve with fewer points is not drawn: it looks like a stroke across the axis.
_MIN_FRAGMENT = 3


def break_at_wraps(frequency: Array, angle: Array, values: Array | None = None) -> tuple[Array, Array]:
    """Insert gaps (NaN) into a line where the phase wraps; `values`: values of the line, by default the angles."""
    with np.errstate(invalid="ignore"):
        wraps = np.flatnonzero(abs(np.diff(angle)) > 180.0) + 1
    between = (frequency[wraps - 1] + frequency[wraps]) / 2.0
    return np.insert(frequency, wraps, between), np.insert(angle if values is None else values, wraps, np.nan)


def phase_degrees(value: ComplexArray, top: float = _PHASE_TOPS[0]) -> Array:
    """Return the phase in degrees, from `top` - 360 to `top`.

    A piece of a curve between two wraps that stays within the margin of the axis is not wrapped. Undefined values (NaN)
    do not change the other phases.
    """
    phase = np.full(value.shape, np.nan)
    is_known = np.isfinite(value)
    angle = top - np.mod(top - np.degrees(np.angle(value[is_known])), 360.0)
    wraps = np.flatnonzero(abs(np.diff(angle)) > 180.0) + 1
    for start, stop in pairwise(wraps.tolist()):
        piece = angle[start:stop]
        if (abs(piece - top) < _WRAP_MARGIN).all():
            piece -= 360.0
        elif (abs(piece - top + 360.0) < _WRAP_MARGIN).all():
            piece += 360.0
    phase[is_known] = angle
    return phase


def drawn_phases(curve: DrawnResponse, top: float) -> tuple[Array, Array]:
    """Return the phases of a drawn curve and of its lines, wrapped at the same places; NaN where not determined."""
    frequency = np.concatenate([curve.frequency, curve.lines.frequency])
    value = np.concatenate([curve.value, np.where(curve.has_phase, curve.lines.value, np.nan)])
    order, angle = np.argsort(frequency, kind="stable"), np.empty(frequency.size)
    angle[order] = phase_degrees(value[order], top)
    line, points = np.split(angle, [curve.frequency.size])
    breaks = np.flatnonzero(~(abs(np.diff(line)) <= 180.0)) + 1
    for start, stop in pairwise([0, *breaks.tolist(), line.size]):
        if stop - start < _MIN_FRAGMENT:
            line[start:stop] = np.nan
    return line, points


def phase_ticks(top: float) -> list[float]:
    """Return the ticks of a phase axis with an upper end, degrees.

    >>> phase_ticks(30.0)
    [-270.0, -180.0, -90.0, 0.0]
    """
    return [90.0 * k for k in range(int(top // 90.0) - 3, int(top // 90.0) + 1)]


def phase_top(frfs: Sequence[Response]) -> float:
    """Return the upper end of the phase axis [degrees] at which the curves, except those that fold back, wrap least."""
    ordered = [frf.sorted() for frf in frfs if not folds_back(frf.frequency)]
    values = [frf.value[is_determined(frf) & is_smooth(frf)] for frf in ordered]

    def wraps(top: float) -> int:
        return sum(int(np.count_nonzero(abs(np.diff(phase_degrees(each, top))) > 180.0)) for each in values)

    return min(_PHASE_TOPS, key=wraps)
