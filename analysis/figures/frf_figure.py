"""Figure of frequency responses: magnitude with its 95 % band, phase, coherence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from analysis.responses.frf import Frf
from rig.escaping import drawn
from rig.figure_style import colour, decades, drawing, frequency_axis, heading, note

Array = NDArray[np.float64]

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Curves with more points than this are drawn without a dot at each.
DOTS = 120
# Points over which the roughness of a curve is judged.
_AROUND = 25
# Where less of the response than this repeats with the reference, it is not drawn like a measurement.
_COHERENT = 0.5
# Systematic parts below this share of the curve cannot be seen.
_VISIBLE = 3e-3
THEORY, NOISE = "#555555", "#c4c4c4"


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
    theory : sequence of Frf
        Curves without error bars, drawn thin and dashed in the colour of the response they belong to.
    marks : sequence of (frequency in Hz, text)
        Vertical lines, such as jumps.
    """
    low = min(float(frf.frequency.min()) for frf in frfs)
    high = max(float(frf.frequency.max()) for frf in frfs)
    if high <= low:
        low, high = low / 1.2, high * 1.2
    shades = {frf.response: colour(index) for index, frf in reversed(list(enumerate(frfs)))}
    several = len(shades) > 1
    with drawing(6.4) as figure:
        upper, middle, lower = figure.subplots(3, 1, height_ratios=[3.2, 1.3, 0.9])
        for curve in theory:
            shade = shades.get(curve.response, THEORY) if several else THEORY
            style: dict[str, Any] = {"color": shade, "lw": 0.9, "ls": (0, (5, 2)), "zorder": 1}
            upper.plot(curve.frequency, curve.shown_in[1] * abs(curve.value), **style)
            middle.plot(*_broken(curve.frequency, phase_degrees(curve)), **style)
        if theory:
            upper.plot([], [], color=THEORY, lw=0.9, ls=(0, (5, 2)), label=drawn(theory[0].label))
        for index, measured in enumerate(frfs):
            _curve(measured, colour(index), upper, middle, lower)
        for frequency, text in marks:
            upper.axvline(frequency, color="#777777", lw=0.8, ls=":")
            upper.annotate(
                text, (frequency, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -3),
                textcoords="offset points", va="top", fontsize=7.5, color="#555555",
            )  # fmt: skip
        unit, factor = frfs[0].shown_in
        decades(upper, [factor * abs(frf.value) for frf in [*frfs, *theory]])
        for axes, last in ((upper, False), (middle, False), (lower, True)):
            frequency_axis(axes, low, high, last)
        name = drawn(frfs[0].name)
        upper.set_ylabel(f"|{name}| / ({unit})" if "/" in unit else name)
        heading(upper, title)
        if upper.get_legend_handles_labels()[0]:
            upper.legend(loc="best")
        middle.set_ylabel("phase / °")
        middle.set_yticks([-270, -180, -90, 0, 90])
        middle.set_ylim(-285, 105)
        lower.set_ylabel("coherence")
        lower.set_ylim(-0.03, 1.06)
        lower.set_yticks([0, 0.5, 1])
        if all(np.all(frf.degrees == 0) for frf in frfs):
            lower.annotate(
                "one average: no coherence and no confidence band", (0.5, 0.5), xycoords="axes fraction",
                ha="center", va="center", fontsize=8, color="#555555",
            )  # fmt: skip
        figure.align_ylabels([upper, middle, lower])
        notes = ["shaded dark: 95 % of the scatter"] if any(np.any(frf.degrees > 0) for frf in frfs) else []
        parts = dict.fromkeys(name for frf in frfs for name in shown_parts(frf))
        if parts:
            notes.append(f"shaded light: {', '.join(parts)}, at most")
        if not all(told(frf).all() for frf in frfs):
            notes.append("grey: within the noise, phase left out")
        if any(frf.unsteady is not None and frf.unsteady.any() for frf in frfs):
            notes.append("crosses: not steady")
        note(figure, *notes)
        return figure


def _curve(frf: Frf, shade: str, upper: Axes, middle: Axes, lower: Axes) -> None:
    """Draw one measured curve into the three panels."""
    # A pass downwards has open marks, larger, so that one upwards shows through where they agree.
    falls = frf.frequency.size > 1 and frf.frequency[0] > frf.frequency[-1]
    frf = frf.sorted()
    few = frf.frequency.size <= DOTS
    look: dict[str, Any] = {"marker": "o" if few else None, "color": shade, "zorder": 2.9 if falls else 3}
    if falls:
        look |= {"mfc": "none", "ms": 5.0, "mew": 0.9}
    factor, clear = frf.shown_in[1], told(frf)
    size, half = factor * abs(frf.value), factor * np.nan_to_num(frf.band())
    systematic = frf.systematic_bound()
    whole = np.hypot(half, np.where(np.isfinite(systematic), factor * systematic, size))
    for reach, strength in ((whole, 0.13), (half, 0.25)):
        upper.fill_between(
            frf.frequency, np.maximum(size - reach, size * 1e-3), size + reach, where=clear, color=shade,
            alpha=strength, lw=0,
        )  # fmt: skip
    if not clear.all():
        # A point on either side, so that the line does not break where it turns grey.
        noisy = ~clear | ~np.roll(clear, 1) | ~np.roll(clear, -1)
        upper.plot(frf.frequency, np.where(noisy, size, np.nan), color=NOISE, lw=0.7, zorder=2)
    upper.plot(frf.frequency, np.where(clear, size, np.nan), label=drawn(frf.label), **look)
    if frf.unsteady is not None and frf.unsteady.any():
        upper.plot(frf.frequency[frf.unsteady], size[frf.unsteady], "x", color=shade, markersize=6, zorder=4)
    angle = np.where(clear, phase_degrees(frf), np.nan)
    for reach, strength in ((whole, 0.13), (half, 0.25)):
        turn = np.degrees(np.arcsin(np.minimum(reach / np.maximum(size, 1e-300), 1.0)))
        where, centre = _broken(frf.frequency, angle)
        wide = _broken(frf.frequency, angle, turn)[1]
        middle.fill_between(where, centre - wide, centre + wide, color=shade, alpha=strength, lw=0)
    middle.plot(*_broken(frf.frequency, angle), **look)
    if np.any(frf.degrees > 0):
        lower.plot(frf.frequency, frf.coherence, color=shade, zorder=3)


def shown_parts(frf: Frf) -> list[str]:
    """Names of the systematic parts that can be seen anywhere along a curve."""
    return [name for name, part in frf.systematic.items() if np.any(part > _VISIBLE * abs(frf.value))]


def told(frf: Frf) -> NDArray[np.bool_]:
    """Whether each point stands out of its noise: most of it repeats with the reference, its phase is known.

    By coherence and error bar where there are any, else by how roughly the curve runs from point to point.
    """
    size = np.maximum(abs(frf.value), 1e-300)
    if np.isfinite(frf.error).all():
        return np.asarray((frf.error < 0.5 * size) & (frf.coherence > _COHERENT))
    if size.size < 2 * _AROUND:
        return np.ones(size.size, dtype=bool)
    rough = abs(np.diff(frf.value, 2, prepend=frf.value[0], append=frf.value[-1])) / np.sqrt(6.0)
    return np.asarray(median_filter(rough / size, _AROUND, mode="nearest") < 0.35)


def _broken(frequency: Array, angle: Array, values: Array | None = None) -> tuple[Array, Array]:
    """Break a line, that of the angle unless told, where the phase wraps round."""
    with np.errstate(invalid="ignore"):
        wraps = np.flatnonzero(abs(np.diff(angle)) > 180.0) + 1
    return np.insert(frequency, wraps, np.nan), np.insert(angle if values is None else values, wraps, np.nan)


def phase_degrees(frf: Frf) -> Array:
    """Phase in degrees, from -270 to 90: cut where it runs steeply, not at the half turn it stays at."""
    return 90.0 - np.mod(90.0 - np.degrees(np.angle(frf.value)), 360.0)
