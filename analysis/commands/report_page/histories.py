"""Charts of time histories and spectrograms; a recording longer than memory is read block by block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy import fft

from analysis.commands.report_page.charts import IMAGE_SPAN_DB, Chart, Curve, EvenlySpaced, Panel, level_image
from rig.core.base.arrays import Array
from rig.core.base.palette import location_styles
from rig.core.system.structural_model import structural_model

if TYPE_CHECKING:
    from daq.core.recording.recording import Recording


# Every sample of a recording is drawn up to this number of samples, summed over the channels. A longer recording is
# divided into intervals, and the smallest and largest value of each interval are drawn.
_MAX_SAMPLES = 60_000
# A long recording is divided into this number of intervals.
_INTERVALS = 1500
# Maximum number of channels with panels of their own; more would make a page too long.
_MAX_PANELS = 8
# Limits of an axis, relative to the largest value.
_AXIS_MARGIN = 1.05
# An axis begins at this negative fraction of the largest value if no value is below it.
_ONE_SIDED = 0.1
# Maximum number of spectra in a spectrogram; more would not be visible in its width.
_SPECTRA = 240
# Spectral lines in each spectrum; more would not be visible in its height.
_LINES = 128
# A spectrogram ends at this multiple of the highest natural frequency of the structure.
_MAX_FREQUENCY_RATIO = 3.0
# A block has at least this number of samples; a shorter block has too little frequency resolution.
_MIN_BLOCK = 64


def time_histories(rec: Recording, names: Sequence[str]) -> Chart:
    """Return a chart of channels against time: every sample, or the envelope of a long recording."""
    is_complete = rec.samples * len(names) <= _MAX_SAMPLES
    time: Array | EvenlySpaced = EvenlySpaced(0.0, 1.0 / rec.rate, rec.samples)
    if is_complete:
        rows = np.stack([rec.read(name) for name in names])
    else:
        time, rows = _extremes(rec, names)
    units = list(dict.fromkeys(rec.channels[name].unit for name in names))
    panels = []
    # Solid lines, because dashes would look like samples.
    styles = [style._replace(dashes=()) for style in location_styles([rec.channels[name].at for name in names])]
    for unit in units:
        selected = [name for name in names if rec.channels[name].unit == unit]
        scale, shown_unit = (1e3, "mm") if unit == "m" else (1.0, unit.replace("^2", "²"))
        places = [names.index(name) for name in selected]
        curves = [Curve(names[k], time, scale * rows[k], style=styles[k]) for k in places]
        # In one panel, channels would hide each other. Panels of the same unit have the same limits.
        largest = _AXIS_MARGIN * scale * float(np.nanmax(abs(rows[places]), initial=0.0)) or 1.0
        # The force of a hammer has one sign.
        is_positive = scale * float(np.nanmin(rows[places], initial=0.0)) > -_ONE_SIDED * largest
        limits = (-_ONE_SIDED * largest if is_positive else -largest, largest)
        groups = [[curve] for curve in curves] if len(names) <= _MAX_PANELS else [curves]
        for group in groups:
            quantity = group[0].label if len(group) == 1 else rec.channels[selected[0]].quantity
            height = 90 if len(group) == 1 else 170
            panels.append(Panel(quantity, shown_unit, group, height, limits=limits))
    resolution = "every sample" if is_complete else f"largest and smallest value of each of {_INTERVALS} intervals"
    part = f" of {len(names)} of {len(rec.channels)} channels" * (len(names) < len(rec.channels))
    return Chart(
        f"Time histories{part}, {resolution}",
        f"Time histories of the channels {', '.join(names)} over {rec.duration:.4g} s.",
        panels,
        x_name="time",
        x_unit="s",
        names=names,
    )


def _extremes(rec: Recording, names: Sequence[str]) -> tuple[Array, Array]:
    """Return the minimum and maximum of each interval, alternating: time in s, (2 n,), and values, (channels, 2 n)."""
    edges = np.linspace(0, rec.samples, _INTERVALS + 1).astype(int)
    smallest = np.full((len(names), _INTERVALS), np.inf)
    largest = -smallest
    for first, block in rec.blocks(names):
        interval = np.searchsorted(edges, np.arange(first, first + block.shape[1]), side="right") - 1
        starts = np.flatnonzero(np.diff(interval, prepend=interval[0] - 1))
        touched = interval[starts]
        smallest[:, touched] = np.fmin(smallest[:, touched], np.fmin.reduceat(block, starts, axis=1))
        largest[:, touched] = np.fmax(largest[:, touched], np.fmax.reduceat(block, starts, axis=1))
    # Each pair is drawn at one and three quarters of its interval.
    time = (edges[:-1, None] + np.diff(edges)[:, None] * [0.25, 0.75]).ravel() / rec.rate
    values = np.stack([smallest, largest], axis=2).reshape(len(names), -1)
    return time, np.where(np.isfinite(values), values, np.nan)


def spectrograms(rec: Recording, names: Sequence[str]) -> list[Chart]:
    """Return one spectrogram for each channel, from equally spaced Hann windows; empty for a short recording."""
    natural = structural_model(rec.scene).modes.frequency
    highest = min(rec.rate / 2, _MAX_FREQUENCY_RATIO * float(natural.max()))
    block = int(min(rec.samples, rec.rate * _LINES / highest))
    if block < _MIN_BLOCK:
        return []
    # A length with small prime factors, because the FFT is then fast.
    block = fft.prev_fast_len(block, real=True)
    starts = np.linspace(0, rec.samples - block, min(_SPECTRA, max(rec.samples // (block // 4), 1))).astype(int)
    window = np.hanning(block)
    lines = int(block * highest / rec.rate)
    charts = []
    for name in names:
        levels = np.empty((lines, starts.size))
        for k, start in enumerate(starts):
            samples = np.nan_to_num(rec.read(name, int(start), int(start) + block))
            power = np.abs(fft.rfft((samples - samples.mean()) * window)[:lines]) ** 2
            levels[:, k] = 10.0 * np.log10(np.maximum(power, np.finfo(float).tiny))
        band = (0.0, lines * rec.rate / block)
        image = level_image(levels[::-1], (0.0, rec.duration), band)
        charts.append(
            Chart(
                f"Spectrogram of {name} ({rec.channels[name].quantity}); the colors span {IMAGE_SPAN_DB:g} dB below "
                "the highest level",
                f"Spectrogram of {name} from 0 to {highest:.4g} Hz over {rec.duration:.4g} s.",
                [Panel("frequency", "Hz", height=150, limits=band, image=image)],
                x_name="time",
                x_unit="s",
                notes=[f"{starts.size} Hann windows of {block / rec.rate:.3g} s."],
            )
        )
    return charts
