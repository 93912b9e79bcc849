"""Output of `analysis srs`: shock response spectra as text, figure and table."""

from collections.abc import Sequence
from pathlib import Path

from analysis.commands.figures.shock_figure import shock_figure
from analysis.commands.presentation.outputs import (
    CommandOutput,
    check_outputs,
    output_stem,
    with_ending,
    with_recording_name,
)
from analysis.commands.presentation.tables import Row, write_table
from analysis.core.recordings.names import scene_labels
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from analysis.core.responses.measurands import select_channels
from analysis.core.signals.shock_spectrum import ShockSpectrum, srs
from daq.core.recording.recorded_test import deviation_unit, shocks_of
from daq.core.recording.recording import Recording
from rig.core.base.figure_style import save_figure
from rig.core.results.table import Table


@with_recordings
def present_srs(
    recordings: OpenRecordings,
    paths: Sequence[Path],
    output: Path | None = None,
    channels: Sequence[str] | None = None,
    q: float = 10.0,
    lowest: float | None = None,
    highest: float | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
) -> CommandOutput:
    """Draw and tabulate the shock response spectra of channels; spectra of several recordings are overlaid.

    `channels`: by default all channels that measure motion of a body, and the control channel of the test; for the
    other arguments see `srs`.
    """
    stem = output_stem(paths, output, "srs")
    table = with_ending(stem, "csv")
    check_outputs(paths, with_ending(stem, "png"), with_ending(stem, "svg"), table)
    warnings: list[str] = []
    lines: list[str] = []
    spectra: list[tuple[str, ShockSpectrum]] = []
    for path, label in zip(paths, scene_labels(recordings, paths), strict=True):
        rec = recordings.of(path)
        lines += pulse_table(rec).lines()
        test = rec.scene.test
        controlled = [] if test is None or channels else [str(name) for _, name in test.named_channels]
        for name in dict.fromkeys([*controlled, *select_channels(rec, channels)]) or list(rec.channels):
            spectrum = srs(rec, name, q=q, lowest=lowest, highest=highest, from_s=from_s, to_s=to_s)
            spectra.append((label, spectrum))
            warnings += with_recording_name(path, spectrum.warnings)
    figure = shock_figure(recordings, paths, spectra, q, is_first_shock=from_s is None and to_s is None)
    files = save_figure(figure, stem)
    rows: list[Row] = [
        (label, spectrum.channel, spectrum.unit, spectrum.q, *values)
        for label, spectrum in spectra
        for values in zip(*spectrum.columns().values(), strict=True)
    ]
    heading = ["scene", "channel", "unit", "Q", "frequency_Hz", "maximax", "positive", "negative"]
    files.append(write_table(table, heading, rows))
    lines += [f"{label}{spectrum.summary().removeprefix(spectrum.label)}" for label, spectrum in spectra]
    return CommandOutput(tuple(files), tuple(lines), tuple(dict.fromkeys(warnings)))


def pulse_table(rec: Recording) -> Table:
    """Return the practice pulses and shocks of a recording with their deviations."""
    rows = []
    for mark in shocks_of(rec.markers, with_practice=True):
        fields, (factor, unit) = mark.fields, deviation_unit(mark)
        deviation, tolerance = (f"{factor * float(fields[key]):.3g} {unit}" for key in ("deviation", "tolerance"))
        is_within = float(fields["deviation"]) <= float(fields["tolerance"])
        name, level = f"{mark.kind} {fields['number']}", f"{float(fields['level']):g}"
        peak = f"{float(fields['peak']):.4g}"
        rows.append((name, level, peak, deviation, tolerance, "within" if is_within else "outside"))
    return Table(("pulse", "level / dB", "peak / (m/s²)", "deviation", "tolerance", ""), "<>>>><", rows)
