"""Peaks of frequency responses in figures: which are marked, by which symbol, and where their labels are."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.commands.figures.determined_lines import (
    MAX_MARKED,
    MAX_POINTS,
    folds_back,
    has_scatter,
    is_determined,
    is_smooth,
)
from analysis.core.damper_motion.comparison import Peak, local_model, may_be_higher
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.figure_types import Axes
from rig.core.results.resonances import Resonance
from rig.core.results.response import MOTIONS, Response

# A peak between points is marked if it exceeds the highest point by this fraction.
_MIN_PEAK_EXCESS = 0.01
# A drawn curve contains a peak if it reaches this fraction of the peak's height; the difference is not visible.
_CONTAINING_RATIO = 0.99
# A peak at a line with a smaller coherence is a peak of the noise, and is not marked.
_MIN_PEAK_COHERENCE = 0.9
# In a spectrum, peaks at its lines are labeled from this fraction of the highest peak on; lower peaks may be noise.
_MIN_LABELED = 0.1
# A peak is marked if it is the highest point within this relative distance in frequency, so labels do not overlap; only
# the highest of the arrows of all curves within it is drawn.
_PEAK_RANGE = 0.05
#: Largest relative difference of the frequencies of one mode in two recordings: dampers shift the frequencies.
MODE_SHIFT = 0.15
#: Symbols of marked peaks, with their explanation.
PEAK_SYMBOLS = {
    "circles": "Circles: peaks of the local model.",
    "diamonds": "Diamonds: peaks of the local model, may be higher.",
    "arrows": "Arrows: may be higher.",
}
# Width of the label of a peak, relative to the axes.
_LABEL_WIDTH = 0.06
# Space above a marked value for its labels, and for an arrow with its labels, relative to the height of the axes.
_LABEL_SPACE, _ARROW_SPACE = 0.1, 0.18
_MARKERS = {"circles": "o", "diamonds": "D"}
# Least digits of the frequency of a measured point, which is known; its rounding must not be nearer to the next point.
_POINT_DIGITS = 3
# An arrow begins above all curves within this relative distance in frequency, which is the half of its width.
_ARROW_RANGE = 0.01
# Height of the label of a peak, and its distance from a label beside it [points].
_LABEL_POINTS = 9.0
_LABEL_SHIFT = 22.0


class PeakMark(NamedTuple):
    """A marked peak of a curve."""

    symbol: str  # key of `PEAK_SYMBOLS`, or "points" at a point that needs no symbol
    frequency: float  # Hz
    height: float  # in the SI unit of the curve
    peak: Peak
    is_steady: bool = True  # whether the highest point is in steady state
    expanded: float = 0.0  # half of the 95 % interval of the height at which an arrow begins

    @property
    def label(self) -> str:
        """Frequency with the digits of the interval of the peak; that of a measured point with three digits or more."""
        return self.peak.label(self.frequency, 0 if self.symbol in _MARKERS else _POINT_DIGITS)

    @property
    def top(self) -> float:
        """Upper end of the interval of the height."""
        return self.height + self.expanded


def peak_marks(frf: Response, resonances: Iterable[tuple[Resonance, Peak]]) -> list[PeakMark]:
    """Return the peaks of a curve with their symbols: between its points, and those that may be higher than its points.

    Peaks in a rough range, and at an end of the band, are not marked. `resonances`: from `resonance_peaks`.
    """
    if frf.resolution > 0.0 or frf.reference != "force" or folds_back(frf.frequency):
        return []
    ordered, smooth, is_known = np.sort(frf.frequency), frf.frequency[is_smooth(frf)], is_determined(frf)
    expanded = frf.expanded()
    marks: list[PeakMark] = []
    for resonance, peak in resonances:
        line = resonance.line
        if peak.at_end or frf.frequency[line] not in smooth or not is_known[line]:
            continue
        point, line_frequency = float(abs(frf.value[line])), float(frf.frequency[line])
        is_steady = frf.unsteady is None or not frf.unsteady[line]
        if not peak.is_determined:
            upper = float(np.nan_to_num(expanded[line], posinf=0.0))
            marks.append(PeakMark("arrows", line_frequency, point, peak, is_steady, upper))
            continue
        height = peak.value * (2.0 * np.pi * peak.frequency) ** MOTIONS.index(frf.motion)
        is_near = abs(np.searchsorted(ordered, peak.frequency) - np.searchsorted(ordered, line_frequency)) <= 1
        is_noise = has_scatter(frf) and frf.coherence[line] < _MIN_PEAK_COHERENCE
        # A peak is not marked if a point near it is higher, as next to a jump or in a scattered range.
        is_around = abs(frf.frequency / line_frequency - 1.0) < _PEAK_RANGE
        is_around[max(line - 2, 0) : line + 3] = True
        is_highest = max(height, point) >= np.nanmax(abs(frf.value[is_around]))
        if is_noise or not is_highest:
            continue
        is_resolved = not may_be_higher(resonance, peak)
        if is_resolved and not (is_near and height > (1.0 + _MIN_PEAK_EXCESS) * point):
            marks.append(PeakMark("points", line_frequency, point, peak, is_steady))
        else:
            marks.append(PeakMark("circles" if is_resolved else "diamonds", peak.frequency, height, peak, is_steady))
    return marks


def without_hidden_arrows(marked: Sequence[Sequence[PeakMark]]) -> list[list[PeakMark]]:
    """Remove the arrows next to a higher marked peak of another curve."""
    marks = [mark for of_curve in marked for mark in of_curve]

    def is_highest(mark: PeakMark) -> bool:
        return all(
            other.height <= mark.height or abs(other.frequency / mark.frequency - 1.0) > _PEAK_RANGE for other in marks
        )

    return [[mark for mark in of_curve if mark.symbol != "arrows" or is_highest(mark)] for of_curve in marked]


def above_curves(marks: Iterable[PeakMark], frfs: Iterable[Response]) -> list[PeakMark]:
    """Let arrows begin above the points of all curves, so that none is taken for the point of another curve."""
    points = [(frf.frequency, abs(frf.value)) for frf in frfs]

    def raised(mark: PeakMark) -> PeakMark:
        near = [value[abs(frequency / mark.frequency - 1.0) < _ARROW_RANGE] for frequency, value in points]
        highest = float(np.nanmax(np.concatenate(near), initial=mark.top))
        return mark._replace(expanded=highest - mark.height)

    return [raised(mark) if mark.symbol == "arrows" else mark for mark in marks]


def draw_marks(marks: Iterable[PeakMark], factor: float, color: str, axes: Axes) -> list[tuple[float, float]]:
    """Draw the marks of a curve; return their heights in the unit of the axis, with the space above them."""
    heights = []
    for mark in marks:
        frequency, top = mark.frequency, factor * mark.top
        heights.append((top, _ARROW_SPACE if mark.symbol == "arrows" else _LABEL_SPACE))
        if mark.symbol in _MARKERS:
            style: dict[str, Any] = {"mfc": "white", "mec": color, "mew": 1.0, "ms": 4.5, "zorder": 5}
            axes.plot(frequency, top, _MARKERS[mark.symbol], **style)
        elif mark.symbol == "arrows":
            axes.annotate(
                "", (frequency, top), xytext=(0, 20), textcoords="offset points",
                arrowprops={"arrowstyle": "<-", "color": color, "lw": 1.0, "shrinkB": 4}, zorder=5,
            )  # fmt: skip
    return heights


def label_peaks(marks: Sequence[tuple[PeakMark, str]], frf: Response, axes: Axes) -> bool:
    """Write the frequencies of peaks beside their marks, or beside a higher label; return whether points have rings.

    `frf`: one of the curves.
    """
    # Of several curves with the same color, the highest is labeled.
    from matplotlib.patheffects import withStroke
    from matplotlib.transforms import ScaledTranslation

    factor, to_axes = frf.shown_in[1], axes.transData + axes.transAxes.inverted()
    # Position, peak, colors of the labels, and sides of the labels beside that of the peak.
    groups: list[tuple[float, PeakMark, list[str], list[float]]] = []
    taken: list[tuple[float, float]] = []
    has_rings = False
    highest_peak = max((mark.height for mark, _ in marks), default=0.0)
    for mark, color in sorted(marks, key=lambda pair: (pair[0].symbol == "points", -pair[0].height)):
        point = mark.frequency, factor * mark.top
        near = [group for group in groups if abs(to_axes.transform(point)[0] - group[0]) <= _LABEL_WIDTH]
        is_close = bool(near)
        if mark.symbol == "points":
            near += [group for group in groups if abs(mark.frequency / group[1].frequency - 1.0) < MODE_SHIFT]
            if not near and frf.frequency.size > MAX_POINTS and mark.height < _MIN_LABELED * highest_peak:
                # In a spectrum it may be noise; it is labeled near a marked peak, for comparison.
                continue
        if not near:
            groups.append((to_axes.transform(point)[0], mark, [], []))
            near = groups[-1:]
        _, highest, labeled, beside = near[0]
        base = 22 if mark.symbol == "arrows" else 5
        # A label below an arrow would be far from its end.
        possible = (1.0, -1.0) if labeled and mark.symbol != "arrows" else (1.0,)
        sides = [side for side in possible if _is_free(axes, point, side, taken, base - 5)]
        is_same = abs(mark.frequency / highest.frequency - 1.0) < MODE_SHIFT
        if color in labeled or not is_same or not (sides or is_close or mark is highest):
            continue
        vertical: dict[str, Any] = {"va": "bottom"} if not sides or sides[0] > 0.0 else {"va": "top"}
        offset = (0.0, base if vertical["va"] == "bottom" else -base)
        style: dict[str, Any] = {"xytext": offset, "textcoords": "offset points", "ha": "center", **vertical}
        if not sides and mark is not highest:
            direction = 1.0 if mark.frequency >= highest.frequency else -1.0
            up = (22 if highest.symbol == "arrows" else 5) + _LABEL_POINTS * beside.count(direction)
            shift = ScaledTranslation(direction * _LABEL_SHIFT / 72.0, up / 72.0, axes.figure.dpi_scale_trans)
            style = {"xytext": (highest.frequency, factor * highest.top), "textcoords": axes.transData + shift}
            style |= {"ha": "left" if direction > 0.0 else "right", "va": "bottom"}
            style["arrowprops"] = {"arrowstyle": "-", "color": color, "lw": 0.6, "shrinkA": 0, "shrinkB": 3}
            beside.append(direction)
        elif not sides:
            # The label of the highest peak is next to a curve that is above it.
            style |= {"ha": "right", "xytext": (-3.0, offset[1])}
        text = mark.label if mark.is_steady else f"({mark.label})"
        axes.annotate(
            text, point, fontsize=7.5, color=color, zorder=5,
            path_effects=[withStroke(linewidth=2.0, foreground="white")], **style,
        )  # fmt: skip
        if mark.symbol == "points":
            axes.plot(*point, "o", mfc="none", mec=color, ms=6.5, mew=0.8, zorder=5)
            has_rings = True
        x, y = axes.transData.transform(point)
        side = 1.0 if vertical["va"] == "bottom" else -1.0
        taken.append((x, y + side * (base - 5 + _LABEL_POINTS) * axes.figure.dpi / 72.0))
        labeled.append(color)
    return has_rings


def _is_free(
    axes: Axes, point: tuple[float, float], side: float, taken: Iterable[tuple[float, float]], distance: float = 0.0
) -> bool:
    """Return whether a label above (`side` 1) or below (-1) a point hides no curve and no label at `taken` [pixels].

    `distance` of the label from its usual place [points].
    """
    x, y = axes.transData.transform(point)
    y += side * distance * axes.figure.dpi / 72.0
    width, height = _LABEL_WIDTH * axes.bbox.width, 2.0 * _LABEL_POINTS * axes.figure.dpi / 72.0
    if any(abs(x - at) < width and abs(y + 0.5 * side * height - level) < 0.6 * height for at, level in taken):
        return False
    inside = x + np.linspace(-0.5, 0.5, 101) * width
    for line in axes.get_lines():
        drawn = axes.transData.transform(line.get_xydata())
        drawn = drawn[np.isfinite(drawn).all(axis=1)]
        if drawn.shape[0] > 1 and line.get_transform() == axes.transData:
            horizontal, vertical = drawn[np.argsort(drawn[:, 0])].T
            level = side * (np.interp(inside, horizontal, vertical, left=np.nan, right=np.nan) - y)
            if ((level > 0.25 * height) & (level < height)).any():
                return False
    return True


class DrawnResponse(NamedTuple):
    """What figures and charts draw of a response: its lines, and the thin curve through the determined lines."""

    lines: Response  # in ascending order, NaN at omitted frequencies
    is_known: NDArray[np.bool_]  # determined lines
    has_phase: NDArray[np.bool_]  # lines with a determined phase
    frequency: Array  # of the curve [Hz]
    value: ComplexArray  # of the curve; NaN where lines do not resolve it or determine no phase
    magnitude_frequency: Array  # as `frequency`, with further points around the marked peaks, which the curve reaches
    magnitude: Array


def drawn_response(frf: Response, marks: Iterable[PeakMark] = ()) -> DrawnResponse:
    """Return what is drawn of a response with marked peaks."""
    lines = frf.with_gaps()
    is_known = is_determined(lines)
    has_phase = is_known & is_smooth(lines)
    frequency, value = lines.continued(is_known)
    for mark in marks:
        if mark.symbol == "arrows":
            # Between the points next to a peak that may be higher, the model is a guess.
            k = int(np.searchsorted(lines.frequency, mark.frequency))
            low, high = lines.frequency[[max(k - 1, 0), min(k + 1, lines.frequency.size - 1)]]
            value[(frequency > low) & (frequency < high) & (frequency != mark.frequency)] = np.nan
    if lines.frequency.size > MAX_MARKED:
        # Lines close together are also joined where noise prevents interpolation.
        is_joined = np.isfinite(value) | np.isin(frequency, lines.frequency)
        frequency, value = frequency[is_joined], value[is_joined]
    magnitude = _with_local_models(frf, marks, frequency, np.abs(value))
    is_shown = has_phase[np.searchsorted(lines.frequency, frequency).clip(0, has_phase.size - 1)]
    return DrawnResponse(lines, is_known, has_phase, frequency, np.where(is_shown, value, np.nan), *magnitude)


def _with_local_models(
    frf: Response, marks: Iterable[PeakMark], frequency: Array, magnitude: Array
) -> tuple[Array, Array]:
    """Replace a drawn curve (Hz, unit of `frf`) around each peak that it does not reach by the peak's local model."""
    for mark in marks:
        if mark.symbol not in _MARKERS:
            continue
        at, height = local_model(frf, mark.peak)
        height = height * (2.0 * np.pi * at) ** MOTIONS.index(frf.motion)
        is_near = (frequency >= at[0]) & (frequency <= at[-1])
        if np.nanmax(magnitude[is_near], initial=0.0) < _CONTAINING_RATIO * height.max():
            position = np.searchsorted(frequency, at[0])
            frequency, magnitude = (
                np.insert(column[~is_near], position, model) for column, model in ((frequency, at), (magnitude, height))
            )
    return frequency, magnitude
