"""Figure of free decays: acceleration, envelope on a logarithmic scale, damping ratio against amplitude."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from analysis.core.decays.free_decay import Decay
from analysis.core.decays.modal_decay import ModalDecay
from rig.core.base.escaping import escape_figure
from rig.core.base.figure_style import add_legend_below, add_title, new_figure, set_log_scale
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.palette import CurveStyle, body_style
from rig.core.results.text import format_decimals

# Largest relative difference of the frequencies of one mode in different recordings: moving dampers shift them.
_MAX_FREQUENCY_DIFFERENCE = 0.15


def decay_figure(decays: Sequence[Decay], title: str, styles: Sequence[CurveStyle] = ()) -> Figure:
    """Overlay decays: measured acceleration, logarithmic envelope, and damping ratio of each mode.

    `decays`: one decay for each recording; `styles`: styles of the decays, by default those of bodies 1, 2, ...
    """
    styles = styles or [body_style(number) for number in range(1, len(decays) + 1)]
    modes = group_modes(decays)
    gravity = decays[0].gravity
    with new_figure(8.2) as figure:
        rows = figure.add_gridspec(3, max(len(modes), 1), height_ratios=[1.25, 1.0, 1.0 if modes else 0.02])
        waveform_axes = figure.add_subplot(rows[0, :])
        envelope_axes = figure.add_subplot(rows[1, :], sharex=waveform_axes)
        # The vertical axis always includes 1 g.
        duration, lowest = max(_relevant_duration(decay) for decay in decays), decays[0].gravity
        for decay, style in zip(decays, styles, strict=True):
            color = style.color
            shown = decay.time <= duration
            waveform_axes.plot(decay.time[shown], decay.acceleration[shown], color=color, lw=0.6, alpha=0.75)
            envelope = decay.envelope
            for sign in (1.0, -1.0):
                waveform_axes.plot(
                    decay.time[shown], sign * envelope[shown], color=color, lw=1.4,
                    label=escape_figure(decay.label) if sign > 0 else None,
                )  # fmt: skip
            envelope_axes.plot(decay.time[shown], envelope[shown], color=color, lw=1.2)
            envelope_axes.plot(decay.peak_time, decay.peak, style.marker, color=color, ms=3.0)
            ring: Any = {"mfc": "white", "mec": color, "mew": 1.0, "ms": 5.5, "zorder": 3}
            envelope_axes.plot(decay.quiet_from, gravity, "o", **ring)
            lowest = min(lowest, float(envelope[shown].min()))
            envelope_axes.plot(
                decay.time[shown], envelope[0] * 10.0 ** (decay.energy[shown] / 20.0), color=color, lw=1.6, ls="--"
            )
        highest = max(float(decay.peak.max()) for decay in decays)
        waveform_axes.set_ylim(-1.1 * highest, 1.1 * highest)
        waveform_axes.set_xlim(0.0, duration)
        for sign in (1.0, -1.0):
            waveform_axes.axhline(sign * gravity, color="#777777", lw=0.8, ls=":")
        waveform_axes.set_ylabel("acceleration / (m/s²)")
        waveform_axes.tick_params(labelbottom=False)
        add_title(waveform_axes, title)
        set_log_scale(envelope_axes.yaxis, 5)
        # At most three decades: below, the envelope is mostly noise.
        envelope_axes.set_ylim(max(0.6 * lowest, 1e-3 * highest), 1.6 * highest)
        envelope_axes.axhline(gravity, color="#777777", lw=0.8, ls=":")
        envelope_axes.set_ylabel("envelope / (m/s²)")
        envelope_axes.set_xlabel("time / s")
        _draw_damping(figure, rows, modes, gravity, styles)
        has_ring = any(np.isfinite(decay.quiet_from) for decay in decays)
        add_legend_below(
            figure, "Envelope at each instant: largest acceleration within half a period of the lowest mode on either "
                "side.",
            f"Points: peaks{'; ring: from this time on, every sample is below 1 g' * has_ring}.",
            "Dashed: square root of the backward-integrated (Schroeder) energy, scaled to the start of the envelope. "
            "Dotted: 1 g.",
            "Bands: 95 % intervals of the damping ratio; triangles: upper ends of those with zero." * bool(modes),
        )  # fmt: skip
        return figure


def _draw_damping(
    figure: Figure,
    rows: object,
    modes: list[list[tuple[int, ModalDecay]]],
    gravity: float,
    styles: Sequence[CurveStyle],
) -> None:
    """Draw the damping ratio against amplitude, one panel for each mode; `modes`: from `group_modes`."""
    first: Axes | None = None
    for column, decays_of_mode in enumerate(modes):
        axes = figure.add_subplot(rows[2, column], sharey=first)  # type: ignore[index]
        first = first or axes
        for index, mode in decays_of_mode:
            color, (percent, expanded) = styles[index].color, mode.percent
            axes.fill_between(mode.amplitude, percent - expanded, percent + expanded, color=color, alpha=0.25, lw=0)
            # Where an interval includes zero, tables state its upper end.
            is_limit = percent <= expanded
            axes.plot(mode.amplitude, np.where(is_limit, np.nan, percent), f"{styles[index].marker}-", color=color)
            axes.plot(mode.amplitude[is_limit], (percent + expanded)[is_limit], "v", mfc="none", mec=color, ms=5.0)
        amplitudes = np.concatenate([mode.amplitude for _, mode in decays_of_mode] + [np.array([gravity])])
        axes.set_xlim(0.8 * float(amplitudes.min()), 1.25 * float(amplitudes.max()))
        set_log_scale(axes.xaxis, 5)
        axes.axvline(gravity, color="#777777", lw=0.8, ls=":")
        axes.set_xlabel("amplitude / (m/s²)")
        axes.set_title(frequency_title(decays_of_mode), y=1.0, fontsize=9, fontweight="normal")
        if column == 0:
            axes.set_ylabel("damping ratio / %")
        else:
            axes.tick_params(labelleft=False)
    if first is not None:
        values = [100.0 * m.damping for decays_of_mode in modes for _, m in decays_of_mode]
        positive = np.concatenate(values)
        positive = positive[positive > 0]
        if positive.size:
            low, high = float(positive.min()), float(positive.max())
            # The axis includes the edges of the 95 % bands, unless the curves would then become too small.
            half_bands = [m.percent[1] for decays_of_mode in modes for _, m in decays_of_mode]
            edges = np.concatenate(
                [value + sign * each for value, each in zip(values, half_bands, strict=True) for sign in (-1, 1)]
            )
            included_edges = edges[(edges > 0.1 * low) & (edges < 10.0 * high)]
            low, high = min([low, *included_edges]) / 1.3, max([high, *included_edges]) * 1.3
            set_log_scale(first.yaxis, 6)
            first.set_ylim(low, high)


def frequency_title(decays_of_mode: list[tuple[int, ModalDecay]]) -> str:
    """Return the frequency of a mode, or the range of its frequencies in the recordings."""
    frequencies = [mode.frequency for _, mode in decays_of_mode]
    low, high = (format_decimals(extreme(frequencies), 1) for extreme in (min, max))
    return f"mode at {low} Hz" if low == high else f"mode at {low} to {high} Hz"


def group_modes(decays: Sequence[Decay]) -> list[list[tuple[int, ModalDecay]]]:
    """Group modes with damping ratios by frequency; a group has pairs (index of the decay, its mode)."""
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
    """Return the time in s after which the acceleration stays below 2 % of its maximum, or the whole duration."""
    end = decay.time_below(0.02 * float(abs(decay.acceleration).max()))
    return float(decay.time[-1]) if np.isnan(end) or end <= 0 else end
