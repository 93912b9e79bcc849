"""Figure of shock response spectra: one channel with its signed spectra, or several channels or recordings."""

from collections.abc import Sequence
from pathlib import Path

from analysis.core.recordings.descriptions import full_test_text
from analysis.core.recordings.opening import OpenRecordings
from analysis.core.signals.shock_spectrum import (
    OCTAVE_STEPS,
    ShockSpectrum,
    prescribed_spectrum,
    scatter_text,
    spectra_of_shocks,
)
from daq.core.recording.recorded_test import shocks_of
from rig.core.base.escaping import escape_figure
from rig.core.base.figure_style import COLORS, add_legend_below, add_title, new_figure, set_log_scale
from rig.core.base.figure_types import Figure
from rig.core.base.palette import BASELINE, location_style


def shock_figure(
    recordings: OpenRecordings,
    paths: Sequence[Path],
    spectra: Sequence[tuple[str, ShockSpectrum]],
    q: float,
    is_first_shock: bool,
) -> Figure:
    """Draw shock response spectra on common axes.

    `spectra`: label of the recording, and spectrum; `q`: quality factor of the oscillators; `is_first_shock`: whether
    the spectra are those of the first shock, not of a chosen part.
    """
    places = {name: info.at for path in paths for name, info in recordings.of(path).channels.items()}
    title, prescribed = f"Shock response spectrum, Q = {q:g}", None
    if len(paths) == 1:
        rec = recordings.of(paths[0])
        title += f": {rec.scene.name} ({full_test_text(rec)})"
        prescribed = prescribed_spectrum(rec, q, spectra[0][1].frequency)
    with new_figure(4.6) as figure:
        axes = figure.add_subplot()
        for index, (label, spectrum) in enumerate(spectra):
            name = f"{label}, {spectrum.channel}" if len(paths) > 1 else spectrum.channel
            color = COLORS[index % len(COLORS)] if len(paths) > 1 else location_style(places[spectrum.channel]).color
            style = {"color": color, "label": escape_figure(name)}
            if len(spectra) == 1:
                spectrum.draw(axes, **style)
            else:
                # With several channels, the signed spectra would hide each other; they are in the table only.
                dashes = "-" if len(paths) > 1 else location_style(places[spectrum.channel]).line
                axes.loglog(spectrum.frequency, spectrum.maximax, ls=dashes, lw=1.6, **style)
                axes.set(xlabel="natural frequency / Hz", ylabel=f"shock response / ({spectrum.unit})")
        if prescribed is not None:
            axes.loglog(*prescribed, color=BASELINE, lw=4.0, alpha=0.25, label="prescribed pulse")
        for axis in (axes.xaxis, axes.yaxis):
            set_log_scale(axis)
        add_title(axes, title)
        signed = " Dashed: positive. Dotted: negative." if len(spectra) == 1 else ""
        part, scatter = "the first shock" if is_first_shock else "the chosen part", ""
        if len(paths) == 1 and is_first_shock and len(shocks_of(rec.markers)) > 1:
            scatter = f"; {scatter_text([spectra_of_shocks(rec, each.channel, q) for _, each in spectra])}"
        maximax = f"Largest magnitude of the absolute acceleration (maximax) in {part}"
        add_legend_below(figure, f"{maximax}, at {OCTAVE_STEPS} natural frequencies per octave{scatter}.{signed}")
        return figure
