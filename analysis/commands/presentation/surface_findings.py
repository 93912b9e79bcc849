"""Output of `analysis surface`: force against frequency and amplitude, and responses at constant force."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from analysis.commands.presentation.figures_of_recordings import present_each
from analysis.commands.presentation.outputs import CommandOutput
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from analysis.core.tracking.body_motion import common_error_text
from analysis.core.tracking.force_surface import ForceSurface, force_surface
from rig.core.base.figure_style import add_legend_below
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.palette import level_styles
from rig.core.results import format_interval, format_number
from rig.core.results.table import Table


@with_recordings
def present_surface(
    recordings: OpenRecordings, paths: Sequence[Path], output: Path | None = None, forces: Sequence[float] = ()
) -> CommandOutput:
    """Draw and tabulate each recording, with the responses at the amplitudes `forces` [N] if they are given."""

    def draw(result: ForceSurface, figure: Figure, axes: Axes) -> None:
        if forces:
            draw_responses(result, forces, axes)
            measured = "Gray points: measured; between them, the force is interpolated."
            is_unstable = any(not result.at_force(force)["stable"].all() for force in forces)
            add_legend_below(figure, "Bars: 95 % intervals.", "Hollow: unstable." * is_unstable, measured)
        else:
            result.draw(axes)
            bars = "Bars: 95 % intervals of the force, which include the uncertainty of the amplitude"
            amplitudes = result.force, result.force_own, result.force_expanded
            common = common_error_text(*amplitudes, "all points of a level")
            add_legend_below(
                figure,
                f"{bars} times the slope of the curve. Dotted lines only join the points.",
                common,
                "Gray bars: including these tolerances, at the first point of each level." * bool(common),
            )

    title = "Response at constant force" if forces else "Force at constant amplitude"
    return present_each(
        recordings, paths, output, "surface", title, force_surface, draw, lambda result: response_lines(result, forces)
    )


def draw_responses(result: ForceSurface, forces: Sequence[float], axes: Axes) -> None:
    """Draw the responses at force amplitudes in N, their folds as crosses, and the measured points."""
    # Gray points show where the force was measured; between them it is interpolated.
    axes.plot(result.frequency, 1e3 * result.amplitude, "o", ms=2.5, color="#b0b0b0", zorder=1)
    for force, (color, _, marker) in level_styles(forces).items():
        frequency, amplitude, expanded, stable = result.at_force(force).values()
        bars: dict[str, Any] = {"fmt": marker, "ms": 4, "color": color, "capsize": 2}
        for is_stable, face, label in ((True, color, f"{format_number(force)} N"), (False, "white", None)):
            x, y, error = (each[stable == is_stable] for each in (frequency, 1e3 * amplitude, 1e3 * expanded))
            axes.errorbar(x, y, error, mfc=face, label=label, **bars)
        for fold, height in result.folds(force):
            axes.plot(fold, 1e3 * height, "x", color=color, ms=8)
    axes.set(xlabel="frequency / Hz", ylabel=f"amplitude of {result.body} / mm")


def response_lines(result: ForceSurface, forces: Sequence[float]) -> list[str]:
    """Return a table of the highest points and the folds of the responses at constant force."""
    rows = []
    for force in forces:
        frequency, amplitude, expanded, _ = result.at_force(force).values()
        if not amplitude.size:
            rows.append((f"{format_number(force)} N", "force not measured", "", "", ""))
            continue
        k, folds = int(amplitude.argmax()), result.folds(force)
        rows.append(
            (
                f"{format_number(force)} N", format_interval(1e3 * amplitude[k], 1e3 * expanded[k]),
                f"{frequency[k]:.5g}", ", ".join(f"{fold:.5g}" for fold, _ in folds) or "none",
                ", ".join(f"{1e3 * height:.3g}" for _, height in folds),
            )
        )  # fmt: skip
    heading = ("force", f"highest point of {result.body} / mm", "at / Hz", "folds / Hz", "amplitudes of folds / mm")
    return Table(heading, ">>>>>", rows).lines("  ") if rows else []
