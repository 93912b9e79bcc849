"""Figure of frequency responses: magnitude with its 95 % band, phase, coherence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.figures import colour, decades, drawing, frequency_axis
from analysis.frf import Frf

Array = NDArray[np.float64]

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Curves with more points than this are drawn without a dot at each.
_DOTS = 400


def frf_figure(
    frfs: Sequence[Frf],
    title: str,
    theory: Sequence[Frf] = (),
    marks: Sequence[tuple[float, str]] = (),
) -> Figure:
    """Overlay measured curves.

    Parameters
    ----------
    frfs : sequence of Frf
        Curves of one kind (same motion and reference); the legend shows their labels.
    title : str
        Heading.
    theory : sequence of Frf
        Curves without error bars, drawn thin and grey.
    marks : sequence of (frequency in Hz, text)
        Vertical lines, such as jumps.
    """
    low = min(float(frf.frequency.min()) for frf in frfs)
    high = max(float(frf.frequency.max()) for frf in frfs)
    if high <= low:
        low, high = low / 1.2, high * 1.2
    with drawing(6.4) as figure:
        upper, middle, lower = figure.subplots(3, 1, height_ratios=[3.2, 1.3, 0.9])
        for curve in theory:
            upper.plot(
                curve.frequency, abs(curve.value), color="#777777", lw=0.9, label=curve.label, zorder=1
            )
            middle.plot(*_broken(curve.frequency, phase_degrees(curve)), color="#777777", lw=0.9, zorder=1)
        for index, measured in enumerate(frfs):
            frf = measured.sorted() if measured.frequency[0] > measured.frequency[-1] else measured
            shade = colour(index)
            dots = "o" if frf.frequency.size <= _DOTS else None
            size, half = abs(frf.value), np.nan_to_num(frf.band())
            upper.fill_between(
                frf.frequency,
                np.maximum(size - half, size * 1e-3),
                size + half,
                color=shade,
                alpha=0.25,
                lw=0,
            )
            upper.plot(frf.frequency, size, marker=dots, color=shade, label=frf.label, zorder=3)
            turn = np.degrees(np.arcsin(np.minimum(half / np.maximum(size, 1e-300), 1.0)))
            angle = phase_degrees(frf)
            middle.fill_between(frf.frequency, angle - turn, angle + turn, color=shade, alpha=0.25, lw=0)
            middle.plot(*_broken(frf.frequency, angle), marker=dots, color=shade, zorder=3)
            lower.plot(frf.frequency, frf.coherence, color=shade, zorder=3)
        for frequency, text in marks:
            upper.axvline(frequency, color="#777777", lw=0.8, ls=":")
            upper.annotate(
                text, (frequency, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -3),
                textcoords="offset points", va="top", fontsize=7.5, color="#555555",
            )  # fmt: skip
        decades(upper, [abs(frf.value) for frf in [*frfs, *theory]])
        for axes, last in ((upper, False), (middle, False), (lower, True)):
            frequency_axis(axes, low, high, last)
        upper.set_ylabel(f"|{frfs[0].name}| / ({frfs[0].unit})" if "/" in frfs[0].unit else frfs[0].name)
        upper.set_title(title)
        upper.legend(loc="best")
        middle.set_ylabel("phase / °")
        middle.set_yticks([-180, -90, 0, 90, 180])
        middle.set_ylim(-200, 200)
        lower.set_ylabel("coherence")
        lower.set_ylim(-0.03, 1.06)
        lower.set_yticks([0, 0.5, 1])
        figure.align_ylabels([upper, middle, lower])
        figure.text(
            0.995, 0.003, "shaded: 95 % confidence", ha="right", va="bottom", fontsize=7, color="#777777"
        )
        return figure


def _broken(frequency: Array, angle: Array) -> tuple[Array, Array]:
    """Break the line where the phase wraps round."""
    wraps = np.flatnonzero(abs(np.diff(angle)) > 180.0) + 1
    return np.insert(frequency, wraps, np.nan), np.insert(angle, wraps, np.nan)


def phase_degrees(frf: Frf) -> Array:
    """Phase in degrees; points near ±180 are drawn on the side of the neighbour before them."""
    angle = np.degrees(np.angle(frf.value))
    near = np.flatnonzero(abs(abs(angle) - 180.0) < 15.0)
    for i in near:
        before = angle[i - 1] if i else -1.0
        if before * angle[i] < 0 and abs(before - angle[i]) > 180.0:
            angle[i] -= np.sign(angle[i]) * 360.0
    return angle
