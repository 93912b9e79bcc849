"""Charts of a report: frequency responses, damper motion and free decays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.commands.figures.frf_figure import MAX_POINTS, break_at_wraps, is_determined, is_smooth, phase_degrees
from analysis.commands.report_page.charts import Chart, Curve, Panel, needs_logarithmic_axis
from analysis.commands.report_page.measurements import Measurement
from analysis.commands.report_page.tables import with_bound
from analysis.core.damper_motion.dampers import Dampers
from analysis.core.recordings.names import belongs_to, excitation_text
from rig.core.base.palette import DAMPER, CurveStyle, place_style, place_styles, recording_styles
from rig.core.results import format_percent
from rig.core.results.response import Response
from rig.core.results.uncertainty import expand
from rig.core.scene.excitation import FORCE_TOLERANCE

_REQUIRED = CurveStyle("#6E7681", (2, 2))
_UNDETERMINED = CurveStyle("#9aa2ab")
# The axis of bounds relative to the value ends here.
_MAX_PERCENT = 100.0
# A long curve is reduced to the highest and the lowest point of this number of intervals.
_INTERVALS = 1200


def response_charts(measurements: Sequence[Measurement], reference: str) -> list[Chart]:
    """Return charts of all frequency responses.

    The responses of a single recording share a chart. With several recordings each response has its own chart, so
    that the recordings can be compared. Responses to different inputs never share a chart. `reference`: label of the
    recording with which the others are compared.
    """
    with_responses = [measurement for measurement in measurements if measurement.sweeps]
    frfs = [frf for measurement in with_responses for sweep in measurement.sweeps for frf in sweep.frfs]
    several = len({measurement.label for measurement in with_responses}) > 1
    charts = []
    for key in dict.fromkeys((frf.ratio if several else frf.input) for frf in frfs):
        group = [frf for frf in frfs if key == (frf.ratio if several else frf.input)]
        names = [frf.label if several else f"{frf.response} {frf.label}".strip() for frf in group]
        if not several and len({frf.label for frf in group}) == 1:
            names = [frf.response for frf in group]
        styles = recording_styles([belongs_to(frf.label, reference) for frf in group]) if several else None
        chart = response_chart(group, names, styles, _peak_marks(with_responses, group, several, reference))
        tests = {each.label: excitation_text(each.rec) for each in with_responses}
        levels = [text if len(tests) == 1 else f"{label}: {text}" for label, text in tests.items() if text]
        charts.append(
            replace(chart, caption=f"{chart.caption} Test: {'; '.join(levels)}." if levels else chart.caption)
        )
    return charts


def _peak_marks(
    measurements: Sequence[Measurement], frfs: Sequence[Response], several: bool, reference: str
) -> list[tuple[float, float, str]]:
    """Return frequency, height and label of the highest peak near each mode of a recording, if it is in a chart.

    The label is the natural frequency of the table, with four digits at most. `several`: label only the `reference`.
    """
    marks = []
    for measurement in measurements:
        for sweep in measurement.sweeps[:1] if not several or measurement.label == reference else ():
            for k, found in enumerate(sweep.peaks):
                if sweep.modes is None or found is None or not any(found[0] is frf for frf in frfs):
                    continue
                _, factor = found[0].shown_in
                frequency, bound = float(sweep.modes.frequency[k]), float(expand(sweep.modes.frequency_error[k]))
                text = float(with_bound(frequency, bound).partition(" ")[0])
                marks.append((found[1].frequency, factor * found[1].value, f"{text:.4g} Hz"))
    return marks


def response_chart(
    frfs: Sequence[Response],
    names: Sequence[str],
    styles: Sequence[CurveStyle] | None = None,
    marks: Sequence[tuple[float, float, str]] = (),
) -> Chart:
    """Return a chart of magnitude with its expanded uncertainty, phase and coherence, for one input.

    `styles`: of the curves; default: those of their bodies. `marks`: labels of peaks; see `Panel`.
    """
    styles = styles or place_styles([frf.outputs[0].at for frf in frfs])
    thinned = [_thinned(frf.with_gaps()) for frf in frfs]
    unit, factor = thinned[0].shown_in
    magnitude, phase, coherence, relative = [], [], [], []
    strips: list[tuple[float, float]] = []
    for frf, name, style in zip(thinned, names, styles, strict=True):
        f, modulus, expanded = frf.frequency, factor * abs(frf.value), factor * frf.expanded()
        known = is_determined(frf) & np.isfinite(frf.value)
        low, high = (np.where(known, modulus + sign * expanded, np.nan) for sign in (-1.0, 1.0))
        draw = "points" if known.size <= MAX_POINTS else "line"
        magnitude.append(Curve(name, f, np.where(known, modulus, np.nan), low, high, style, draw))
        unknown = ~known & np.isfinite(frf.value)
        if unknown.any():
            strips += _ranges(f, unknown)
            # One more point on either side makes the curve continuous where it becomes gray.
            joined = unknown | np.roll(unknown, 1) | np.roll(unknown, -1)
            magnitude.append(Curve(name, f, np.where(joined, modulus, np.nan), style=_UNDETERMINED, draw="through"))
        if draw == "points":
            through = frf.continued(np.isfinite(frf.value))
            magnitude.append(Curve(name, through[0], factor * abs(through[1]), style=style, draw="through"))
        angle = np.where(known & is_smooth(frf), phase_degrees(frf.value), np.nan)
        phase.append(Curve(name, *break_at_wraps(f, angle), style=style))
        coherence.append(Curve(name, f, frf.coherence, style=style))
        relative.append(Curve(name, f, np.minimum(100.0 * expanded / modulus, _MAX_PERCENT), style=style))
    quantity = thinned[0].name
    outputs = ", ".join(dict.fromkeys(frf.response for frf in thinned))
    band = np.concatenate([frf.frequency for frf in thinned])
    return Chart(
        f"{quantity.capitalize()} of {outputs} / {thinned[0].input}: magnitude with 95 % intervals, phase, coherence, "
        "and expanded uncertainty relative to the value."
        + (" Labels: natural frequencies of the table." if marks else "")
        + (" Gray, with a strip at the axis: undetermined (noise, or bound above 100 %)." if strips else ""),
        f"{quantity.capitalize()} of {outputs} / {thinned[0].input} from {band.min():.4g} to {band.max():.4g} Hz.",
        [
            Panel(f"|{quantity}|", unit, magnitude, 280, True, _limits(magnitude), marks=marks, strips=strips),
            Panel("phase", "°", phase, height=140, limits=(-285.0, 105.0), ticks=(-270, -180, -90, 0, 90)),
            Panel("coherence", "", coherence, height=110, limits=(0.0, 1.05)),
            Panel("U (95 %)", "% of value", relative, height=130, logarithmic=True, limits=_percent_limits(relative)),
        ],
        logarithmic=needs_logarithmic_axis(band),
    )


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
    styles = recording_styles([belongs_to(frf.label, reference) for _, frf in sweeps])
    curves = []
    for (_, measured), style in zip(sweeps, styles, strict=True):
        frf = measured.sorted()
        assert frf.amplitude is not None
        curves.append(Curve(frf.label, frf.frequency, frf.amplitude, style=style, draw="points"))
    tests = [measurement.rec.scene.test for measurement, _ in sweeps]
    frequency = np.concatenate([np.asarray(curve.x, dtype=float) for curve in curves])
    for level in sorted({level for test in tests if test is not None for level in test.levels}):
        ends, force = [frequency.min(), frequency.max()], np.full(2, level)
        low, high = ((1.0 + sign * FORCE_TOLERANCE) * force for sign in (-1.0, 1.0))
        curves.append(Curve(f"required {level:g} N", ends, force, low, high, _REQUIRED))
    return [
        Chart(
            f"Force at each frequency, and the required force with its tolerance of {format_percent(FORCE_TOLERANCE)}.",
            f"Force from {frequency.min():.4g} to {frequency.max():.4g} Hz.",
            [Panel("force", "N", curves, height=150)],
            logarithmic=needs_logarithmic_axis(frequency),
        )
    ]


def _ranges(f: NDArray[np.float64], selected: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return the ends of the ranges of selected frequencies, each half way to the next frequency.

    >>> _ranges(np.arange(5.0), np.array([False, True, True, False, True]))
    [(0.5, 2.5), (3.5, 4.0)]
    """
    middle = np.concatenate([f[:1], (f[1:] + f[:-1]) / 2.0, f[-1:]])
    steps = np.diff(np.concatenate([[0], selected.astype(int), [0]]))
    ends = zip(middle[np.flatnonzero(steps > 0)], middle[np.flatnonzero(steps < 0)], strict=True)
    return [(min(a, b), max(a, b)) for a, b in ((float(f"{a:.8g}"), float(f"{b:.8g}")) for a, b in ends)]


def _percent_limits(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return the limits of the axis of relative bounds, which ends at 100 %: there the value is undetermined."""
    return min(_limits(curves)[0], 0.1 * _MAX_PERCENT), _MAX_PERCENT


def _limits(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return the limits of a logarithmic axis that show all values, but not all intervals."""
    values = np.concatenate([np.asarray(curve.y, dtype=float) for curve in curves])
    values = values[np.isfinite(values) & (values > 0)]
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
        impacts.append(Curve(motions[0].channel, frequency[order], count[order], style=style))
    if impacts:
        panels.append(Panel("impacts", "per period", impacts, height=170))
    energy = result.energy
    if energy is not None:
        percent, bound = (_percent(energy_part, energy.supplied) for energy_part in (energy.dampers, energy.bound))
        low, high = (percent - bound)[order], (percent + bound)[order]
        curve = Curve("dampers", frequency[order], percent[order], low, high, CurveStyle(DAMPER))
        panels.append(Panel("share of energy", "%", [curve], height=170, limits=(-5.0, 105.0)))
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
    damping: list[Curve] = []
    is_reference = [label == reference for label, _ in labeled_decays]
    for (label, result), style in zip(labeled_decays, recording_styles(is_reference), strict=True):
        envelopes.append(Curve(label, result.peak_time, result.peak, style=style))
        step = max(result.time.size // _INTERVALS, 1)
        energies.append(Curve(label, result.time[::step], result.energy[::step], style=style))
        for mode in result.modes:
            if mode.damping.size:
                percent, expanded = mode.percent
                name = f"{label}, {mode.center:.4g} Hz"
                order = np.argsort(mode.amplitude)
                low, high = (percent - expanded)[order], (percent + expanded)[order]
                amplitude = mode.amplitude[order]
                damping.append(Curve(name, amplitude, percent[order], low, high, style))
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
    if damping:
        charts.append(
            Chart(
                "Damping ratio against amplitude of the acceleration, with 95 % intervals.",
                "Damping ratio of each mode against the amplitude of the acceleration.",
                [Panel("damping ratio", "%", damping, height=240)],
                x_name="amplitude",
                x_unit="m/s²",
                logarithmic=True,
            )
        )
    return charts
