"""Figure of damper motion in a stepped-sine test: type of motion in each body, and energy per period."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from analysis.core.damper_motion.dampers import Dampers
from analysis.core.damper_motion.energy_balance import EnergyBalance
from analysis.core.damper_motion.motion_types import MOTION_TEXTS, DamperMotion
from analysis.core.responses.spectral_lines import Lines
from rig.core.base.escaping import escape_figure
from rig.core.base.figure_style import add_legend_below, add_title, cell_edges, frequency_axis, log_axis, new_figure
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.palette import DAMPER, MOTIONS

# Legend entries of the motions by name (`DamperMotion.name`), in the order of the legend.
_LEGEND_TEXTS = {
    "riding": MOTION_TEXTS["riding"],
    "I": "Type I: flies, hits the floor once per period",
    "II": "Type II: floor and ceiling once per period",
    "III": "Type III: as II, but stays at the ceiling",
    "other": "other cycle of impacts",
    "unseen": "near 1 g: may fly below the detection limit",
    "uncertain": MOTION_TEXTS["uncertain"],
}
# Color of each known motion, as in the motion map.
_MOTION_COLORS = dict(zip(_LEGEND_TEXTS, (*MOTIONS[:5], "#ffffff", "#444444"), strict=True))


def dampers_figure(dampers: Dampers, title: str) -> Figure:
    """Draw the motion of the dampers in each body at each frequency and, if known, the energy per period."""
    motions, energy, lines = dampers.bodies, dampers.energy, dampers.sweep.lines
    frequencies = np.append(lines.frequency, lines.omitted)
    # A margin of 2 %, so the first and the last cell are not cut.
    low, high = 0.98 * float(frequencies.min()), 1.02 * float(frequencies.max())
    with new_figure(2.0 + 0.3 * len(motions) + (2.6 if energy is not None else 0.0)) as figure:
        heights = [0.45 * len(motions) + 0.15] + ([2.2] if energy is not None else [])
        rows = np.atleast_1d(figure.subplots(len(heights), 1, height_ratios=heights))
        _draw_motions(rows[0], motions)
        add_title(rows[0], title)
        if energy is not None:
            _draw_energies(rows[1], energy, lines, dampers.true_impact_energy)
        for frequency in lines.omitted:
            rows[0].plot(
                frequency, 0.0, "x", color="black", ms=5, clip_on=False, transform=rows[0].get_xaxis_transform()
            )
        for axes in rows:
            frequency_axis(axes, low, high, axes is rows[-1])
        add_legend_below(figure, *_caption(energy, lines))
        return figure


def _draw_motions(axes: Axes, motions: Sequence[Sequence[DamperMotion]]) -> None:
    """Draw one row for each body, with a cell for each measured frequency in the color of the type of motion."""
    drawn: set[str] = set()
    for row, body in enumerate(motions):
        axes.axhline(row, color="#d9d9d9", lw=0.8, zorder=0)
        distinct = np.unique([motion.frequency for motion in body])
        borders = cell_edges(distinct, True)
        edges = dict(zip(distinct.tolist(), pairwise(borders), strict=True))
        frequencies: dict[str, list[float]] = {}
        for motion in body:
            frequencies.setdefault(motion.name.split(":")[0], []).append(motion.frequency)
        for kind, frequency in frequencies.items():
            for low, high in (edges[each] for each in frequency):
                axes.fill_between([low, high], row - 0.35, row + 0.35, **_style(kind))
        drawn |= frequencies.keys()
    axes.set_ylim(len(motions) - 0.4, -0.6)
    axes.set_yticks(range(len(motions)), [escape_figure(body[0].channel) for body in motions])
    axes.grid(False, axis="y")
    for kind, text in _LEGEND_TEXTS.items():
        if kind in drawn:
            axes.fill_between([], [], [], **_style(kind), label=text)


def _style(kind: str) -> dict[str, Any]:
    """Return the style of the cells of a motion; a motion that is not known is hatched."""
    hatch = {"hatch": "/////", "edgecolor": "#8c8c8c"} if kind == "unseen" else {}
    return {"facecolor": _MOTION_COLORS[kind], "lw": 0, **hatch}


def _draw_energies(axes: Axes, energy: EnergyBalance, lines: Lines, true_loss: np.ndarray | None) -> None:
    """Draw the energies against frequency; damper energies whose interval includes zero are drawn as upper limits."""
    order = np.argsort(energy.frequency, kind="stable")
    frequency = energy.frequency[order]
    gaps = np.searchsorted(frequency, np.sort(lines.omitted))
    frequency_with_gaps = np.insert(frequency, gaps, np.nan)

    def draw_energy(joules: np.ndarray, **style: Any) -> None:
        axes.plot(frequency_with_gaps, np.insert(1e3 * joules[order], gaps, np.nan), **style)

    is_determined = energy.dampers > energy.expanded
    into_dampers = np.where(is_determined, energy.dampers, np.nan)
    # A wide line remains visible around the energy of the dampers, where it is nearly all of the supplied energy.
    draw_energy(energy.supplied, color="#bdbdbd", lw=5.0, solid_capstyle="round", label="supplied by the force")
    draw_energy(energy.structure, color="#555555", marker="o", label="dissipated by the structure (scene's damping)")
    draw_energy(into_dampers, color=DAMPER, marker="o", label="dissipated by the dampers")
    axes.errorbar(
        energy.frequency, 1e3 * into_dampers, 1e3 * energy.expanded, fmt="none", ecolor=DAMPER, elinewidth=0.9
    )
    upper_bound = 1e3 * np.maximum(energy.dampers + energy.expanded, 0.0)
    axes.plot(
        energy.frequency[~is_determined], upper_bound[~is_determined], "v", mfc="none", ms=3.5, mew=0.9,
        color=DAMPER, label="dissipated by the dampers, upper limit",
    )  # fmt: skip
    plotted = [1e3 * energy.supplied, 1e3 * energy.structure, 1e3 * into_dampers, upper_bound[~is_determined]]
    if true_loss is not None:
        positive_loss = np.where(true_loss > 0, true_loss, np.nan)
        draw_energy(positive_loss, color="#a06a00", ls=":", marker="o", label="true loss in impacts")
        plotted.append(1e3 * positive_loss)
    if lines.unsteady is not None and lines.unsteady.any():
        marked = energy.frequency[lines.unsteady], 1e3 * energy.supplied[lines.unsteady]
        # With a white edge, crosses are visible on the points.
        for color, width in (("white", 3.5), ("black", 1.3)):
            axes.plot(*marked, "x", color=color, ms=8, mew=width, zorder=5)
    log_axis(axes, plotted)
    axes.set_ylabel("energy per period / mJ")


def _caption(energy: EnergyBalance | None, lines: Lines) -> list[str]:
    """Explain error bars and markers in sentences."""
    sentences = []
    if energy is not None:
        sentences.append("Bars: 95 % intervals of the energy (most are smaller than the points).")
    if lines.unsteady is not None and lines.unsteady.any():
        sentences.append("Crosses: steady state not reached.")
    if lines.omitted.size:
        sentences.append("Crosses on the axis: omitted frequencies (see the warnings).")
    return sentences
