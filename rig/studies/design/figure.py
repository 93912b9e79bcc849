"""Files of `rig design`: the figure, and a scene with a test that checks the design."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rig.core.base.figure_style import add_page_title, cell_edges, new_figure, save_figure, set_log_scale
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.output_files import atomic_write, file_stem
from rig.core.base.palette import BASELINE, RECORDINGS
from rig.core.orbits.problem import OrbitProblem
from rig.core.results import format_number
from rig.core.system.reference import linear_response
from rig.studies.design.choice import FINE_DENSITY, Choice
from rig.studies.design.design import Design
from rig.studies.design.summary import LIMIT_TOLERANCE
from rig.studies.design.worst_peak import response_at_level

#: Colors, line styles and markers of the responses with dampers, for successive levels. The numbers of each have no
#: common factor, so the styles of 60 levels differ.
LEVEL_COLORS = RECORDINGS[:3]
_LEVEL_LINES = "-", "--", "-.", ":"
_LEVEL_MARKERS = "os^Dv"
# Number of frequencies of the drawn response without dampers: about one per pixel.
_RESPONSE_POINTS = 800


def write(design: Design, folder: Path) -> list[Path]:
    """Write scene and figures of the best dampers into an existing folder; raise `SceneError` if this fails."""
    name = folder / file_stem("design", design.scene.name)
    scene = name.with_suffix(".yaml")
    with atomic_write(scene) as temporary:
        temporary.write_text(design.scene.to_yaml(), encoding="utf-8")
        figures = save_figure(_draw(design), name)
    return [scene, *figures]


def _draw(design: Design) -> Figure:
    with new_figure(6.5, 9.0) as figure:
        (front, chart), (reductions, responses) = figure.subplots(2, 2)
        design.draw(front)
        front.legend()
        _draw_chart(chart, design)
        _draw_reductions(reductions, design)
        _draw_responses(responses, design)
        levels = f"{', '.join(map(format_number, design.question.levels))} {design.question.level.unit}"
        if len(design.question.levels) > 1:
            levels += (
                f" (with dampers: highest at {format_number(design.best.peak.level)} {design.question.level.unit})"
            )
        is_all = design.best.choice.mass > (1.0 - LIMIT_TOLERANCE) * design.space.max_mass
        add_page_title(
            figure,
            f"Design (computed): {headline(design)}",
            # The part of the name after a comma may describe the dampers that the design replaces.
            f"{design.scene.name.partition(',')[0]}; largest peak without and with dampers at {levels}; "
            f"shot as one mass{'; mass at the budget' * is_all}",
        )
        return figure


def _draw_chart(axes: Axes, design: Design) -> None:
    """Draw the reduction of the worst peak against level and clearance (the chart of the design)."""
    reduction = np.array([[design.reduction(peak) for peak in row] for row in design.chart])
    choice = design.charted
    chosen = choice.clearances[choice.heaviest_index]
    clearance = design.clearance_factors * chosen
    borders = cell_edges(design.levels, True), cell_edges(clearance, True)
    mesh = axes.pcolormesh(*borders, reduction, cmap="viridis", rasterized=True)
    axes.figure.colorbar(mesh, ax=axes, pad=0.02, label=f"reduction at this {design.question.level.name} / dB")
    levels = design.question.levels
    label = "chosen" if design.best.choice.has_ceiling else "largest searched"
    axes.plot(levels, [chosen] * len(levels), "o-", color="white", lw=4.0, ms=9)
    axes.plot(
        levels, [chosen] * len(levels), "o-", color=BASELINE, lw=2.0, ms=6, label=f"{label}: {1e3 * chosen:.3g} mm"
    )
    axes.grid(False)
    axes.set(xlabel=design.question.level.label, ylabel=clearance_label(choice))
    set_log_scale(axes.xaxis)
    set_log_scale(axes.yaxis, factor=1e3)
    axes.set(xlim=borders[0][[0, -1]], ylim=borders[1][[0, -1]])
    # The legend is outside the axes, because inside it would hide cells.
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
    axes.set_title(f"Clearance and {design.question.level.name}")


def clearance_label(choice: Choice) -> str:
    """Return the label of the clearance axis, which shows the clearance of the heaviest damper."""
    if len(choice.bodies) == 1:
        return "clearance / mm"
    return f"clearance in body {choice.bodies[choice.heaviest_index]} / mm\n(other clearances in proportion)"


def _draw_reductions(axes: Axes, design: Design) -> None:
    """Draw peak reduction against excitation level, for the chosen clearance and its neighbors."""
    # The axis is the acceleration without dampers; with dampers it jumps where another peak becomes the largest.
    chosen = int(np.argmin(np.abs(np.log(design.clearance_factors))))
    plotted_rows = (chosen - 1, chosen, chosen + 1)
    bare_acceleration = design.levels / design.bare.level * design.bare.acceleration
    styles = ("#777777", "v", ":"), (BASELINE, "^", "-"), ("#777777", "o", "--")
    for row_number, (color, marker, line) in zip(plotted_rows, styles, strict=True):
        row = design.chart[row_number]
        choice = design.charted
        clearance = 1e3 * design.clearance_factors[row_number] * choice.clearances[choice.heaviest_index]
        axes.plot(
            bare_acceleration, [design.reduction(peak) for peak in row], f"{marker}{line}", ms=4,
            color=color, lw=1.6 if row_number == chosen else 1.0, label=f"clearance {clearance:.3g} mm",
        )  # fmt: skip
    axes.set(xlabel="acceleration at the peak without dampers / (m/s²)", ylabel="reduction of the largest peak / dB")
    set_log_scale(axes.xaxis)
    axes.axhline(0.0, color="black", lw=0.8)
    _add_legend_below(axes)
    axes.set_title("Acceleration level")


def _draw_responses(axes: Axes, design: Design) -> None:
    """Draw the largest response of the watched bodies without and with dampers, and the peaks of the modes."""
    objective = replace(design.question, density=FINE_DENSITY)
    scene, (low, high) = objective.scenes[0], objective.band
    (name, unit, factor), level_unit = design.question.response_display, design.question.level.unit
    peaks = [mode.undamped.frequency for mode in design.modes if mode.in_band]
    frequency = np.unique(np.concatenate([np.geomspace(low, high, _RESPONSE_POINTS), peaks]))
    rows = [body - 1 for body in objective.bodies]
    bare = abs(linear_response(scene.replace(dampers=[]), frequency)[rows]).max(axis=0)
    axes.plot(frequency, factor * bare, color=BASELINE, lw=1.0, label="without dampers")
    damped_scene = scene.replace(dampers=design.best.choice.dampers(objective.impact_law))
    problem, coarse = OrbitProblem(damped_scene), objective.frequencies(damped_scene)
    for number, level in enumerate(objective.levels):
        color, dashes, marker = level_style(number)
        response = response_at_level(problem, level, coarse)
        axes.plot(coarse, factor * abs(response.frf[rows]).max(axis=0), color=color, ls=dashes, lw=1.0)
        damped = [mode.damped[number] for mode in design.modes if mode.in_band]
        axes.plot(
            [peak.frequency for peak in damped], [factor * peak.magnitude for peak in damped], marker, color=color,
            mfc="white", ms=5,
        )  # fmt: skip
        axes.plot(
            [], [], ls=dashes, marker=marker, color=color, mfc="white", ms=5,
            label=f"with dampers, {format_number(level)} {level_unit}",
        )  # fmt: skip
    axes.set(xlabel="frequency / Hz", ylabel=f"largest {name} / ({unit})", xlim=(low, high))
    set_log_scale(axes.xaxis)
    set_log_scale(axes.yaxis, 5)
    _add_legend_below(axes)
    axes.set_title("Response without and with dampers")


def level_style(number: int) -> tuple[str, str, str]:
    """Return color, line style and marker of a level, by its number from 0."""
    cycles: tuple[Sequence[str], ...] = LEVEL_COLORS, _LEVEL_LINES, _LEVEL_MARKERS
    color, line, marker = (cycle[number % len(cycle)] for cycle in cycles)
    return color, line, marker


def _add_legend_below(axes: Axes) -> None:
    """Add a legend below the axes, because one inside would hide peaks."""
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.19), ncols=2, borderaxespad=0.0)


def headline(design: Design) -> str:
    """State the dampers, the largest peak without and with them, and its change in dB."""
    peak, (_, unit, factor) = design.best.peak, design.question.response_display
    heights = " to ".join(format_number(factor * each.magnitude) for each in (design.bare, peak))
    change = f"{-design.reduction(peak):+.1f}".replace("-", "−")
    return f"{design.best.choice}: {heights} {unit} ({change} dB)"
