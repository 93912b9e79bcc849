"""Stabilization diagrams of a report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.commands.report_page.charts import Chart, Curve, Mark, Panel, needs_logarithmic_axis
from analysis.commands.report_page.measurements import Measurement
from analysis.commands.report_page.responses import first_view
from analysis.core.modal.modes import pole_kinds
from rig.core.base.palette import BASELINE, CurveStyle

# Symbols and colors of the kinds of poles.
_POLE_STYLES = {
    "new pole": ("crosses", "#9aa2ab"),
    "stable": ("dots", BASELINE),
    "stable, no mode": ("circles", BASELINE),
}


def stabilization_charts(measurements: Sequence[Measurement]) -> list[Chart]:
    """Return the stabilization diagram of each recording's first sweep, all on one frequency axis."""
    identified = [
        (sweep, sweep.modes)
        for measurement in measurements
        for sweep in measurement.sweeps[:1]
        if sweep.modes is not None and sweep.modes.chart
    ]
    if not identified:
        return []
    band = np.concatenate([sweep.frfs[0].frequency for sweep, _ in identified])
    view = first_view(band, np.concatenate([modes.frequency for _, modes in identified]))
    charts, stated = [], set[str]()
    for sweep, modes in identified:
        top = float(max(pole.order for pole in modes.chart))
        ticks = np.arange(0.0, top + 1.0, 5.0).tolist()
        # Poles are symbols, not points of a series, because poles of several orders have the same frequency.
        curves = [
            Curve(kind, frequency, order, style=CurveStyle(color), draw=draw)
            for kind, (frequency, order) in pole_kinds(modes).items()
            for draw, color in [_POLE_STYLES[kind]]
        ]
        texts = {float(natural): modes.frequency_label(k) for k, natural in enumerate(modes.frequency)}
        texts |= {each.frequency: f"{each.frequency_label()}?" for each in modes.uncertain}
        marks = [Mark(natural, 0.0, texts[natural]) for natural in sorted(texts)]
        notes = [
            "Dotted lines: the identified modes, each with a column of stable poles.",
            "Two columns on either side of one line indicate a nonlinear mode.",
            "Question marks: uncertain modes." * bool(modes.uncertain),
            "Hollow: stable, but not identified as a mode." * any(curve.draw == "circles" for curve in curves),
        ]
        charts.append(
            Chart(
                f"{sweep.label}: poles of models of increasing order",
                f"Stabilization diagram of {sweep.label}.",
                [Panel("model order", "", curves, 130, limits=(0.0, 1.05 * top), ticks=ticks, marks=marks)],
                logarithmic=needs_logarithmic_axis(band),
                x_limits=(float(band.min()), float(band.max())),
                x_view=view,
                notes=[text for text in notes if text not in stated],
            )
        )
        stated.update(notes)
    return charts
