"""Figure of free decays: acceleration with envelope, envelope in dB scale, damping ratio against amplitude."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from analysis.decays.free_decay import Decay
from rig.escaping import escape_figure
from rig.figure_style import add_caption, add_title, color_of, new_figure, set_log_scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from analysis.decays.modal_decay import ModalDecay


# Modes of different recordings are considered the same if their relative frequency difference is smaller.
_MAX_FREQUENCY_DIFFERENCE = 0.15
# More frequencies are replaced by their range in the title of a panel.
_MAX_LISTED_FREQUENCIES = 3


def decay_figure(decays: Sequence[Decay], title: str) -> Figure:
    """Overlay decays: measured acceleration, logarithmic envelope, and damping ratio of each mode.

    `decays`: one decay for each recording.
    """
    columns = _columns(decays)
    gravity = decays[0].gravity
    with new_figure(8.2) as figure:
        rows = figure.add_gridspec(3, max(len(columns), 1), height_ratios=[1.25, 1.0, 1.0 if columns else 0.02])
        trace = figure.add_subplot(rows[0, :])
        level = figure.add_subplot(rows[1, :], sharex=trace)
        duration, lowest = max(_relevant_duration(decay) for decay in decays), decays[0].gravity
        for index, decay in enumerate(decays):
            shade = color_of(index)
            keep = decay.time <= duration
            trace.plot(decay.time[keep], decay.acceleration[keep], color=shade, lw=0.6, alpha=0.75)
            top = decay.outline()
            for sign in (1.0, -1.0):
                trace.plot(
                    decay.time[keep], sign * top[keep], color=shade, lw=1.4,
                    label=escape_figure(decay.label) if sign > 0 else None,
                )  # fmt: skip
            level.plot(decay.time[keep], top[keep], color=shade, lw=1.2)
            lowest = min(lowest, float(top[keep].min()))
            level.plot(decay.time[keep], top[0] * 10.0 ** (decay.energy[keep] / 20.0), color=shade, lw=1.6, ls="--")
        highest = max(float(decay.peak.max()) for decay in decays)
        trace.set_ylim(-1.1 * highest, 1.1 * highest)
        trace.set_xlim(0.0, duration)
        for sign in (1.0, -1.0):
            trace.axhline(sign * gravity, color="#777777", lw=0.8, ls=":")
        trace.set_ylabel("acceleration / (m/s²)")
        trace.tick_params(labelbottom=False)
        add_title(trace, title)
        if trace.get_legend_handles_labels()[0]:
            trace.legend(loc="upper right")
        set_log_scale(level.yaxis, 5)
        level.set_ylim(max(0.6 * lowest, 1e-3 * highest), 1.6 * highest)
        level.axhline(gravity, color="#777777", lw=0.8, ls=":")
        level.set_ylabel("envelope / (m/s²)")
        level.set_xlabel("time / s")
        add_caption(
            figure, "Envelope: largest acceleration within half a period of the lowest mode on either side.",
            "Dashed: square root of the backward-integrated (Schroeder) energy, from the same start. Dotted: 1 g.",
            *["Bands: 95 % interval of the damping ratio; a band down to the axis includes zero."][: len(columns)],
        )  # fmt: skip
        _damping_row(figure, rows, columns, gravity)
        return figure


def _damping_row(figure: Figure, rows: object, columns: list[list[tuple[int, ModalDecay]]], gravity: float) -> None:
    first: Axes | None = None
    for column, members in enumerate(columns):
        axes = figure.add_subplot(rows[2, column], sharey=first)  # type: ignore[index]
        first = first or axes
        for index, mode in members:
            shade, percent = color_of(index), 100.0 * mode.damping
            half = 200.0 * mode.damping_error
            axes.fill_between(mode.amplitude, percent - half, percent + half, color=shade, alpha=0.25, lw=0)
            axes.plot(mode.amplitude, percent, "o-", color=shade)
        amplitudes = np.concatenate([mode.amplitude for _, mode in members] + [np.array([gravity])])
        low, high = 0.8 * float(amplitudes.min()), 1.25 * float(amplitudes.max())
        axes.set_xlim(low, high)
        set_log_scale(axes.xaxis, 5)
        axes.axvline(gravity, color="#777777", lw=0.8, ls=":")
        axes.set_xlabel("amplitude / (m/s²)")
        axes.set_title(_frequencies(members), fontsize=9, fontweight="normal")
        if column == 0:
            axes.set_ylabel("damping ratio / %")
        else:
            axes.tick_params(labelleft=False)
    if first is not None:
        values = [100.0 * m.damping for members in columns for _, m in members]
        flat = np.concatenate(values)
        flat = flat[flat > 0]
        if flat.size:
            low, high = float(flat.min()), float(flat.max())
            # The axis includes uncertainty bands unless they are so wide that the curves would become too small.
            uncertainties = [200.0 * m.damping_error for members in columns for _, m in members]
            edges = np.concatenate(
                [v + sign * b for v, b in zip(values, uncertainties, strict=True) for sign in (-1, 1)]
            )
            inside = edges[(edges > 0.1 * low) & (edges < 10.0 * high)]
            low, high = min(low, *inside) / 1.3, max(high, *inside) * 1.3
            set_log_scale(first.yaxis, 6)
            first.set_ylim(low, high)


def _frequencies(members: list[tuple[int, ModalDecay]]) -> str:
    """List the frequencies of a mode in the order of the recordings, or their range if there are many."""
    listed = list(dict.fromkeys(f"{mode.frequency:.1f}" for _, mode in sorted(members, key=lambda member: member[0])))
    if len(listed) > _MAX_LISTED_FREQUENCIES:
        low, *_, high = sorted(listed, key=float)
        return f"{low} to {high} Hz"
    return f"{', '.join(listed)} Hz"


def _columns(decays: Sequence[Decay]) -> list[list[tuple[int, ModalDecay]]]:
    """Group modes with a known damping ratio by frequency, as pairs (index of the decay, mode)."""
    modes = sorted(
        ((index, mode) for index, decay in enumerate(decays) for mode in decay.modes if mode.damping.size),
        key=lambda pair: pair[1].frequency,
    )
    groups: list[list[tuple[int, ModalDecay]]] = []
    for pair in modes:
        if groups and pair[1].frequency < (1.0 + _MAX_FREQUENCY_DIFFERENCE) * groups[-1][0][1].frequency:
            groups[-1].append(pair)
        else:
            groups.append([pair])
    return groups


def _relevant_duration(decay: Decay) -> float:
    """Return the time after which the acceleration stays below 2 % of its maximum, or the whole duration."""
    end = decay.time_below(0.02 * float(abs(decay.acceleration).max()))
    return float(decay.time[-1]) if np.isnan(end) or end <= 0 else end
