"""Output of `analysis backbone`: natural frequency and damping ratio against amplitude."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from analysis.commands.presentation.outputs import CommandOutput, check_outputs, separate_stems, with_ending
from analysis.commands.presentation.tables import write_table
from analysis.core.recordings.names import OpenRecordings, with_recordings
from analysis.core.tracking.backbone import Backbone, backbone
from rig.core.base.figure_style import add_title, new_figure, save_figure
from rig.core.results.text import format_quantity, table_lines


@with_recordings
def present_backbone(recordings: OpenRecordings, paths: Sequence[Path], output: Path | None = None) -> CommandOutput:
    """Draw and tabulate each recording; `output`: folder, by default that of the recording."""
    stems = separate_stems(paths, output, "backbone")
    check_outputs(paths, *(with_ending(stem, ending) for stem in stems for ending in ("png", "svg", "csv")))
    files: list[Path] = []
    lines: list[str] = []
    for path, stem in zip(paths, stems, strict=True):
        result = backbone(recordings.of(path))
        with new_figure(4.6) as figure:
            axes = figure.add_subplot()
            result.draw(axes)
            add_title(axes, "Frequency of phase resonance against amplitude")
            files += save_figure(figure, stem)
        columns = result.columns()
        files.append(write_table(with_ending(stem, "csv"), list(columns), zip(*columns.values(), strict=True)))
        lines += [result.summary(), *level_lines(result)]
    return CommandOutput(tuple(files), tuple(lines), ())


def level_lines(result: Backbone) -> list[str]:
    """Return a table of the levels."""
    rows: list[tuple[str, ...]] = [("level", "frequency / Hz", f"{result.body} / mm", "damping ratio / %", "")]
    for k, level in enumerate(result.level.tolist()):
        values = (
            (result.frequency[k], result.frequency_bound[k], 1.0),
            (result.amplitude[k], result.amplitude_bound[k], 1e3),
            (result.damping[k], result.damping_bound[k], 100.0),
        )
        cells = [format_quantity(factor * value, factor * bound, "") for value, bound, factor in values]
        rows.append((f"{level:g}", *(cell.strip(" ()") for cell in cells), "" if result.settled[k] else "not locked"))
    return [f"  {line}" for line in table_lines(rows, ">>>><")]
