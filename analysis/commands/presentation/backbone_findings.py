"""Output of `analysis backbone`: natural frequency and damping ratio against amplitude."""

from collections.abc import Sequence
from pathlib import Path

from analysis.commands.presentation.figures_of_recordings import present_each
from analysis.commands.presentation.outputs import CommandOutput
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from analysis.core.tracking.backbone import Backbone, backbone
from analysis.core.tracking.body_motion import common_error_text, draw_common_error
from rig.core.base.figure_style import add_caption
from rig.core.base.figure_types import Axes, Figure


@with_recordings
def present_backbone(recordings: OpenRecordings, paths: Sequence[Path], output: Path | None = None) -> CommandOutput:
    """Draw and tabulate each recording; `output`: folder, by default that of the recording."""
    return present_each(recordings, paths, output, "backbone", "Frequency against amplitude", backbone, _draw)


def _draw(result: Backbone, figure: Figure, axes: Axes) -> None:
    drawn = result.at_natural_frequencies
    drawn.draw(axes)
    axes.margins(x=0.08, y=0.08)
    amplitudes = result.amplitude, result.amplitude_own, result.amplitude_expanded
    draw_common_error(axes, drawn.frequency, *(1e3 * column for column in amplitudes))
    common = common_error_text(*amplitudes)
    add_caption(
        figure, "Numbers: level of each point. Dotted lines only join the points. Bars: 95 % intervals.", common,
        "Gray bar: including these tolerances, at the first point." * bool(common),
    )  # fmt: skip
