"""Spectra of a recording's channels, as a picture: amplitudes of tones, densities of noise, transforms of pulses."""

import io
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from daq.core.drawing.palette import channel_color
from daq.core.recording.markers import impacts_of
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.base.escaping import escape_figure
from rig.core.base.figure_style import set_log_scale
from rig.core.scene.scene import STANDARD_GRAVITY

# Duration of a segment [s]; the spacing of the lines is therefore 0.25 Hz.
_SEGMENT_S = 4.0
# Maximum number of segments; it limits the computing time for long recordings.
_MAX_SEGMENTS = 200
# The picture fills its view without margins.
_SIZE_INCH = (7.6, 3.6)
_BACKGROUND = "#16181d"
_FOREGROUND = "#c8ccd4"
# Highest shown frequency, relative to that of the highest mode: above it, channels show noise.
_SHOWN_MODES = 4.0
# Ratio of the largest to the smallest shown amplitude.
_SHOWN_RATIO = 1e5
# Displayed units, by SI units, with their factors; other units are as recorded.
_DISPLAY_UNITS = {"m": (1e6, "µm"), "m/s": (1e3, "mm/s"), "m/s^2": (1.0 / STANDARD_GRAVITY, "g")}


class _Estimate(NamedTuple):
    """A kind of spectrum."""

    title: str
    unit: str  # with UNIT for the unit of the signal
    power: int  # power of the unit
    has_window: bool  # whether segments have a Hann window, or begin with a pulse
    # Returns the values of a segment from the magnitudes of its discrete Fourier transform, window and sample rate.
    scale: Callable[[Array, Array, float], Array]
    # Returns the spectrum from that of the previous segments, the values of a segment, and the number of segments.
    combine: Callable[[Array, Array, int], Array]


# Estimate of the spectrum for each value of `TestKind.spectrum`.
_ESTIMATES = {
    "amplitude": _Estimate(
        "amplitude, peak hold, Hann", "UNIT", 1, True,
        lambda x, window, rate: 2.0 * x / window.sum(), lambda previous, values, count: np.fmax(previous, values),
    ),
    "density": _Estimate(
        "power spectral density, Hann", "(UNIT²/Hz)", 2, True,
        lambda x, window, rate: 2.0 * x**2 / (rate * np.sum(window**2)),
        lambda previous, values, count: values if count == 1 else previous + (values - previous) / count,
    ),
    "transform": _Estimate(
        "Fourier transform, largest of all impacts", "(UNIT s)", 1, False,
        lambda x, window, rate: x / rate, lambda previous, values, count: np.fmax(previous, values),
    ),
}  # fmt: skip


def channel_spectrum(recording: Recording, channel: str, start: int, stop: int) -> tuple[Array, Array]:
    """Return frequencies (Hz, without 0) and the spectrum of a channel that suits the test, in the channel's unit.

    Tones: largest amplitude of all segments. Noise: one-sided power spectral density, unit²/Hz, mean of all segments.
    Pulses: magnitude of the Fourier transform from the start of a pulse, unit times s, maximum of all pulses; for the
    force, the value at low frequencies is the impulse. Segments last up to 4 s, and overlap by half if they have a
    window; at most `_MAX_SEGMENTS`, evenly spread, are used. The values are NaN if every segment has lost samples.
    """
    estimate = _ESTIMATES[recording.test.kind.spectrum]
    pulses = [
        impact.first_sample for impact in impacts_of(recording.markers) if start <= impact.first_sample < stop
    ] or [start]
    shortest = min(np.diff([*pulses, stop])) if not estimate.has_window else stop - start
    length = max(8, min(int(shortest), round(_SEGMENT_S * recording.rate)))
    count = min(_MAX_SEGMENTS, max(1, 2 * (stop - start) // length - 1))
    spread = np.linspace(start, max(start, stop - length), count).astype(np.int64).tolist()
    window = np.hanning(length + 1)[:-1] if estimate.has_window else np.ones(length)
    spectrum, used = np.full(length // 2, np.nan), 0
    for first in spread if estimate.has_window else pulses:
        samples = recording.read(channel, first, first + length)
        if samples.size == length and not np.isnan(samples).any():
            transform = np.abs(np.fft.rfft((samples - samples.mean()) * window))[1 : length // 2 + 1]
            used += 1
            spectrum = estimate.combine(spectrum, estimate.scale(transform, window, recording.rate), used)
    return np.arange(1, length // 2 + 1) * recording.rate / length, spectrum


def spectrum_picture(recording: Recording, start: int, stop: int) -> bytes:
    """Draw the spectra of all channels, one panel for each quantity, as a PNG.

    Dotted lines mark the natural frequencies of the structure without dampers.
    """
    from matplotlib.figure import Figure

    from rig.core.system.structural_model import structural_model

    estimate = _ESTIMATES[recording.test.kind.spectrum]
    natural_hz = structural_model(recording.scene).modes.frequency
    quantities = sorted({(info.quantity, info.unit) for info in recording.channels.values()})
    figure = Figure(figsize=_SIZE_INCH, dpi=150, facecolor=_BACKGROUND, layout="constrained")
    panels = figure.subplots(len(quantities), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (quantity, unit) in zip(panels, quantities, strict=True):
        channels = {name: info for name, info in recording.channels.items() if info.quantity == quantity}
        spectra = {name: channel_spectrum(recording, name, start, stop) for name in channels}
        frequency = next(iter(spectra.values()))[0]
        in_range = (frequency >= 1.0) & (frequency <= max(100.0, _SHOWN_MODES * natural_hz[-1]))
        factor, shown_unit = _DISPLAY_UNITS.get(unit, (1.0, unit))
        for name, (_, amplitude) in spectra.items():
            color = tuple(component / 255 for component in channel_color(channels[name].at))
            panel.plot(
                frequency[in_range],
                factor**estimate.power * amplitude[in_range],
                color=color,
                label=escape_figure(name),
                linewidth=1.2,
            )
        for natural_frequency in natural_hz[natural_hz > 1.0]:
            panel.axvline(natural_frequency, color=_FOREGROUND, linewidth=0.8, linestyle=":", alpha=0.7)
        set_log_scale(panel.xaxis)
        if any(np.any(amplitude[in_range] > 0.0) for _, amplitude in spectra.values()):
            set_log_scale(panel.yaxis, 5)
            highest = max(factor**estimate.power * np.nanmax(each[in_range]) for _, each in spectra.values())
            panel.set_ylim(bottom=max(panel.get_ylim()[0], highest / _SHOWN_RATIO**estimate.power))
        inner = f"({shown_unit})" if "/" in shown_unit else shown_unit
        panel.set_ylabel(f"{quantity} / {estimate.unit.replace('UNIT', inner)}".replace("^2", "²"), color=_FOREGROUND)
        panel.set_facecolor(_BACKGROUND)
        panel.grid(color=_FOREGROUND, alpha=0.15)
        panel.tick_params(colors=_FOREGROUND, which="both")
        panel.spines[:].set_color(_FOREGROUND)
        panel.legend(facecolor=_BACKGROUND, edgecolor="none", labelcolor=_FOREGROUND, fontsize="small", framealpha=0.6)
    panels[-1].set_xlabel("frequency / Hz", color=_FOREGROUND)
    test = recording.scene.test
    level = "" if test is None else f"{test.level_text(recording.scene.driven_shaker)}, "
    panels[0].set_title(
        f"{level}{estimate.title}, Δf {frequency[0]:.2g} Hz; dotted: modes without dampers",
        color=_FOREGROUND, fontsize="medium", loc="left",
    )  # fmt: skip
    picture = io.BytesIO()
    figure.savefig(picture, format="png", facecolor=_BACKGROUND)
    return picture.getvalue()
