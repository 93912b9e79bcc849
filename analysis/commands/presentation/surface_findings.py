"""Output of `analysis surface`: force against frequency and amplitude, and responses at constant force."""

from collections.abc import Sequence
from pathlib import Path

from analysis.commands.presentation.figures_of_recordings import present_each
from analysis.commands.presentation.outputs import CommandOutput
from analysis.core.recordings.names import OpenRecordings, with_recordings
from analysis.core.tracking.body_motion import common_error_text
from analysis.core.tracking.force_surface import ForceSurface, force_surface
from rig.core.base.figure_style import add_legend_below
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.palette import level_styles
from rig.core.results import format_number
from rig.core.results.table import Table


@with_recordings
def present_surface(
    recordings: OpenRecordings, paths: Sequence[Path], output: Path | None = None, forces: Sequence[float] = ()
) -> CommandOutput:
    """Draw and tabulate each recording, with the responses at the amplitudes `forces` [N] if they are given."""

    def draw(result: ForceSurface, figure: Figure, axes: Axes) -> None:
        if forces:
            draw_responses(result, forces, axes)
            held = "Gray: held amplitudes. Between them, the force is interpolated."
            is_unstable = any(not result.at_force(force)["stable"].all() for force in forces)
            add_legend_below(figure, "Bars: 95 % intervals.", "Hollow: unstable." * is_unstable, held)
        else:
            result.draw(axes)
            bars = "Bars: 95 % intervals of the force, which include the uncertainty of the amplitude"
            common = common_error_text(result.force, result.force_own, result.force_expanded)
            add_legend_below(
                figure,
                f"{bars} times the slope of the curve. Lines join the points.",
                common.replace("points", "points of a level"),
                "Gray bars: with them, at the first point of a level." * bool(common),
            )

    title = "Response at constant force" if forces else "Force at constant amplitude"
    return present_each(
        recordings, paths, output, "surface", title, force_surface, draw, lambda result: fold_lines(result, forces)
    )


def draw_responses(result: ForceSurface, forces: Sequence[float], axes: Axes) -> None:
    """Draw the responses at force amplitudes in N, and the points at which the amplitude was held."""
    # Gray points show where the force was measured; between them it is interpolated.
    axes.plot(result.frequency, 1e3 * result.amplitude, "o", ms=2.5, color="#b0b0b0", zorder=1)
    for force, style in level_styles(forces).items():
        draw_response(result, force, axes, style.color, style.marker)
    axes.set(xlabel="frequency / Hz", ylabel=f"amplitude of {result.body} / mm")


def draw_response(result: ForceSurface, force: float, axes: Axes, color: str, marker: str) -> None:
    """Draw the response at a force amplitude in N, with its folds as crosses."""
    curve = result.at_force(force)
    for is_stable, face in ((True, color), (False, "white")):
        part = curve["stable"] == is_stable
        label = f"{format_number(force)} N" if is_stable else None
        frequency, amplitude, bound = (
            curve[name][part] for name in ("frequency_Hz", "amplitude_m", "amplitude_bound_m")
        )
        axes.errorbar(
            frequency, 1e3 * amplitude, 1e3 * bound, fmt=marker, ms=4, color=color, mfc=face, label=label, capsize=2
        )
    for frequency, amplitude in result.folds(force):
        axes.plot(frequency, 1e3 * amplitude, "x", color=color, ms=8)


def fold_lines(result: ForceSurface, forces: Sequence[float]) -> list[str]:
    """Return a table of the folds of the responses at constant force."""
    rows = [
        (f"{format_number(force)} N", f"{frequency:.5g}", f"{1e3 * amplitude:.3g}")
        for force in forces
        for frequency, amplitude in result.folds(force)
    ]
    heading = ("force", "fold / Hz", f"amplitude of {result.body} / mm")
    return Table(heading, ">>>", rows).lines("  ")
