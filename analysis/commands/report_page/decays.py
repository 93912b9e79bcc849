"""Charts of free decays in a report: envelope, energy, and damping ratio against amplitude."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.commands.figures.decay_figure import frequency_title, group_modes
from analysis.commands.report_page.charts import REQUIRED, Chart, Curve, Mark, Panel, symbol_curves
from analysis.commands.report_page.measurements import Measurement
from analysis.core.decays.free_decay import Decay
from analysis.core.decays.modal_decay import ModalDecay
from rig.core.base.palette import BASELINE, CurveStyle, recording_styles

# Number of drawn points of the energy; more would not be visible.
_MAX_POINTS = 1200
# The axis of damping ratios extends beyond the values by this factor, so that the ends of most intervals are visible.
_MARGIN = 3.0


def decay_charts(measurements: Sequence[Measurement], baseline_name: str) -> list[Chart]:
    """Return charts of the envelopes and energies of free decays, and of damping ratio against amplitude."""
    labeled_decays = [
        (measurement.label, measurement.decay) for measurement in measurements if measurement.decay is not None
    ]
    if not labeled_decays:
        return []
    envelopes, energies, marks = [], [], []
    is_baseline = [label == baseline_name for label, _ in labeled_decays]
    for (label, result), style in zip(labeled_decays, recording_styles(is_baseline), strict=True):
        for way in ("through", "points"):
            envelopes.append(Curve(label, result.peak_time, result.peak, style=style, draw=way))
        if np.isfinite(result.quiet_from):
            marks.append(Mark(result.quiet_from, result.gravity, f"{result.quiet_from:.2g} s", style.color))
        step = max(result.time.size // _MAX_POINTS, 1)
        energies.append(Curve(label, result.time[::step], result.energy[::step], style=style))
    channels = ", ".join(dict.fromkeys(result.channel for _, result in labeled_decays))
    ends = np.array([0.0, max(result.time[-1] for _, result in labeled_decays)])
    envelopes.append(Curve("1 g", ends, np.full(2, labeled_decays[0][1].gravity), style=REQUIRED))
    quiet = ((mark.x, mark.y) for mark in marks)
    envelopes += symbol_curves("below 1 g from this time", CurveStyle(BASELINE), "circles", quiet)
    charts = [
        Chart(
            f"Free decay of {channels}: peaks of the acceleration, and backward-integrated (Schroeder) energy",
            f"Free decay of {channels} over {ends[-1]:.3g} s.",
            [
                Panel("acceleration peaks", "m/s²", envelopes, height=220, logarithmic=True, marks=marks),
                Panel("energy", "dB", energies, height=160),
            ],
            x_name="time",
            x_unit="s",
            notes=["Thin lines only join the peaks."]
            + ["Labels: times from which every sample is below 1 g."] * bool(marks),
        )
    ]
    groups = group_modes([result for _, result in labeled_decays])
    if groups:
        charts.append(_damping_chart(groups, labeled_decays, recording_styles(is_baseline)))
    return charts


def _damping_chart(
    groups: Sequence[list[tuple[int, ModalDecay]]],
    labeled_decays: Sequence[tuple[str, Decay]],
    styles: Sequence[CurveStyle],
) -> Chart:
    """Return a chart of damping ratio against amplitude, with a panel for each mode; `groups`: from `group_modes`."""
    panels = []
    known = np.concatenate([mode.percent[0][mode.percent[0] > 0] for group in groups for _, mode in group])
    lowest, highest = (float(known.min()) / _MARGIN, _MARGIN * float(known.max())) if known.size else (0.1, 10.0)
    for group in groups:
        curves = []
        for index, mode in sorted(group, key=lambda pair: pair[0]):
            order = np.argsort(mode.amplitude)
            percent, expanded = (values[order] for values in mode.percent)
            # A logarithmic axis has no zero, so the band ends at the axis.
            low, high = np.maximum(percent - expanded, lowest), np.minimum(percent + expanded, highest)
            label, amplitude, style = labeled_decays[index][0], mode.amplitude[order], styles[index]
            is_limit = percent <= expanded
            known_values = np.where(is_limit, np.nan, percent)
            curves += [Curve(label, amplitude, known_values, low, high, style, draw) for draw in ("points", "through")]
            curves += symbol_curves(label, style, "limits", zip(amplitude[is_limit], high[is_limit], strict=True))
        limits = lowest, highest
        panels.append(Panel("ζ", "%", curves, 130, title=frequency_title(group), logarithmic=True, limits=limits))
    return Chart(
        "Damping ratio ζ of each mode against amplitude of the acceleration, with 95 % intervals",
        "Damping ratio of each mode against the amplitude of the acceleration.",
        panels,
        x_name="amplitude",
        x_unit="m/s²",
        logarithmic=True,
        notes=["Triangles: upper ends of intervals that include zero. Frequencies: see the decay table."],
    )
