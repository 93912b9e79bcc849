"""Charts of a report: frequency responses, damper motion and free decays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import inf, isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.commands.figures.decay_figure import frequency_title, group_modes
from analysis.commands.figures.frf_figure import (
    MAX_POINTS,
    break_at_wraps,
    folds_back,
    is_determined,
    is_smooth,
    phase_degrees,
)
from analysis.commands.report_page.charts import Chart, Curve, Panel, needs_logarithmic_axis
from analysis.commands.report_page.measurements import Measurement, SweepChange, SweepResults
from analysis.core.damper_motion.comparison import Peak, local_model
from analysis.core.damper_motion.dampers import Dampers
from analysis.core.decays.free_decay import Decay
from analysis.core.decays.modal_decay import ModalDecay
from analysis.core.recordings.names import belongs_to, excitation_text
from rig.core.base.palette import DAMPER, REFERENCE, CurveStyle, place_style, place_styles, recording_styles
from rig.core.results import format_decimals, format_frequencies, format_percent
from rig.core.results.response import Response
from rig.core.scene.excitation import FORCE_TOLERANCE

_REQUIRED = CurveStyle("#6E7681", (2, 2))
_UNDETERMINED = CurveStyle("#9aa2ab")
# Upper end of the axis of relative bounds.
_MAX_PERCENT = 100.0
# Ratio of a peak to the points at its half-power bandwidth.
_HALF_POWER = float(np.sqrt(2.0))
# The first view of a wide band begins at this fraction of the lowest natural frequency, and ends at this multiple of
# the highest.
_VIEW_RATIO = 4.0
# A stable pole belongs to a mode if their frequencies differ by at most this fraction.
_MODE_WIDTH = 0.05
# A long curve is reduced to the highest and the lowest point of this number of intervals.
_INTERVALS = 1200


def response_charts(
    measurements: Sequence[Measurement], reference: str, changes: Sequence[SweepChange] = ()
) -> list[Chart]:
    """Return charts of all frequency responses.

    The responses of a single sweep share a chart. With several recordings or levels, each response has its own chart,
    which compares them. Responses to different inputs never share a chart. `reference`: label of the recording with
    which the others are compared; `changes`: changes of its peaks, which are marked.
    """
    with_responses = [measurement for measurement in measurements if measurement.sweeps]
    frfs = [frf for measurement in with_responses for sweep in measurement.sweeps for frf in sweep.frfs]
    several = len({frf.label for frf in frfs}) > 1
    charts = []
    for key in dict.fromkeys((frf.ratio if several else frf.input) for frf in frfs):
        group = [frf for frf in frfs if key == (frf.ratio if several else frf.input)]
        names = _sweep_names(group, reference) if several else [frf.response for frf in group]
        styles = _sweep_styles(group, reference) if several else None
        sweeps = [sweep for measurement in with_responses for sweep in measurement.sweeps]
        peaks = [
            [peak for sweep in sweeps for peak in sweep.peaks_of(frf)]
            + [peak for each in changes if each.change.response == frf.response for peak in each.peaks_of(frf.label)]
            for frf in group
        ]
        baseline = next((each for each in with_responses if each.label == reference), with_responses[0]).sweeps[0]
        band = np.concatenate([frf.frequency for frf in group])
        view = None if baseline.modes is None else _first_view(band, baseline.modes.frequency)
        chart = response_chart(group, names, styles, peaks, _mode_marks(baseline, group), view)
        tests = {each.label: excitation_text(each.rec) for each in with_responses}
        equal = len(set(tests.values())) == 1
        levels = [text if equal else f"{label}: {text}" for label, text in tests.items() if text]
        test = "; ".join(dict.fromkeys(levels))
        charts.append(replace(chart, caption=f"{chart.caption} Test: {test}." if test else chart.caption))
    return charts


def _sweep_names(frfs: Sequence[Response], reference: str) -> list[str]:
    """Return names of recordings and levels for a legend; only the levels if all sweeps are from one recording."""
    common = f"{reference}, " if all(belongs_to(frf.label, reference) for frf in frfs) else ""
    return [frf.label.removeprefix(common) for frf in frfs]


def _sweep_styles(frfs: Sequence[Response], reference: str) -> list[CurveStyle]:
    """Return the styles of recordings that are compared with a reference, or of the levels of a single recording."""
    of_reference = [belongs_to(frf.label, reference) for frf in frfs]
    return recording_styles([each and (len(frfs) == 1 or not all(of_reference)) for each in of_reference])


def _mode_marks(sweep: SweepResults, frfs: Sequence[Response]) -> list[tuple[float, float, str]]:
    """Return frequency, height and label of each mode of a sweep; the height is that of the mode's peak in a chart."""
    if sweep.modes is None:
        return []
    marks = []
    for frequency, found in zip(sweep.modes.frequency.tolist(), sweep.found, strict=True):
        heights = [frf.shown_in[1] * peak.value for frf, peak in found if any(frf is each for each in frfs)]
        marks.append((frequency, max(heights, default=inf), f"{format_decimals(frequency, 2)} Hz"))
    return sorted(mark for mark in marks if isfinite(mark[1]))


def response_chart(
    frfs: Sequence[Response],
    names: Sequence[str],
    styles: Sequence[CurveStyle] | None = None,
    peaks: Sequence[Sequence[Peak]] = (),
    marks: Sequence[tuple[float, float, str]] = (),
    view: tuple[float, float] | None = None,
) -> Chart:
    """Return a chart of magnitude with its expanded uncertainty, phase and coherence, for one input.

    `styles`: styles of the curves, by default those of their bodies; `peaks`: peaks of each curve; `marks`: labels, see
    `Panel`. `view`: part of the band that is shown first, and determines the vertical axis.
    """
    styles = styles or place_styles([frf.outputs[0].at for frf in frfs])
    thinned = [_thinned(frf.with_gaps()) for frf in frfs]
    unit, factor = thinned[0].shown_in
    magnitude, phase, coherence, relative = [], [], [], []
    strips: list[tuple[float, float]] = []
    extrapolated: set[float] = set()
    rows = zip(frfs, thinned, names, styles, peaks or [()] * len(thinned), strict=True)
    for original, frf, name, style, found in rows:
        f, modulus, expanded = frf.frequency, factor * abs(frf.value), factor * frf.expanded()
        known = is_determined(frf) & np.isfinite(frf.value)
        low, high = (np.where(known, modulus + sign * expanded, np.nan) for sign in (-1.0, 1.0))
        curve = Curve(name, f, np.where(known, modulus, np.nan), low, high, style)
        draw = "points" if known.size <= MAX_POINTS else "line"
        if folds_back(original):
            # Several responses at one frequency are not a function of frequency, and have no band.
            draw, curve, found = "dots", replace(curve, low=None, high=None), ()
        magnitude.append(replace(curve, draw=draw))
        unknown = ~known & np.isfinite(frf.value)
        if unknown.any():
            strips += _ranges(f, unknown)
            # One more point at either end makes the curve continuous where it becomes gray.
            joined = unknown | np.roll(unknown, 1) | np.roll(unknown, -1)
            stored = joined | np.roll(joined, 1)
            gray = np.where(joined, modulus, np.nan)[stored]
            magnitude.append(Curve(name, f[stored], gray, style=_UNDETERMINED, draw="through"))
        if draw == "points":
            through = frf.continued(np.isfinite(frf.value))
            magnitude.append(Curve(name, through[0], factor * abs(through[1]), style=style, draw="through"))
            # The phase has the same gaps as the magnitude.
            smooth = frf.continued(known & is_smooth(frf))
            phase.append(Curve(name, *break_at_wraps(smooth[0], phase_degrees(smooth[1])), style=style, draw="through"))
        unsteady = np.zeros(f.size, dtype=bool) if frf.unsteady is None else frf.unsteady
        magnitude += _symbols(name, style, "crosses", zip(f[unsteady], modulus[unsteady], strict=True))
        # A peak of unknown height is drawn at its highest point.
        points = {peak: (peak.frequency, factor * peak.value) for peak in found if not peak.at_end}
        interpolated = [peak for peak in points if isfinite(peak.bound)]
        if draw == "line":
            # The curve with the peak is not visible between the lines of a spectrum, so it is drawn.
            models = [local_model(original, peak) for peak in interpolated]
            magnitude += [Curve(name, at, factor * height, style=style, draw="through") for at, height in models]
        extrapolated |= {p.frequency for p in interpolated if _exceeds_points(p, f, modulus / factor)}
        magnitude += _symbols(name, style, "circles", [points[peak] for peak in interpolated])
        magnitude += _symbols(name, style, "arrows", [at for peak, at in points.items() if not peak.is_determined])
        angle = np.where(known & is_smooth(frf), phase_degrees(frf.value), np.nan)
        phase.append(Curve(name, *break_at_wraps(f, angle), style=style, draw=draw))
        draw = "dots" if draw == "dots" else "line"
        coherence.append(Curve(name, f, frf.coherence, style=style, draw=draw))
        relative.append(Curve(name, f, np.minimum(100.0 * expanded / modulus, _MAX_PERCENT), style=style, draw=draw))
    quantity = thinned[0].name
    outputs = ", ".join(dict.fromkeys(frf.response for frf in thinned))
    band = np.concatenate([frf.frequency for frf in thinned])
    drawn = {curve.draw for curve in magnitude}
    listed = ", ".join(format_decimals(frequency, 2) for frequency in sorted(extrapolated))
    notes = [
        "Bands and U: 95 % intervals.",
        "Circles: peaks of the local model (thin) between the points." * ("circles" in drawn),
        f"Extrapolated, far above the points on either side: {listed} Hz." * bool(extrapolated),
        "Arrows: the peak may be higher." * ("arrows" in drawn),
        "Crosses: steady state not reached." * ("crosses" in drawn),
        "Gray, with a strip at the axis: undetermined (noise, or bound above 100 %)." * bool(strips),
    ]
    return Chart(
        f"{quantity.capitalize()} of {outputs} / {thinned[0].input}. {' '.join(filter(None, notes))}",
        f"{quantity.capitalize()} of {outputs} / {thinned[0].input} from {band.min():.4g} to {band.max():.4g} Hz.",
        [
            Panel(f"|{quantity}|", unit, magnitude, 240, True, _limits(magnitude, view), marks=marks, strips=strips),
            Panel("phase", "°", phase, height=105, limits=(-285.0, 105.0), ticks=(-270, -180, -90, 0, 90)),
            Panel("coherence", "", coherence, height=75, limits=(0.0, 1.05), ticks=(0.0, 0.5, 1.0)),
            Panel("U", "%", relative, height=90, logarithmic=True, limits=_percent_limits(relative)),
        ],
        logarithmic=needs_logarithmic_axis(band),
        x_limits=(float(band.min()), float(band.max())),
        x_view=view,
    )


def _exceeds_points(peak: Peak, f: NDArray[np.float64], modulus: NDArray[np.floating[Any]]) -> bool:
    """Return whether a peak exceeds the points next to it by more than half-power: they are on its flanks."""
    near = np.argsort(abs(f - peak.frequency))[:2]
    return bool(peak.value > _HALF_POWER * np.nanmax(modulus[near], initial=0.0))


def _symbols(name: str, style: CurveStyle, draw: str, points: Iterable[tuple[float, float]]) -> list[Curve]:
    """Return a curve of symbols at points; empty if there are no points."""
    x, y = np.array([*points]).reshape(-1, 2).T
    return [Curve(name, x, y, style=style, draw=draw)] if x.size else []


def force_charts(measurements: Sequence[Measurement], reference: str) -> list[Chart]:
    """Return a chart of the force of separate tones over frequency, with the tolerance of its controller."""
    sweeps = [
        (measurement, sweep.frfs[0])
        for measurement in measurements
        if measurement.rec.scene.level_key == "force"
        for sweep in measurement.sweeps
        if sweep.frfs[0].amplitude is not None and sweep.frfs[0].reference == "force"
    ]
    if not sweeps:
        return []
    frfs = [frf for _, frf in sweeps]
    names, styles = _sweep_names(frfs, reference), _sweep_styles(frfs, reference)
    curves, outside = list[Curve](), list[str]()
    for (measurement, measured), name, style in zip(sweeps, names, styles, strict=True):
        frf = measured.sorted()
        assert frf.amplitude is not None and measurement.rec.scene.test is not None
        curves.append(Curve(name, frf.frequency, frf.amplitude, style=style, draw="points"))
        levels = np.array(measurement.rec.scene.test.levels)
        nearest = abs(frf.amplitude[:, None] / levels - 1.0).min(axis=1)
        is_outside = nearest > FORCE_TOLERANCE
        curves += _symbols(
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
        curves.append(Curve(f"required {level:g} N", ends, force, low, high, _REQUIRED))
    points = f"Circles, outside: {'; '.join(outside)}." if outside else "All points are within it."
    return [
        Chart(
            f"Force at each frequency, and the required force with its tolerance of {format_percent(FORCE_TOLERANCE)}. "
            + points,
            f"Force from {frequency.min():.4g} to {frequency.max():.4g} Hz.",
            [Panel("force", "N", curves, height=170, limits=_with_margin(curves))],
            logarithmic=needs_logarithmic_axis(frequency),
        )
    ]


def _with_margin(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return limits of a linear axis that show all values and bands with a margin for symbols."""
    columns = [column for curve in curves for column in (curve.y, curve.low, curve.high) if column is not None]
    values = np.concatenate([np.asarray(column, dtype=float) for column in columns])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    margin = 0.15 * (high - low or 1.0)
    return low - margin, high + margin


def stabilization_charts(measurements: Sequence[Measurement]) -> list[Chart]:
    """Return the stabilization diagram of each sweep, on the frequency axis of its responses."""
    charts = []
    for sweep in (sweep for measurement in measurements for sweep in measurement.sweeps):
        if sweep.modes is None or not sweep.modes.chart:
            continue
        poles = sorted(sweep.modes.chart, key=lambda pole: pole.frequency)
        frequency, order, stable = np.array([(pole.frequency, pole.order, pole.stable) for pole in poles]).T
        band, top = sweep.frfs[0].frequency, float(order.max())
        modes, ticks = sweep.modes.frequency, np.arange(0.0, top + 1.0, 5.0).tolist()
        is_near = (abs(frequency[:, None] / modes - 1.0) <= _MODE_WIDTH).any(axis=1)
        # Poles are symbols, not points of a series, because poles of several orders have the same frequency.
        kinds = {
            ("new", "crosses"): stable == 0,
            ("stable", "dots"): (stable > 0) & is_near,
            ("stable, no mode", "circles"): (stable > 0) & ~is_near,
        }
        styles = {"crosses": _UNDETERMINED}
        curves = [
            curve
            for (name, draw), selected in kinds.items()
            for curve in _symbols(
                name,
                styles.get(draw, CurveStyle(REFERENCE)),
                draw,
                zip(frequency[selected], order[selected], strict=True),
            )
        ]
        marks = [(natural, 0.0, f"{format_decimals(natural, 2)} Hz") for natural in sorted(sweep.modes.frequency)]
        charts.append(
            Chart(
                f"{sweep.label}: poles of models of increasing order. Dotted lines: the identified modes, each with a "
                f"column of stable poles. A column that is split into two around its line indicates a nonlinear mode."
                + " Hollow: stable, but not identified as a mode."
                * any(curve.draw == "circles" for curve in curves),
                f"Stabilization diagram of {sweep.label}.",
                [Panel("model order", "", curves, 210, limits=(0.0, 1.05 * top), ticks=ticks, marks=marks)],
                logarithmic=needs_logarithmic_axis(band),
                x_limits=(float(band.min()), float(band.max())),
                x_view=_first_view(band, modes),
            )
        )
    return charts


def _first_view(band: NDArray[np.float64], modes: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return the part of a band around the modes that is shown first; None to show the whole band.

    >>> _first_view(np.array([0.5, 2000.0]), np.array([13.0, 50.0]))
    (3.25, 200.0)
    """
    low, high = float(band[band > 0].min()), float(band.max())
    if not modes.size:
        return None
    view = max(low, float(modes.min()) / _VIEW_RATIO), min(high, float(modes.max()) * _VIEW_RATIO)
    return view if high / low > 2.0 * view[1] / view[0] else None


def _ranges(f: NDArray[np.float64], selected: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return the ends of the ranges of selected frequencies; an end is halfway to the next frequency.

    >>> _ranges(np.arange(5.0), np.array([False, True, True, False, True]))
    [(0.5, 2.5), (3.5, 4.0)]
    """
    middle = np.concatenate([f[:1], (f[1:] + f[:-1]) / 2.0, f[-1:]])
    steps = np.diff(np.concatenate([[0], selected.astype(int), [0]]))
    ends = zip(middle[np.flatnonzero(steps > 0)], middle[np.flatnonzero(steps < 0)], strict=True)
    return [(min(a, b), max(a, b)) for a, b in ((float(f"{a:.8g}"), float(f"{b:.8g}")) for a, b in ends)]


def _percent_limits(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return the limits of the axis of relative bounds; it ends at 100 %, where the value is undetermined."""
    return min(_limits(curves)[0], 0.1 * _MAX_PERCENT), _MAX_PERCENT


def _limits(curves: Sequence[Curve], view: tuple[float, float] | None = None) -> tuple[float, float]:
    """Return the limits of a logarithmic axis that shows all values in a view, but not all intervals."""
    x, values = np.hstack([np.array([curve.x, curve.y], dtype=float) for curve in curves])
    low, high = view or (-inf, inf)
    values = values[np.isfinite(values) & (values > 0) & (x >= low) & (x <= high)]
    return (float(values.min()) / 1.5, 1.5 * float(values.max())) if values.size else (0.1, 10.0)


def _thinned(frf: Response) -> Response:
    """Reduce a long curve to the highest and the lowest point of each interval."""
    count = frf.frequency.size
    if count <= 2 * _INTERVALS:
        return frf
    magnitude = np.nan_to_num(abs(frf.value))
    intervals = np.array_split(np.arange(count), _INTERVALS)
    extremes = (np.argmax, np.argmin)
    selected = {int(points[extreme(magnitude[points])]) for points in intervals for extreme in extremes}
    return frf.at(np.array(sorted(selected | {0, count - 1})))


def damper_chart(measurement: Measurement, result: Dampers) -> Chart:
    """Return a chart of impacts per period for each body, and the share of energy dissipated by all dampers."""
    frequency = result.sweep.lines.frequency
    order = np.argsort(frequency)
    panels = []
    impacts = []
    for motions in result.bodies:
        style = place_style(measurement.rec.channels[motions[0].channel].at)
        count = np.array([sum(motion.impacts_per_period) for motion in motions])
        impacts.append(Curve(motions[0].channel, frequency[order], count[order], style=style, draw="points"))
    if impacts:
        panels.append(Panel("impacts per period", "", impacts, height=150))
    energy = result.energy
    if energy is not None:
        percent, bound = (_percent(energy_part, energy.supplied) for energy_part in (energy.dampers, energy.bound))
        low, high = (percent - bound)[order], (percent + bound)[order]
        curve = Curve("dampers", frequency[order], percent[order], low, high, CurveStyle(DAMPER), "points")
        limits = min(-5.0, float(np.nanmin(percent)) - 5.0), max(105.0, float(np.nanmax(percent)) + 5.0)
        panels.append(Panel("share of energy", "%", [curve], height=150, limits=limits))
    level = f"drive level {result.sweep.level:.4g}"
    if measurement.rec.scene.level_key == "force":
        level = f"force {result.sweep.level:.4g} N"
    return Chart(
        f"{measurement.label}, {result.sweep.direction}, {level}: impacts per period on floor and ceiling (gaps: no "
        "regular pattern), and share of the supplied energy that the dampers dissipate, with 95 % intervals.",
        f"Damper impacts per period against frequency, {frequency.min():.4g} to {frequency.max():.4g} Hz.",
        panels,
        logarithmic=needs_logarithmic_axis(frequency),
    )


def _percent(part: NDArray[np.float64], total: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(total > 0, 100.0 * part / np.where(total > 0, total, 1.0), np.nan)


def decay_charts(measurements: Sequence[Measurement], reference: str) -> list[Chart]:
    """Return charts of the envelopes and energies of free decays, and of damping ratio against amplitude."""
    labeled_decays = [
        (measurement.label, measurement.decay) for measurement in measurements if measurement.decay is not None
    ]
    if not labeled_decays:
        return []
    envelopes, energies = [], []
    is_reference = [label == reference for label, _ in labeled_decays]
    for (label, result), style in zip(labeled_decays, recording_styles(is_reference), strict=True):
        envelopes.append(Curve(label, result.peak_time, result.peak, style=style))
        step = max(result.time.size // _INTERVALS, 1)
        energies.append(Curve(label, result.time[::step], result.energy[::step], style=style))
    channels = ", ".join(dict.fromkeys(result.channel for _, result in labeled_decays))
    charts = [
        Chart(
            f"Free decay of {channels}: peaks of the acceleration, and backward-integrated (Schroeder) energy.",
            f"Free decay of {channels} over {max(result.time[-1] for _, result in labeled_decays):.3g} s.",
            [
                Panel("acceleration peaks", "m/s²", envelopes, height=220, logarithmic=True),
                Panel("energy", "dB", energies, height=160),
            ],
            x_name="time",
            x_unit="s",
        )
    ]
    groups = group_modes([result for _, result in labeled_decays])
    if groups:
        charts.append(_damping_chart(groups, labeled_decays, recording_styles(is_reference)))
    return charts


def _damping_chart(
    groups: Sequence[list[tuple[int, ModalDecay]]],
    labeled_decays: Sequence[tuple[str, Decay]],
    styles: Sequence[CurveStyle],
) -> Chart:
    """Return a chart of damping ratio against amplitude, with a panel for each mode; `groups`: from `group_modes`."""
    panels = []
    for group in groups:
        known = np.concatenate([mode.percent[0][mode.percent[0] > 0] for _, mode in group])
        lowest, highest = (float(known.min()) / 3.0, 3.0 * float(known.max())) if known.size else (0.1, 10.0)
        curves = []
        for index, mode in sorted(group, key=lambda pair: pair[0]):
            order = np.argsort(mode.amplitude)
            percent, expanded = (values[order] for values in mode.percent)
            # A logarithmic axis has no zero, so the band ends at the axis.
            low, high = np.maximum(percent - expanded, lowest), np.minimum(percent + expanded, highest)
            label, amplitude, style = labeled_decays[index][0], mode.amplitude[order], styles[index]
            differs = np.where(percent > expanded, percent, np.nan)
            curves.append(Curve(label, amplitude, differs, low, high, style))
            curves.append(Curve(label, amplitude, percent, style=_UNDETERMINED, draw="through"))
        title = frequency_title(group).removeprefix("mode ")
        panels.append(Panel(f"ζ {title}", "%", curves, height=130, logarithmic=True, limits=(lowest, highest)))
    return Chart(
        "Damping ratio ζ of each mode against amplitude of the acceleration, with 95 % intervals. Gray, with a "
        "band down to the axis: includes zero. Frequencies: those of the decay table.",
        "Damping ratio of each mode against the amplitude of the acceleration.",
        panels,
        x_name="amplitude",
        x_unit="m/s²",
        logarithmic=True,
    )
