"""Output of `analysis profile`: motion of control and limited channels compared with the profile of the test."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from analysis.commands.presentation.outputs import CommandOutput, check_outputs, separate_stems, with_ending
from analysis.commands.presentation.tables import write_table
from analysis.core.recordings.names import OpenRecordings, with_recordings
from analysis.core.signals.profile_check import ProfileCheck, profile
from rig.core.base.figure_style import add_legend_below, add_title, new_figure, save_figure, set_log_scale
from rig.core.results.text import table_lines


@with_recordings
def present_profile(recordings: OpenRecordings, paths: Sequence[Path], output: Path | None = None) -> CommandOutput:
    """Draw and tabulate each recording; `output`: folder, by default that of the recording."""
    stems = separate_stems(paths, output, "profile")
    check_outputs(paths, *(with_ending(stem, ending) for stem in stems for ending in ("png", "svg", "csv")))
    files: list[Path] = []
    lines: list[str] = []
    for path, stem in zip(paths, stems, strict=True):
        check = profile(recordings.of(path))
        with new_figure(4.6) as figure:
            axes = figure.add_subplot()
            check.draw(axes)
            for axis in (axes.xaxis, axes.yaxis):
                set_log_scale(axis)
            add_title(axes, "Control and limited channels at full level")
            add_legend_below(figure, f"Band: tolerance of {check.tolerance:g} dB. Dashed: limits.")
            files += save_figure(figure, stem)
        columns = check.columns()
        files.append(write_table(with_ending(stem, "csv"), list(columns), zip(*columns.values(), strict=True)))
        lines += [check.summary(), *channel_lines(check)]
    return CommandOutput(tuple(files), tuple(lines), ())


def channel_lines(check: ProfileCheck) -> list[str]:
    """Return a table of the channels, and a line for each notched band."""
    rows = [("channel", "rms of readings", "kurtosis")]
    rows += [
        (level.channel, f"{level.rms:.4g}", f"{level.kurtosis:.2f}") for level in (*check.channels, *check.limited)
    ]
    notches = [f"  {name} limits the drive from {low:.4g} to {high:.4g} Hz" for name, low, high in check.notches()]
    return [*(f"  {line}" for line in table_lines(rows, "<>>")), *notches]
