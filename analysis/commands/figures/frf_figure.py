"""Figure of frequency responses: magnitude with its 95 % band, phase and coherence."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.commands.figures.determined_lines import (
    LINES_PER_GAP,
    MAX_ERROR_RATIO,
    MAX_MARKED,
    MAX_POINTS,
    determined_band,
    exceeds_noise,
    folds_back,
    has_scatter,
    is_determined,
    is_smooth,
)
from analysis.commands.figures.peak_marks import (
    PEAK_SYMBOLS,
    DrawnResponse,
    PeakMark,
    above_curves,
    draw_marks,
    drawn_response,
    label_peaks,
    peak_marks,
    without_hidden_arrows,
)
from analysis.commands.figures.phase_axis import break_at_wraps, drawn_phases, phase_degrees, phase_ticks, phase_top
from analysis.core.damper_motion.comparison import resonance_peaks
from rig.core.base.arrays import Array
from rig.core.base.escaping import escape_figure
from rig.core.base.figure_style import add_legend_below, add_title, frequency_axis, log_axis, new_figure
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.palette import CurveStyle, faded, location_style, location_styles
from rig.core.numerics.runs import ranges_of
from rig.core.results.response import Response

# An interval below this fraction of the magnitude is narrower than the points, and is not explained.
_MIN_VISIBLE_RATIO = 0.02
# On a logarithmic axis, this fraction of the magnitude replaces zero, and the inverse replaces infinity.
_ZERO_RATIO = 1e-9
# Height of the strip that marks undetermined points, relative to the axes.
_STRIP_HEIGHT = 0.012
# Distance between the symbols of curves with many lines, relative to the diagonal of the axes.
_MARK_DISTANCE = 0.02
# Length of the dashes of a curve with many lines, relative to the dashes of other curves.
_DASH_SCALE = 0.5
_LABEL_COLOR = "#555555"
_THEORY_COLOR = "#222222"
# Replaces the text of `PEAK_SYMBOLS` for arrows, if only the highest of several peaks at one frequency has an arrow.
_HIDDEN_ARROWS_TEXT = {"arrows": "Arrows: this peak and those below may be higher."}
# Replaces the texts of symbols that follow the sentence on the local model.
_THIN_CURVE_TEXTS = {"circles": "Circles: its peaks.", "diamonds": "Diamonds: its peaks, may be higher."}


def frf_figure(
    frfs: Sequence[Response],
    title: str,
    theory: Sequence[Response] = (),
    marks: Sequence[tuple[float, str]] = (),
    styles: Sequence[CurveStyle] = (),
    remarks: Sequence[str] = (),
) -> Figure:
    """Draw measured frequency responses on common axes.

    `frfs`: curves of the same motion and reference, with their labels in the legend. `theory`: curves without error
    bars, drawn thin and dotted. `marks`: frequency [Hz] and text of vertical lines. `styles`: styles of the curves;
    default: the styles of their bodies. `remarks`: sentences for the caption.
    """
    low, high = determined_band(frfs)
    if high <= low:
        low, high = low / 1.2, high * 1.2
    several = bool(styles)
    styles = styles or location_styles([frf.outputs[0].at for frf in frfs])
    if len(frfs) == 1:
        styles = [styles[0]._replace(dashes=())]
    top = phase_top(frfs)
    with new_figure(6.8) as figure:
        magnitude_axes, phase_axes, coherence_axes = figure.subplots(3, 1, height_ratios=[3.4, 1.3, 0.7])
        for curve in theory:
            color = location_style(curve.outputs[0].at).color if curve.outputs[0].at and not several else _THEORY_COLOR
            style: dict[str, Any] = {"color": color, "lw": 0.9, "ls": ":", "zorder": 3.5}
            magnitude_axes.plot(curve.frequency, curve.shown_in[1] * abs(curve.value), **style)
            phase_axes.plot(*break_at_wraps(curve.frequency, phase_degrees(curve.value, top)), **style)
        if theory:
            # If the curves have the colors of their bodies, their common entry in the legend is gray.
            color = _LABEL_COLOR if not several and theory[0].outputs[0].at else _THEORY_COLOR
            magnitude_axes.plot([], [], color=color, lw=0.9, ls=":", label=escape_figure(theory[0].label))
        marked_peaks = [peak_marks(measured, resonance_peaks(measured)) for measured in frfs]
        heights, edges = [], []
        unit, factor = frfs[0].shown_in
        unhidden = marked_peaks if several else without_hidden_arrows(marked_peaks)
        visible = [above_curves(marked, frfs) for marked in unhidden]
        for row, (measured, curve_style, marked) in enumerate(zip(frfs, styles, marked_peaks, strict=True)):
            panels = magnitude_axes, phase_axes, coherence_axes
            drawn = _draw_curve(measured, curve_style, row, top, marked, visible[row], *panels)
            edges.append(factor * _visible_edges(measured, drawn))
            heights += draw_marks(visible[row], measured.shown_in[1], curve_style.color, magnitude_axes)
        for frequency, text in marks:
            magnitude_axes.axvline(frequency, color="#777777", lw=0.8, ls=":")
            magnitude_axes.annotate(
                text, (frequency, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -3),
                textcoords="offset points", va="top", fontsize=7.5, color="#555555",
            )  # fmt: skip
        log_axis(
            magnitude_axes,
            [
                *(factor * abs(frf.value) for frf in theory),
                *(factor * abs(frf.value[is_determined(frf)]) for frf in frfs if is_determined(frf).any()),
                *edges,
                np.array([height for height, _ in heights]),
            ],
        )
        for axes, last in ((magnitude_axes, False), (phase_axes, False), (coherence_axes, True)):
            frequency_axis(axes, low, high, last)
        low_value, top_value = magnitude_axes.get_ylim()
        tops = [low_value * (height / low_value) ** (1.0 / (1.0 - space)) for height, space in heights]
        magnitude_axes.set_ylim(low_value, max([top_value, *tops]))
        colors = [style.color if several else _LABEL_COLOR for style in styles]
        labels = [(mark, color) for marked, color in zip(visible, colors, strict=True) for mark in marked]
        has_rings = label_peaks(labels, frfs[0], magnitude_axes)
        name = escape_figure(frfs[0].name)
        magnitude_axes.set_ylabel(f"|{name}| / ({unit})" if "/" in unit else name)
        add_title(magnitude_axes, title)
        phase_axes.set_ylabel("phase / °")
        phase_axes.set_yticks(phase_ticks(top))
        phase_axes.set_ylim(top - 375.0, top + 15.0)
        coherence_axes.set_ylabel("coherence")
        coherence_axes.set_ylim(-0.03, 1.06)
        coherence_axes.set_yticks([0, 0.5, 1])
        notes = []
        if not any(is_determined(frf).any() for frf in frfs):
            notes.append((phase_axes, "phase not determined at any line"))
        if not any(has_scatter(frf) for frf in frfs):
            text = "no coherence and no scatter: a single average, or not in the file"
            notes.append((coherence_axes, text))
        for axes, text in notes:
            axes.annotate(
                text, (0.5, 0.5), xycoords="axes fraction", ha="center", va="center", fontsize=8, color="#555555"
            )
        figure.align_ylabels([magnitude_axes, phase_axes, coherence_axes])
        sentences = _caption(
            frfs, [mark for mark, _ in labels], bool(magnitude_axes.containers), unhidden != marked_peaks
        )
        add_legend_below(figure, *remarks, *sentences, *["Rings: highest points."] * has_rings)
        return figure


def _caption(frfs: Sequence[Response], marks: Sequence[PeakMark], has_bars: bool, has_hidden_arrows: bool) -> list[str]:
    """Explain bands and markers in sentences.

    `has_bars`: whether points have error bars; `has_hidden_arrows`: whether an arrow is drawn for several peaks.
    """
    symbols = {mark.symbol for mark in marks}
    symbol_texts = PEAK_SYMBOLS | (_HIDDEN_ARROWS_TEXT if has_hidden_arrows else {})
    sentences = _band_texts(frfs)
    if has_bars:
        sentences.append("Bars: the same.")
    is_undetermined = not all(is_determined(frf).all() for frf in frfs)
    if is_undetermined:
        sentences.append(f"Pale, with a strip at the axis: undetermined ({undetermined_text(frfs)}).")
    if any((is_determined(frf.sorted()) & ~is_smooth(frf.sorted())).any() for frf in frfs):
        sentences.append(f"No phase where {'undetermined or ' * is_undetermined}scattered.")
    if any(frf.unsteady is not None and frf.unsteady.any() for frf in frfs):
        sentences.append("Crosses: steady state not reached.")
    if any(frf.frequency.size <= MAX_MARKED and not folds_back(frf.frequency) for frf in frfs):
        sentences.append("Thin curve: local model.")
        symbol_texts |= _THIN_CURVE_TEXTS
    if any(MAX_MARKED < frf.frequency.size <= MAX_POINTS and not folds_back(frf.frequency) for frf in frfs):
        sentences.append("Markers: at some of the points.")
    sentences += [text for symbol, text in symbol_texts.items() if symbol in symbols]
    sentences += ["Labels: peaks, not modes."] * bool(symbols)
    if not all(mark.is_steady for mark in marks):
        sentences.append("In parentheses: steady state not reached.")
    if any(frf.omitted.size for frf in frfs):
        sentences.append("Gaps with a mark at the axis: omitted frequencies.")
    return sentences


def _band_texts(frfs: Sequence[Response]) -> list[str]:
    """Explain the bands around the curves."""
    causes = ", ".join(visible_systematic_errors(frfs))
    if any(_is_visible(frf, frf.expanded_random()) for frf in frfs):
        limits = f"; light: also limits of error (type B: {causes})" if causes else ""
        return [f"Dark band: scatter (type A, 95 %){limits}."]
    if causes:
        return [f"Band: limits of error (type B: {causes})."]
    return ["95 % intervals: narrower than the points."] * any(has_scatter(frf) for frf in frfs)


def _draw_curve(
    frf: Response,
    style: CurveStyle,
    row: int,
    top: float,
    marks: Sequence[PeakMark],
    visible: Sequence[PeakMark],
    magnitude_axes: Axes,
    phase_axes: Axes,
    coherence_axes: Axes,
) -> Array:
    """Draw one measured curve into the three panels: tones as points, with a thin curve where the points resolve it.

    `row`: position of the curve in the legend; `top`: upper end of the phase axis [degrees]; `marks`: marked peaks,
    which the thin curve reaches; `visible`: those with a symbol. Returns the magnitudes of the thin curve.
    """
    # A downward sweep has larger, open markers, so an upward sweep remains visible where both coincide.
    is_folded = folds_back(frf.frequency)
    is_downward = frf.frequency.size > 1 and frf.frequency[0] > frf.frequency[-1] and not is_folded
    color, curve = style.color, drawn_response(frf, marks)
    frf, is_known = curve.lines, curve.is_known
    points: dict[str, Any] = {"ls": "", "marker": style.marker, "color": color, "ms": 2.6, "mew": 0.0, "zorder": 3}
    if is_downward:
        points |= {"mfc": "none", "ms": 5.0, "mew": 0.9, "zorder": 2.9}
    line: dict[str, Any] = {"color": color, "ls": style.line, "lw": 1.3, "zorder": 2.8}
    if frf.frequency.size > MAX_POINTS:
        points["marker"] = ""
        # Short dashes show the scatter of neighboring lines.
        line["ls"] = (0.0, tuple(_DASH_SCALE * length for length in style.dashes)) if style.dashes else "-"
    elif is_folded:
        line |= {"ls": ""}
    elif frf.frequency.size > MAX_MARKED:
        # A gap of a solid line is an undetermined range.
        line |= {"ls": "-"}
        points["markevery"] = _MARK_DISTANCE
    else:
        line |= {"ls": "-", "lw": 0.7}
    factor = frf.shown_in[1]
    magnitude, random = factor * abs(frf.value), factor * np.nan_to_num(frf.expanded_random())
    total = factor * np.nan_to_num(frf.expanded(), posinf=np.inf)
    drawn, center = curve.magnitude_frequency, factor * curve.magnitude
    bands = ((total, 0.13), (random, 0.25)) if is_known.any() and not is_folded else ()
    for half_width, opacity in bands:
        # Between the points, the band follows the thin curve.
        ratio = np.interp(drawn, frf.frequency[is_known], half_width[is_known] / magnitude[is_known])
        magnitude_axes.fill_between(
            drawn, center * np.maximum(1.0 - ratio, _ZERO_RATIO),
            center * np.minimum(1.0 + ratio, 1.0 / _ZERO_RATIO), color=color, alpha=opacity, lw=0,
        )  # fmt: skip
    # The highest point of a peak that may be higher has a bar, too: next to it, the band is narrower than the line.
    has_bar = _isolated(curve) & (frf.frequency.size <= MAX_POINTS)
    has_bar |= np.isin(frf.frequency, [mark.frequency for mark in visible if mark.symbol == "arrows"])
    has_bar &= is_known & (total > _MIN_VISIBLE_RATIO * magnitude)
    if has_bar.any():
        upper = total[has_bar]
        lower = np.minimum(upper, (1.0 - _ZERO_RATIO) * magnitude[has_bar])
        magnitude_axes.errorbar(
            frf.frequency[has_bar], magnitude[has_bar], [lower, upper],
            ls="", ecolor=color, elinewidth=0.9, capsize=2.0, zorder=2.7,
        )  # fmt: skip
    for frequencies in _omitted_ranges(frf):
        magnitude_axes.plot(
            frequencies, [0.0, 0.0], "x-", color=color, ms=5, clip_on=False,
            transform=magnitude_axes.get_xaxis_transform(),
        )  # fmt: skip
    is_unknown = ~is_known & ~np.isnan(magnitude)
    if is_unknown.any():
        for ends in ranges_of(frf.frequency, is_unknown, LINES_PER_GAP):
            magnitude_axes.axvspan(*ends, row * _STRIP_HEIGHT, (row + 1) * _STRIP_HEIGHT, color=faded(color), lw=0)
        # One more point at either end makes the line continuous where its color changes to gray.
        noisy = ~is_known | ~np.roll(is_known, 1) | ~np.roll(is_known, -1)
        magnitude_axes.plot(frf.frequency, np.where(noisy, magnitude, np.nan), color=faded(color), lw=0.7, zorder=2)
    magnitude_axes.plot(drawn, center, **line)
    # matplotlib does not draw a part of the markers of a curve without any point.
    every = {} if is_known.any() else {"markevery": None}
    magnitude_axes.plot(frf.frequency, np.where(is_known, magnitude, np.nan), **points | every)
    symbol = {key: points[key] for key in ("marker", "mew", "mfc") if key in points}
    magnitude_axes.plot(np.nan, np.nan, **line | symbol | {"ms": 4}, label=escape_figure(frf.label))
    if frf.unsteady is not None and frf.unsteady.any():
        magnitude_axes.plot(
            frf.frequency[frf.unsteady], magnitude[frf.unsteady], "x", color=color, markersize=6, zorder=4
        )
    angle, point_angle = drawn_phases(curve, top)
    drawn, center = break_at_wraps(curve.frequency, angle)
    for half_width, opacity in bands:
        ratio = np.interp(curve.frequency, frf.frequency[is_known], half_width[is_known] / magnitude[is_known])
        width = break_at_wraps(curve.frequency, angle, np.degrees(np.arcsin(np.minimum(ratio, 1.0))))[1]
        phase_axes.fill_between(drawn, center - width, center + width, color=color, alpha=opacity, lw=0)
    phase_axes.plot(drawn, center, **line)
    every = {} if np.isfinite(point_angle).any() else {"markevery": None}
    phase_axes.plot(frf.frequency, point_angle, **points | every)
    if has_scatter(frf):
        if is_unknown.any():
            coherence_axes.plot(frf.frequency, frf.coherence, color=faded(color), lw=0.7, zorder=2)
        coherence_axes.plot(
            frf.frequency, np.where(is_known, frf.coherence, np.nan), color=color, ls=style.line, zorder=3
        )
    return curve.magnitude


def _isolated(curve: DrawnResponse) -> NDArray[np.bool_]:
    """Return whether each line of a response is no part of its drawn curve, so that it has no band."""
    is_joined = np.pad(np.isfinite(curve.magnitude), (1, 2))
    place = np.searchsorted(curve.magnitude_frequency, curve.lines.frequency)
    return curve.is_known & ~(is_joined[place] | is_joined[place + 2])


def _omitted_ranges(frf: Response) -> list[tuple[float, float]]:
    """Return the first and last of the omitted frequencies in each gap between lines of a sorted curve [Hz]."""
    omitted = np.sort(frf.omitted)
    gap = np.searchsorted(frf.frequency[np.isfinite(frf.value)], omitted)
    return [(omitted[gap == number][0], omitted[gap == number][-1]) for number in np.unique(gap)]


def _is_visible(frf: Response, half_width: Array) -> bool:
    """Return whether the uncertainty band of a curve is wider than its drawn points at any determined point."""
    return bool(np.any((half_width > _MIN_VISIBLE_RATIO * abs(frf.value)) & is_determined(frf)))


def visible_systematic_errors(frfs: Sequence[Response]) -> list[str]:
    """Return the names of the systematic errors that are visible at any point of the curves, the largest first."""
    ratios: dict[str, float] = {}
    for frf in frfs:
        for name, limit in frf.limits.items():
            if _is_visible(frf, limit):
                ratio = limit / np.maximum(abs(frf.value), 1e-300)
                ratios[name] = max(ratios.get(name, 0.0), float(np.nanmedian(ratio)))
    return sorted(ratios, key=ratios.__getitem__, reverse=True)


def undetermined_text(frfs: Sequence[Response]) -> str:
    """Write why lines are undetermined: noise, or the errors that make the uncertainty larger than the value."""
    causes = set[str]()
    for frf in frfs:
        is_bounded = ~is_determined(frf) & exceeds_noise(frf)
        magnitude = np.maximum(abs(frf.value[is_bounded]), 1e-300)
        ratios = {name: float(np.max(limit[is_bounded] / magnitude, initial=0.0)) for name, limit in frf.limits.items()}
        largest = max(ratios, key=ratios.__getitem__, default="")
        causes |= {largest} if ratios.get(largest, 0.0) > MAX_ERROR_RATIO else set()
    return "noise, or uncertainty above 100 %" + f" due to {', '.join(sorted(causes))}" * bool(causes)


def _visible_edges(frf: Response, drawn: Array) -> Array:
    """Return the magnitudes that the axis must include: a drawn curve and its band, a decade beyond the lines at most.

    Between lines, the model of an antiresonance may approach zero.
    """
    magnitude, total = abs(frf.value), np.nan_to_num(frf.expanded(), posinf=np.inf)
    visible = is_determined(frf) & np.isfinite(magnitude) & (magnitude > 0)
    if not visible.any():
        return np.empty(0)
    # A pale peak between determined lines is visible, too.
    inside = magnitude[np.flatnonzero(visible)[0] : np.flatnonzero(visible)[-1]]
    magnitude, total = magnitude[visible], total[visible]
    upper = np.append(magnitude + total, np.nanmax(inside, initial=0.0))
    edges = np.concatenate([np.minimum(np.append(upper, drawn), 10.0 * magnitude.max()), magnitude - total])
    return np.asarray(edges[edges > 0.1 * magnitude.min()])
