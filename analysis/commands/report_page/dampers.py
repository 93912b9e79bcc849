"""Charts of damper motion in a report: impacts per period, and dissipated energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.commands.figures.determined_lines import folds_back
from analysis.commands.report_page.charts import Chart, Curve, Panel, needs_logarithmic_axis, side_limits, symbol_curves
from analysis.commands.report_page.measurements import Measurement
from analysis.commands.report_page.responses import sweep_names, sweep_styles
from analysis.core.recordings.descriptions import excitation_text
from rig.core.base.palette import DAMPER, CurveStyle, location_style


def damper_charts(measurement: Measurement) -> list[Chart]:
    """Return a chart of impacts per period in each body and of energy dissipated by dampers; none without dampers."""
    results = measurement.dampers
    if not results:
        return []
    labels, is_single = [result.label for result in results], len(results) == 1
    names = sweep_names(labels, measurement.label)
    styles = sweep_styles(labels, measurement.label)
    impacts: dict[str, list[Curve]] = {}
    shares = list[Curve]()
    frequencies = [result.sweep.lines.frequency for result in results]
    draw = "dots" if any(each.size == 1 or folds_back(each) for each in frequencies) else "points"
    for result, frequency, name, style in zip(results, frequencies, names, styles, strict=True):
        order = np.arange(frequency.size) if draw == "dots" else np.argsort(frequency)
        for motions in result.bodies:
            place, count = motions[0].channel, np.array([sum(motion.impacts_per_period) for motion in motions])
            label, at = (place, location_style(measurement.rec.channels[place].at)) if is_single else (name, style)
            impacts.setdefault(place, []).append(Curve(label, frequency[order], count[order], style=at, draw=draw))
        energy = result.energy
        if energy is not None:
            percent, expanded = (_percent(part, energy.supplied)[order] for part in (energy.dampers, energy.expanded))
            label, at = ("dampers", CurveStyle(DAMPER)) if is_single else (name, style)
            is_limit = percent <= expanded
            value = np.where(is_limit, np.nan, percent)
            value, low, high = np.clip([value, percent - expanded, percent + expanded], 0.0, 100.0)
            shares.append(Curve(label, frequency[order], value, low, high, at, draw))
            shares += [replace(shares[-1], draw="through")] * (draw == "points")
            limits = zip(frequency[order][is_limit], high[is_limit], strict=True)
            shares += symbol_curves(label, at, "limits", limits)
    # Each body has a panel: equal numbers of impacts would hide each other.
    panels = [
        Panel(
            "impacts",
            "",
            curves,
            80,
            title=place,
            limits=(0.0, 1.1 * max(2.0, *(float(np.nanmax(curve.y, initial=0.0)) for curve in curves))),
        )
        for place, curves in impacts.items()
        if curves
    ]
    if shares:
        panels.append(
            Panel("dissipated energy", "%", shares, 150, limits=(-5.0, 105.0), ticks=[0.0, 25.0, 50.0, 75.0, 100.0])
        )
    if not panels:
        return []
    band = np.concatenate(frequencies)
    return [
        Chart(
            f"“{measurement.label}” ({excitation_text(measurement.rec)}): impacts per period, and dissipated energy",
            f"Damper impacts per period against frequency, {band.min():.4g} to {band.max():.4g} Hz.",
            panels,
            logarithmic=needs_logarithmic_axis(band),
            x_limits=side_limits(band) if any(curve.draw == "dots" for curve in panels[0].curves) else None,
            notes=[
                "Impacts on floor and ceiling; 0: none above the detection limit. The curve is interrupted where the "
                "motion is irregular or impacts may be missing. Energy: share of the supplied energy that the dampers "
                "dissipate, with its 95 % interval; triangles: upper ends of intervals that include zero."
            ],
        )
    ]


def _percent(part: NDArray[np.float64], total: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(total > 0, 100.0 * part / np.where(total > 0, total, 1.0), np.nan)
