"""Figure of what dampers did in a stepped sine: kind of motion in each body, and the energy they take out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from analysis.dampers.nonlinearity import DamperMotion
from analysis.dampers.performance import CycleEnergy
from rig.escaping import drawn
from rig.figure_style import COLOURS, cell_edges, drawing, frequency_axis, heading

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Kinds of motion in the order of the legend, with what each means.
_KINDS = {
    "riding": "rides on the floor",
    "I": "type I: flies, hits the floor once a period",
    "II": "type II: hits floor and ceiling once a period",
    "III": "type III: as II, staying at the ceiling",
    "other": "other pattern of impacts",
    "unseen": "flies, impacts too small to be seen",
}
_SHADES = dict(zip(_KINDS, ("#dcdcdc", *COLOURS[:4], "#8c8c8c"), strict=True))


def dampers_figure(
    motions: Sequence[Sequence[DamperMotion]],
    energy: CycleEnergy | None,
    title: str,
    true: np.ndarray | None = None,
) -> Figure:
    """Draw the motion of each damper along frequency and, where it is known, the energy a period.

    Parameters
    ----------
    motions : sequence of sequence of DamperMotion
        For each damped body, one at each frequency.
    energy : CycleEnergy or None
        At the same frequencies.
    true : ndarray, shape (frequencies,), optional
        Energy truly lost in impacts, J, where the truth was recorded.
    """
    frequency = np.array([one.frequency for one in motions[0]])
    order = np.argsort(frequency, kind="stable")
    with drawing(2.0 + 0.3 * len(motions) + (2.4 if energy is not None else 0.0)) as figure:
        heights = [0.45 * len(motions) + 0.15] + ([2.0] if energy is not None else [])
        rows = np.atleast_1d(figure.subplots(len(heights), 1, height_ratios=heights))
        strip = rows[0]
        borders = cell_edges(frequency[order], False)
        used = set()
        for row, body in enumerate(motions):
            kinds = [body[k].name.split(":")[0] for k in order]
            used |= set(kinds)
            for low, width, kind in zip(borders, np.diff(borders), kinds, strict=False):
                strip.broken_barh([(low, width)], (row - 0.35, 0.7), color=_SHADES[kind], ec="white", lw=0.3)
        strip.plot(frequency, np.full(frequency.size, len(motions) - 0.5), "|", color="black", ms=4, mew=0.8)
        strip.set_ylim(len(motions) - 0.3, -0.6)
        strip.set_yticks(range(len(motions)), [drawn(body[0].channel) for body in motions])
        strip.grid(False)
        for kind in _KINDS:
            if kind in used:
                strip.plot([], [], "s", color=_SHADES[kind], ms=6, label=_KINDS[kind])
        strip.plot([], [], "|", color="black", ms=6, label="frequency that was measured")
        heading(strip, title)
        if energy is not None:
            axes = rows[1]
            lines = {
                "supplied by the force": (energy.supplied, "#000000", "-"),
                "into the structure's damping": (energy.structure, "#777777", "-"),
                "into the dampers": (energy.dampers, COLOURS[1], "-"),
            }
            if true is not None:
                lines["truly lost in impacts"] = (true, COLOURS[2], ":")
            for name, (joule, shade, dashes) in lines.items():
                shown = np.where(joule > 0, 1e3 * joule, np.nan)[order]
                axes.plot(frequency[order], shown, color=shade, ls=dashes, marker="o", label=name)
            top = 1e3 * float(energy.supplied.max())
            axes.set_yscale("log")
            axes.set_ylim(top * 1e-4, top * 2.0)
            axes.set_ylabel("energy a period / mJ")
        for axes in rows:
            frequency_axis(axes, max(borders[0], 0.9 * frequency.min()), borders[-1], axes is rows[-1])
        figure.legend(loc="outside lower center", ncols=2)
        return figure
