"""Output of `analysis profile`: motion of control and limited channels compared with the profile of the test."""

from collections.abc import Sequence
from pathlib import Path

from analysis.commands.presentation.figures_of_recordings import present_each
from analysis.commands.presentation.outputs import CommandOutput
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from analysis.core.signals.profile_check import ProfileCheck, profile
from rig.core.base.figure_style import add_legend_below, frequency_axis, log_axis
from rig.core.base.figure_types import Axes, Figure


@with_recordings
def present_profile(recordings: OpenRecordings, paths: Sequence[Path], output: Path | None = None) -> CommandOutput:
    """Draw and tabulate each recording; `output`: folder, by default that of the recording."""
    return present_each(recordings, paths, output, "profile", "Controlled motion", profile, _draw, channel_lines)


def _draw(result: ProfileCheck, figure: Figure, axes: Axes) -> None:
    result.draw(axes)
    frequency_axis(axes, float(result.frequency[0]), float(result.frequency[-1]), True)
    log_axis(axes, [result.control, result.profile, *(level.values for level in result.limited)], 5.0)
    # The title names the scene.
    verdict = result.summary().removeprefix(f"{result.label}: ")
    sentences = [f"{verdict[0].upper()}{verdict[1:]}.", f"Band: tolerance of {result.tolerance:g} dB."]
    if result.limited:
        sentences.append("Colored strips: a limit of another channel keeps the control channel below the tolerance.")
    if result.is_outside.any():
        sentences.append("Black strips: outside the tolerance, where no limit acts.")
    add_legend_below(figure, *sentences)


def channel_lines(check: ProfileCheck) -> list[str]:
    """Return a table of the channels, and a line for each notched band."""
    notches = [f"  {name} limits the drive from {low:.4g} to {high:.4g} Hz" for name, low, high in check.notches()]
    return [*check.table().lines("  "), *notches, *(f"  {text}" for text in check.warnings)]
