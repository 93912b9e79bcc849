"""Amplitude spectra of a recording's channels, as a picture."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.core.drawing.palette import channel_color
from rig.core.base.escaping import escape_figure
from rig.core.base.figure_style import set_log_scale
from rig.core.scene.scene import STANDARD_GRAVITY

if TYPE_CHECKING:
    from daq.core.recording.recording import Recording

# Duration of a segment, s; the spacing of the lines is therefore 0.25 Hz.
_SEGMENT_S = 4.0
# Maximum number of segments; it limits the computing time for long recordings.
_MAX_SEGMENTS = 200
# The picture fills its view without margins.
_SIZE_INCH = (7.6, 3.6)
_BACKGROUND = "#16181d"
_FOREGROUND = "#c8ccd4"
# Displayed units, by SI units, with their factors; other units are as recorded.
_DISPLAY_UNITS = {"m": (1e6, "µm"), "m/s": (1e3, "mm/s"), "m/s^2": (1.0 / STANDARD_GRAVITY, "g")}


def peak_hold_spectrum(
    recording: Recording, channel: str, start: int, stop: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies (Hz, without 0) and, at each, the largest amplitude over Hann-windowed segments of a channel.

    The amplitude is in the unit of the channel. For a tone it is the amplitude of the tone, for a sweep the amplitude
    at each frequency. Segments of up to 4 s overlap by half; at most `_MAX_SEGMENTS`, evenly spread, are used. The
    amplitude is NaN if every segment has lost samples.
    """
    segment_length = max(8, min(stop - start, round(_SEGMENT_S * recording.rate)))
    segment_count = min(_MAX_SEGMENTS, max(1, 2 * (stop - start) // segment_length - 1))
    segment_starts = np.linspace(start, max(start, stop - segment_length), segment_count).astype(np.int64)
    window = np.hanning(segment_length + 1)[:-1]
    peak_amplitude = np.full(segment_length // 2, np.nan)
    for segment_start in segment_starts:
        samples = recording.read(channel, int(segment_start), int(segment_start) + segment_length)
        if samples.size < segment_length or np.isnan(samples).any():
            continue
        magnitudes = np.abs(np.fft.rfft((samples - samples.mean()) * window))[1 : segment_length // 2 + 1]
        peak_amplitude = np.fmax(peak_amplitude, 2.0 * magnitudes / window.sum())
    return np.arange(1, segment_length // 2 + 1) * recording.rate / segment_length, peak_amplitude


def spectrum_picture(recording: Recording, start: int, stop: int) -> bytes:
    """Draw the spectra of all channels, one panel for each quantity, as a PNG.

    Dotted lines mark the natural frequencies of the structure without dampers.
    """
    from matplotlib.figure import Figure

    from rig.core.system.structural_model import structural_model

    natural_hz = structural_model(recording.scene).modes.frequency
    quantities = sorted({(info.quantity, info.unit) for info in recording.channels.values()})
    figure = Figure(figsize=_SIZE_INCH, dpi=150, facecolor=_BACKGROUND, layout="constrained")
    panels = figure.subplots(len(quantities), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (quantity, unit) in zip(panels, quantities, strict=True):
        channels = {name: info for name, info in recording.channels.items() if info.quantity == quantity}
        spectra = {name: peak_hold_spectrum(recording, name, start, stop) for name in channels}
        frequency = next(iter(spectra.values()))[0]
        in_range = (frequency >= 1.0) & (frequency <= max(100.0, 8 * natural_hz[-1]))
        factor, shown_unit = _DISPLAY_UNITS.get(unit, (1.0, unit))
        for name, (_, amplitude) in spectra.items():
            color = tuple(component / 255 for component in channel_color(channels[name].at))
            panel.plot(
                frequency[in_range], factor * amplitude[in_range], color=color, label=escape_figure(name), linewidth=1.2
            )
        for natural_frequency in natural_hz[natural_hz > 1.0]:
            panel.axvline(natural_frequency, color=_FOREGROUND, linewidth=0.8, linestyle=":", alpha=0.7)
        set_log_scale(panel.xaxis)
        if any(np.any(amplitude[in_range] > 0.0) for _, amplitude in spectra.values()):
            set_log_scale(panel.yaxis, 5)
        divisor = f"({shown_unit})" if "/" in shown_unit else shown_unit
        panel.set_ylabel(f"{quantity} / {divisor}".replace("^2", "²"), color=_FOREGROUND)
        panel.set_facecolor(_BACKGROUND)
        panel.grid(color=_FOREGROUND, alpha=0.15)
        panel.tick_params(colors=_FOREGROUND, which="both")
        panel.spines[:].set_color(_FOREGROUND)
        panel.legend(facecolor=_BACKGROUND, edgecolor="none", labelcolor=_FOREGROUND, fontsize="small", framealpha=0.6)
    panels[-1].set_xlabel("frequency / Hz", color=_FOREGROUND)
    panels[0].set_title(
        f"peak hold, Hann, lines of {frequency[0]:.2g} Hz; dotted: natural frequencies without dampers",
        color=_FOREGROUND, fontsize="medium", loc="left",
    )  # fmt: skip
    picture = io.BytesIO()
    figure.savefig(picture, format="png", facecolor=_BACKGROUND)
    return picture.getvalue()
