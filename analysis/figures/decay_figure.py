"""Figure of free decays: acceleration with envelopes, their logarithm, damping ratio against amplitude."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.decays.free_decay import Decay
from analysis.figures.style import colour, drawing, heading, plain_logarithmic, plain_ticks
from rig.escaping import drawn

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from analysis.decays.modal_decay import ModalDecay

Array = NDArray[np.float64]

# Two modes of different recordings are the same one when their frequencies differ by less than this.
_SAME_MODE = 0.15


def decay_figure(decays: Sequence[Decay], title: str) -> Figure:
    """Overlay decays: what the sensor saw, how fast it died away, and the damping behind it.

    Parameters
    ----------
    decays : sequence of Decay
        One per recording.
    """
    columns = _columns(decays)
    gravity = decays[0].gravity
    with drawing(8.2) as figure:
        rows = figure.add_gridspec(3, max(len(columns), 1), height_ratios=[1.25, 1.0, 1.0])
        trace = figure.add_subplot(rows[0, :])
        level = figure.add_subplot(rows[1, :], sharex=trace)
        shown = max(_interesting(decay) for decay in decays)
        for index, decay in enumerate(decays):
            shade = colour(index)
            keep = decay.time <= shown
            trace.plot(decay.time[keep], decay.acceleration[keep], color=shade, lw=0.6, alpha=0.75)
            peaks = decay.peak_time <= shown
            for sign in (1.0, -1.0):
                trace.plot(
                    decay.peak_time[peaks], sign * decay.peak[peaks], color=shade, lw=1.4,
                    label=drawn(decay.label) if sign > 0 else None,
                )  # fmt: skip
            # By its peaks: the analytic signal of several modes beats below them down to nothing.
            level.plot(decay.peak_time[peaks], decay.peak[peaks], color=shade, lw=1.2)
            level.plot(
                decay.time[keep], decay.envelope.max() * 10.0 ** (decay.energy[keep] / 20.0),
                color=shade, lw=1.6, ls="--",
            )  # fmt: skip
        highest = max(float(decay.peak.max()) for decay in decays)
        trace.set_ylim(-1.1 * highest, 1.1 * highest)
        trace.set_xlim(0.0, shown)
        for sign in (1.0, -1.0):
            trace.axhline(sign * gravity, color="#777777", lw=0.8, ls=":")
        trace.annotate(
            "g",
            (1.0, gravity),
            xycoords=("axes fraction", "data"),
            xytext=(2, -3),
            textcoords="offset points",
            fontsize=8,
            color="#555555",
        )
        trace.set_ylabel("acceleration / (m/s²)")
        trace.tick_params(labelbottom=False)
        heading(trace, title)
        if trace.get_legend_handles_labels()[0]:
            trace.legend(loc="upper right")
        level.set_yscale("log")
        level.set_ylim(1e-3 * highest, 1.6 * highest)
        level.axhline(gravity, color="#777777", lw=0.8, ls=":")
        level.set_ylabel("envelope / (m/s²)")
        level.set_xlabel("time after the hit / s")
        level.annotate(
            "solid: peaks; dashed: energy still to come (Schroeder); below, shaded: 95 % bound", (1.0, 1.0),
            xycoords="axes fraction",
            ha="right", va="top", fontsize=7.5, color="#555555",
        )  # fmt: skip
        _damping_row(figure, rows, columns, gravity)
        return figure


def _damping_row(
    figure: Figure, rows: object, columns: list[list[tuple[int, ModalDecay]]], gravity: float
) -> None:
    first: Axes | None = None
    for column, members in enumerate(columns):
        axes = figure.add_subplot(rows[2, column], sharey=first)  # type: ignore[index]
        first = first or axes
        for index, mode in members:
            if mode.amplitude.size:
                shade, percent = colour(index), 100.0 * mode.damping
                half = 200.0 * mode.damping_error
                axes.fill_between(
                    mode.amplitude, percent - half, percent + half, color=shade, alpha=0.25, lw=0
                )
                axes.plot(mode.amplitude, percent, "o-", color=shade)
        plain_logarithmic(axes, [mode.amplitude for _, mode in members] + [np.array([gravity])])
        axes.axvline(gravity, color="#777777", lw=0.8, ls=":")
        axes.set_xlabel("amplitude / (m/s²)")
        axes.set_title(f"{members[0][1].frequency:.1f} Hz", fontsize=9, fontweight="normal")
        if column == 0:
            axes.set_ylabel("damping ratio / %")
            axes.set_yscale("log")
            from matplotlib.ticker import FuncFormatter, NullFormatter

            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        else:
            axes.tick_params(labelleft=False)
    if first is not None:
        values = [100.0 * m.damping for members in columns for _, m in members if m.damping.size]
        flat = np.concatenate(values) if values else np.array([1.0])
        flat = flat[flat > 0]
        if flat.size:
            low, high = float(flat.min()) / 1.5, float(flat.max()) * 1.5
            first.set_ylim(low, high)
            first.set_yticks(plain_ticks(low, high))


def _columns(decays: Sequence[Decay]) -> list[list[tuple[int, ModalDecay]]]:
    """Group the modes of all decays by frequency, each with the index of its decay."""
    every = sorted(
        ((index, mode) for index, decay in enumerate(decays) for mode in decay.modes),
        key=lambda pair: pair[1].frequency,
    )
    groups: list[list[tuple[int, ModalDecay]]] = []
    for pair in every:
        if groups and pair[1].frequency < (1.0 + _SAME_MODE) * groups[-1][0][1].frequency:
            groups[-1].append(pair)
        else:
            groups.append([pair])
    return groups


def _interesting(decay: Decay) -> float:
    """Time until the envelope has fallen to 1 % of its start, or all there is."""
    end = decay.time_below(0.02 * float(abs(decay.acceleration).max()))
    return float(decay.time[-1]) if np.isnan(end) or end <= 0 else end
