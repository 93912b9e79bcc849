"""Charts of a report: frequency responses, and the force of their tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from analysis.commands.figures.determined_lines import LINES_PER_GAP, MAX_MARKED, folds_back
from analysis.commands.figures.frf_figure import undetermined_text
from analysis.commands.figures.peak_marks import MODE_SHIFT, PEAK_SYMBOLS, PeakMark, drawn_response
from analysis.commands.figures.phase_axis import break_at_wraps, drawn_phases, phase_ticks, phase_top
from analysis.commands.report_page.charts import (
    REQUIRED,
    Chart,
    Curve,
    Mark,
    Panel,
    Strip,
    limits_with_margin,
    needs_logarithmic_axis,
    symbol_curves,
)
from analysis.commands.report_page.measurements import Measurement, SweepResults, force_deviation
from analysis.core.recordings.descriptions import acquisition_text, excitation_text
from analysis.core.recordings.names import belongs_to, without_common_direction
from analysis.core.responses.estimator import Blocks
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.palette import CurveStyle, location_styles, recording_styles
from rig.core.numerics.runs import ranges_of
from rig.core.results import format_frequencies, format_percent
from rig.core.results.response import Response
from rig.core.scene.excitation import FORCE_TOLERANCE

# Upper end of the axis of relative expanded uncertainties.
_MAX_PERCENT = 100.0
# The first view of a wide band extends from this fraction of the lowest to this multiple of the highest mode.
_VIEW_RATIO = 4.0
# A long curve is reduced to the highest and the lowest point of this number of intervals.
_INTERVALS = 1200


def response_charts(measurements: Sequence[Measurement], baseline_name: str) -> list[Chart]:
    """Return charts of all frequency responses.

    The responses of a single sweep share a chart. With several recordings or levels, each response has a chart that
    compares the recordings and levels. Responses to different inputs never share a chart. `baseline_name`: label of the
    recording with which the others are compared.
    """
    with_responses = [measurement for measurement in measurements if measurement.sweeps]
    # A channel that is drawn for one recording is drawn for all, so that they can be compared.
    drawn = {name for each in with_responses for name in each.drawn}
    all_frfs = [frf for each in with_responses for sweep in each.sweeps for frf in sweep.frfs]
    frfs = [frf for frf in all_frfs if frf.response in drawn]
    part = f"Drawn: {len(frfs)} of {len(all_frfs)} responses, first those with the highest peak of a mode."
    several = len({frf.label for frf in frfs}) > 1
    charts = list[Chart]()
    stated = set[str]()
    for key in dict.fromkeys((frf.ratio if several else frf.input) for frf in frfs):
        group = [frf for frf in frfs if key == (frf.ratio if several else frf.input)]
        names = sweep_names([frf.label for frf in group], baseline_name) if several else [frf.response for frf in group]
        styles = sweep_styles([frf.label for frf in group], baseline_name) if several else None
        sweeps = [sweep for measurement in with_responses for sweep in measurement.sweeps]
        marks = [marked for frf in group for sweep in sweeps for each, marked in sweep.marked if each is frf]
        baseline = next((each for each in with_responses if each.label == baseline_name), with_responses[0]).sweeps[0]
        band = np.concatenate([frf.frequency for frf in group])
        view = None if baseline.modes is None else first_view(band, baseline.modes.frequency)
        # Names of levels are short enough for labels.
        levels = names if several and len(with_responses) == 1 else [""] * len(group)
        labels = _mode_marks(sweeps, baseline, group, styles, levels)
        chart = response_chart(group, names, styles, marks, labels, view)
        # A chart is also read or saved alone.
        excitation = _joined({each.label: excitation_text(each.rec) for each in with_responses})
        test = _joined({each.label: _test_text(each) for each in with_responses})
        sentences = [*chart.notes, *[part] * (len(frfs) < len(all_frfs)), *[f"Test: {test}."] * bool(test)]
        # Later charts do not repeat the sentences of the first.
        shown = [text for text in sentences if text not in stated]
        charts.append(replace(chart, title="; ".join(filter(None, [chart.title, excitation])), notes=shown))
        stated.update(sentences)
    return charts


def _joined(texts: dict[str, str]) -> str:
    """Join texts on recordings, with their labels unless all are equal."""
    equal = len(set(texts.values())) == 1
    return "; ".join(dict.fromkeys(text if equal else f"{label}: {text}" for label, text in texts.items() if text))


def _test_text(measurement: Measurement) -> str:
    """Describe excitation, lines and estimate of the responses of a recording."""
    rec = measurement.rec
    estimate = acquisition_text(rec, measurement.sweeps[0].frfs[0], Blocks().title(rec.test.kind))
    return ", ".join(filter(None, [excitation_text(rec), estimate]))


def sweep_names(labels: Sequence[str], baseline_name: str) -> list[str]:
    """Return names of recordings and levels for a legend; only the levels if all sweeps are from one recording."""
    common = f"{baseline_name}, " if all(belongs_to(label, baseline_name) for label in labels) else ""
    return without_common_direction([label.removeprefix(common) for label in labels])


def sweep_styles(labels: Sequence[str], baseline_name: str) -> list[CurveStyle]:
    """Return the styles of recordings that are compared with the baseline, or of the levels of a single recording."""
    of_baseline = [belongs_to(label, baseline_name) for label in labels]
    return recording_styles([each and (len(labels) == 1 or not all(of_baseline)) for each in of_baseline])


def _mode_marks(
    sweeps: Sequence[SweepResults],
    baseline: SweepResults,
    frfs: Sequence[Response],
    styles: Sequence[CurveStyle] | None,
    levels: Sequence[str],
) -> list[Mark]:
    """Mark each mode, and each other peak, at its highest point; labels of several curves have the curves' colors."""
    # The labels of the first curve are first. `levels`: names of the curves in the labels, or empty texts.
    marks = list[tuple[int, Mark]]()
    for sweep in sweeps if styles else [baseline]:
        natural = np.empty(0) if sweep.modes is None else sweep.modes.frequency
        labels = [] if sweep.modes is None else [sweep.modes.frequency_label(k) for k in range(natural.size)]
        labeled = [
            (float(frequency), label, [(frf, peak.value) for frf, peak in peaks])
            for frequency, label, peaks in zip(natural, labels, sweep.found, strict=True)
        ] + [
            (mark.frequency, f"peak {mark.label}", [(frf, mark.height)])
            for frf, marked in sweep.marked
            for mark in marked
            if mark.symbol in PEAK_SYMBOLS and not (abs(natural / mark.frequency - 1.0) < MODE_SHIFT).any()
        ]
        for frequency, text, heights in labeled:
            drawn = [
                (frf.shown_in[1] * height, k) for frf, height in heights for k, each in enumerate(frfs) if frf is each
            ]
            if drawn:
                height, curve = max(drawn)
                color = styles[curve].color if styles else ""
                label = ": ".join(filter(None, [levels[curve], text]))
                marks.append((curve * bool(styles), Mark(frequency, height, label, color)))
    return [mark for _, mark in sorted(marks)]


def response_chart(
    frfs: Sequence[Response],
    names: Sequence[str],
    styles: Sequence[CurveStyle] | None = None,
    peaks: Sequence[Sequence[PeakMark]] = (),
    marks: Sequence[Mark] = (),
    view: tuple[float, float] | None = None,
) -> Chart:
    """Return a chart of magnitude with its expanded uncertainty, phase and coherence, for one input.

    `styles`: styles of the curves, by default those of their bodies; `peaks`: marked peaks of each curve; `marks`:
    labels, see `Panel`. `view`: part of the band that is shown first, and determines the vertical axis.
    """
    styles = styles or location_styles([frf.outputs[0].at for frf in frfs])
    unit, factor = frfs[0].shown_in
    magnitude, phase, coherence, relative = [], [], [], []
    strips: list[Strip] = []
    top = phase_top(frfs)
    for original, name, style, found in zip(frfs, names, styles, peaks or [()] * len(frfs), strict=True):
        thin = drawn_response(original, found)
        chosen = _extremes(thin.lines.frequency, thin.lines.value)
        frf, known = thin.lines.at(chosen), thin.is_known[chosen]
        f, modulus, expanded = frf.frequency, factor * abs(frf.value), factor * frf.expanded()
        low, high = (np.where(known, modulus + sign * expanded, np.nan) for sign in (-1.0, 1.0))
        curve = Curve(name, f, np.where(known, modulus, np.nan), low, high, style)
        draw = "points" if thin.lines.frequency.size <= MAX_MARKED else "line"
        if folds_back(original.frequency):
            # Several responses at one frequency are not a function of frequency, and have no band.
            draw, curve = "dots", replace(curve, low=None, high=None)
        # Between the points, the band follows the thin curve.
        shown = _extremes(thin.magnitude_frequency, thin.magnitude)
        drawn, center = thin.magnitude_frequency[shown], factor * thin.magnitude[shown]
        ratio = np.interp(drawn, f[known], (expanded / modulus)[known]) if known.any() else 0.0
        low, high = (center * np.maximum(1.0 + sign * ratio, 0.0) for sign in (-1.0, 1.0))
        through = Curve(name, drawn, center, low, high, style, "through")
        curve = replace(through if draw == "line" else curve, draw=draw)
        magnitude.append(curve)
        unknown = ~known & np.isfinite(frf.value)
        if unknown.any():
            strips += [Strip(ends, style.color) for ends in ranges_of(f, unknown, LINES_PER_GAP)]
            # One point more at either end closes the gap between the gray and the colored curve.
            joined = unknown | np.roll(unknown, 1) | np.roll(unknown, -1)
            stored = joined | np.roll(joined, 1)
            gray = np.where(joined, modulus, np.nan)[stored]
            magnitude.append(Curve(name, f[stored], gray, style=style, draw="pale"))
        shown = _extremes(thin.frequency, thin.value)
        curve_angle, point_angle = drawn_phases(thin, top)
        line = break_at_wraps(thin.frequency[shown], curve_angle[shown])
        if draw == "points":
            magnitude.append(through)
            phase.append(Curve(name, *line, style=style, draw="through"))
        unsteady = np.zeros(f.size, dtype=bool) if frf.unsteady is None else frf.unsteady
        magnitude += symbol_curves(name, style, "crosses", zip(f[unsteady], modulus[unsteady], strict=True))
        for symbol in PEAK_SYMBOLS:
            places = [(mark.frequency, factor * mark.height) for mark in found if mark.symbol == symbol]
            magnitude += symbol_curves(name, style, symbol, places)
        if draw == "line":
            phase.append(Curve(name, *line, style=style))
        else:
            phase.append(Curve(name, *break_at_wraps(f, point_angle[chosen]), style=style, draw=draw))
        draw = "dots" if draw == "dots" else "line"
        coherence.append(Curve(name, f, frf.coherence, style=style, draw=draw))
        relative.append(Curve(name, f, np.minimum(100.0 * expanded / modulus, _MAX_PERCENT), style=style, draw=draw))
    quantity = frfs[0].name
    outputs = ", ".join(dict.fromkeys(frf.response for frf in frfs))
    band = np.concatenate([column for frf in frfs for column in (frf.frequency, frf.omitted)])
    symbols = {curve.draw for curve in magnitude}
    notes = [
        "Bands and U: 95 % intervals; γ²: coherence.",
        "Thin: local model through the points, with gaps where they do not determine it." * ("points" in symbols),
        *(text for symbol, text in PEAK_SYMBOLS.items() if symbol in symbols),
        "Labels: natural frequencies of the modes; “peak”: of other peaks." * bool(marks),
        "Crosses: steady state not reached." * ("crosses" in symbols),
        f"Pale, with a strip at the axis: undetermined ({undetermined_text(frfs)})." * bool(strips),
    ]
    return Chart(
        f"{quantity.capitalize()} of {outputs} / {frfs[0].input}",
        f"{quantity.capitalize()} of {outputs} / {frfs[0].input} from {band.min():.4g} to {band.max():.4g} Hz.",
        [
            Panel(f"|{quantity}|", unit, magnitude, 240, True, _limits(magnitude, view), marks=marks, strips=strips),
            Panel("phase", "°", phase, 105, limits=(top - 375.0, top + 15.0), ticks=phase_ticks(top)),
            Panel("γ²", "", coherence, height=75, limits=(0.0, 1.05), ticks=(0.0, 0.5, 1.0)),
            Panel("U", "%", relative, height=90, logarithmic=True, limits=_percent_limits(relative)),
        ],
        logarithmic=needs_logarithmic_axis(band),
        x_limits=(float(band.min()), float(band.max())),
        x_view=view,
        notes=notes,
    )


def force_charts(measurements: Sequence[Measurement], baseline_name: str) -> list[Chart]:
    """Return a chart of the force of separate tones against frequency, with the tolerance of its controller."""
    sweeps = [
        (measurement, sweep.frfs[0])
        for measurement in measurements
        if measurement.rec.scene.level_key == "force"
        for sweep in measurement.sweeps
        if sweep.frfs[0].amplitude is not None and sweep.frfs[0].reference == "force"
    ]
    if not sweeps:
        return []
    labels = [frf.label for _, frf in sweeps]
    names, styles = sweep_names(labels, baseline_name), sweep_styles(labels, baseline_name)
    curves, outside = list[Curve](), list[str]()
    for (measurement, measured), name, style in zip(sweeps, names, styles, strict=True):
        frf = measured.sorted()
        assert frf.amplitude is not None
        curves.append(Curve(name, frf.frequency, frf.amplitude, style=style, draw="points"))
        nearest = force_deviation(measurement, frf)
        is_outside = nearest > FORCE_TOLERANCE
        curves += symbol_curves(
            name, style, "circles", zip(frf.frequency[is_outside], frf.amplitude[is_outside], strict=True)
        )
        if is_outside.any():
            where = format_frequencies(frf.frequency.tolist(), is_outside.tolist())
            outside.append(f"{name}: {where}, by up to {format_percent(float(nearest.max()))}")
    tests = [measurement.rec.scene.test for measurement, _ in sweeps]
    frequency = np.concatenate([np.asarray(curve.x, dtype=float) for curve in curves])
    for level in sorted({level for test in tests if test is not None for level in test.levels}):
        ends, force = [frequency.min(), frequency.max()], np.full(2, level)
        low, high = ((1.0 + sign * FORCE_TOLERANCE) * force for sign in (-1.0, 1.0))
        curves.append(Curve(f"required {level:g} N", ends, force, low, high, REQUIRED))
    points = f"Circles: out of tolerance ({'; '.join(outside)})." if outside else "All points are within the tolerance."
    return [
        Chart(
            f"Force at each frequency, and the required force with its tolerance of {format_percent(FORCE_TOLERANCE)}",
            f"Force from {frequency.min():.4g} to {frequency.max():.4g} Hz.",
            [Panel("force", "N", curves, height=170, limits=limits_with_margin(curves))],
            logarithmic=needs_logarithmic_axis(frequency),
            notes=[points],
        )
    ]


def first_view(band: NDArray[np.float64], modes: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return the part of a band around the modes that is shown first; None to show the whole band.

    >>> first_view(np.array([0.5, 2000.0]), np.array([13.0, 50.0]))
    (3.25, 200.0)
    """
    low, high = float(band[band > 0].min()), float(band.max())
    if not modes.size:
        return None
    view = max(low, float(modes.min()) / _VIEW_RATIO), min(high, float(modes.max()) * _VIEW_RATIO)
    return view if high / low > 2.0 * view[1] / view[0] else None


def _percent_limits(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return the limits of the axis of relative expanded uncertainties; it ends at 100 %: not determined."""
    return min(_limits(curves)[0], 0.1 * _MAX_PERCENT), _MAX_PERCENT


def _limits(curves: Sequence[Curve], view: tuple[float, float] | None = None) -> tuple[float, float]:
    """Return the limits of a logarithmic axis that shows all values in a view; intervals may be cut."""
    x, values = np.hstack([np.array([curve.x, curve.y], dtype=float) for curve in curves])
    low, high = view or (-inf, inf)
    values = values[np.isfinite(values) & (values > 0) & (x >= low) & (x <= high)]
    return (float(values.min()) / 1.5, 1.5 * float(values.max())) if values.size else (0.1, 10.0)


def _extremes(f: NDArray[np.float64], value: Array | ComplexArray) -> NDArray[np.intp]:
    """Return the highest and the lowest point of a long curve in each interval of a logarithmic axis, and all gaps."""
    if f.size <= 2 * _INTERVALS:
        return np.arange(f.size)
    magnitude, positive = abs(value), f[f > 0]
    interval = np.searchsorted(np.geomspace(positive[0], positive[-1], _INTERVALS), f)
    starts = np.flatnonzero(np.diff(interval, prepend=-1))
    pieces = np.split(np.nan_to_num(magnitude), starts[1:])
    selected = {
        int(start + find(piece)) for start, piece in zip(starts, pieces, strict=True) for find in (np.argmax, np.argmin)
    }
    return np.array(sorted(selected | {0, f.size - 1}), dtype=np.intp)
