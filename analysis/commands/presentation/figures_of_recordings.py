"""Output of a command that draws and tabulates one result for each recording."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from analysis.commands.presentation.outputs import CommandOutput, check_outputs, separate_stems, with_ending
from analysis.commands.presentation.tables import write_table
from analysis.core.recordings.descriptions import full_test_text
from analysis.core.recordings.opening import OpenRecordings
from daq.core.recording.recording import Recording
from rig.core.base.figure_style import add_title, new_figure, save_figure
from rig.core.base.figure_types import Axes, Figure
from rig.core.results import Result

R = TypeVar("R", bound=Result)


def present_each(
    recordings: OpenRecordings,
    paths: Sequence[Path],
    output: Path | None,
    kind: str,
    title: str,
    evaluate: Callable[[Recording], R],
    draw: Callable[[R, Figure, Axes], None],
    describe: Callable[[R], list[str]] = lambda result: result.table().lines("  "),
) -> CommandOutput:
    """Write figure and columns of each recording's result; `output`: folder, by default that of the recording.

    `kind`: ending of the file names; `title`: title of the figure; `draw`: function that draws a result, with scales
    and captions; `describe`: function that returns the lines printed after the summary.
    """
    stems = separate_stems(paths, output, kind)
    check_outputs(paths, *(with_ending(stem, ending) for stem in stems for ending in ("png", "svg", "csv")))
    files: list[Path] = []
    lines: list[str] = []
    for path, stem in zip(paths, stems, strict=True):
        rec = recordings.of(path)
        result = evaluate(rec)
        with new_figure(4.6) as figure:
            axes = figure.add_subplot()
            draw(result, figure, axes)
            add_title(axes, f"{title}: {rec.scene.name} ({full_test_text(rec)})")
            files += save_figure(figure, stem)
        columns = result.columns()
        files.append(write_table(with_ending(stem, "csv"), list(columns), zip(*columns.values(), strict=True)))
        lines += [result.summary(), *describe(result)]
    return CommandOutput(tuple(files), tuple(lines), ())
